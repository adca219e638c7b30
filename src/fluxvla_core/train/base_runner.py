"""``BaseTrainRunner``: trains on one process, and is what every strategy builds on.

A strategy overrides ``_wrap_model`` and, where it must, ``_sync_gradients``, ``clip_grad_norm``
and ``_unwrap``. Nothing here imports torch before it is used: a config is checked without it.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from fluxvla_core.build import (
    RunContext,
    build_collator_from_cfg,
    build_metric_from_cfg,
    build_optimizer_from_cfg,
    build_tokenizer_from_cfg,
    build_vla_from_cfg,
)
from fluxvla_core.errors import ConfigError
from fluxvla_core.hooks import build_hooks
from fluxvla_core.train.options import LoaderOptions, TrainOptions
from fluxvla_core.train.running import TrainRun

if TYPE_CHECKING:
    import torch
    from torch import Tensor, nn

    from fluxvla_core.checkpoints.parts import Stored


class BaseTrainRunner(TrainRun):
    """The training loop with everything around it; works as it is on one process.

    Called as ``run_setup(n_train_examples)`` and then ``run(dataset)``. Batch size and loader
    workers are ``per_device_batch_size`` and ``per_device_num_workers`` of the config's
    ``train_dataloader``.

    Args:
        learning_rate: peak rate of AdamW.
        collator: table of ``fluxvla.collators``, or a callable from samples to a batch.
        cfg: the whole config tree; filled in by the builder.
        context: the run; filled in by the builder.
        max_epochs, max_steps: exactly one of them ends the run.
        weight_decay: of matrices; biases and norms have none.
        max_grad_norm: gradients are scaled down to this norm; None leaves them.
        sampler: None or ``distributed``: both shuffle every epoch and split it over the ranks.
        tokenizer: table of ``fluxvla.tokenizers``, saved with the checkpoints.
        metric: table of ``fluxvla.metrics``; a ``VLAMetric`` that writes JSON lines if None.
        save_epoch_interval: epoch-based runs save after every so many epochs.
        save_iter_interval: save every so many steps; 10000 in step-based runs that say nothing,
            only by epochs in epoch-based ones. The end of a run is always saved.
        max_keep_ckpts: newest checkpoints (by step) to keep; 0 keeps all.
        async_save: write checkpoints beside the training, from a copy in memory; False waits for
            the disk and needs no copy.
        optimizer: table of ``fluxvla.optimizers``; ``AdamW`` if None.
        lr_scheduler_type: ``constant``, ``linear-warmup+cosine-decay``, ``step-based``, ``wsd``.
        lr_schedule: for ``step-based``: ``{part of the run: rate}``, with 0.
        warmup_ratio: part of the run over which the rate rises.
        grad_accumulation_steps: batches per optimizer step; gradients are averaged over them.
        enable_mixed_precision_training: compute in ``mixed_precision_dtype``; weights and
            optimizer stay fp32.
        mixed_precision_dtype: ``bf16``.
        enable_gradient_checkpointing: recompute the model's ``fsdp_units`` in the backward pass.
        compile_blocks: ``torch.compile`` each of the model's ``fsdp_units``.
        init_from: weights to start from: a checkpoint's folder, a work dir, a safetensors file;
            a run that goes on has its own, or its adapter's base, instead.
        lora: train low-rank adapters only: table of ``rank``, ``target_modules`` and, if wanted,
            ``alpha``, ``dropout``, ``modules_to_save``.
        ema_decay: keep averaged weights too, and act with those; None does not.
        val_iter_interval: with a ``val_dataloader``: its loss every so many steps and at the end;
            None with every checkpoint. The best one by it is kept and called ``best``.
        early_stop_patience: end after so many validations in a row without a better one.
        seed: initial weights, order of samples, and everything drawn, also by datasets that set
            no ``seed`` of their own.
        resume_from: ``auto`` or a checkpoint's path; the command line's ``--resume`` goes first,
            but ``auto`` and restarts begin at that path while the work dir has no checkpoint.
        log_iter_interval: fetch losses, and look for NaN, every so many steps; every step is
            logged all the same.
        device: ``auto`` (a GPU if there is one), ``cpu``, ``cuda``.
        peak_tflops: what one device can do at most, for ``mfu``; by default what the makers of
            known GPUs state for bf16.

    Raises:
        ConfigError: a setting that cannot be meant, with its place.
    """

    api: ClassVar[str] = "1.0"
    needs_process_group: ClassVar[bool] = False

    def __init__(
        self,
        *,
        learning_rate: float,
        collator: Any,
        cfg: Mapping[str, Any] | None = None,
        context: RunContext | None = None,
        max_epochs: int | None = None,
        max_steps: int | None = None,
        weight_decay: float = 0.0,
        max_grad_norm: float | None = 1.0,
        sampler: str | None = None,
        tokenizer: Any = None,
        metric: Any = None,
        optimizer: Any = None,
        save_epoch_interval: int = 1,
        save_iter_interval: int | None = None,
        max_keep_ckpts: int = 2,
        async_save: bool = True,
        lr_scheduler_type: str = "constant",
        lr_schedule: Mapping[Any, float] | None = None,
        warmup_ratio: float = 0.0,
        grad_accumulation_steps: int = 1,
        enable_mixed_precision_training: bool = False,
        mixed_precision_dtype: str = "bf16",
        enable_gradient_checkpointing: bool = False,
        compile_blocks: bool = False,
        init_from: str | None = None,
        lora: Mapping[str, Any] | None = None,
        ema_decay: float | None = None,
        val_iter_interval: int | None = None,
        early_stop_patience: int | None = None,
        seed: int = 42,
        resume_from: str | None = None,
        log_iter_interval: int = 10,
        device: str = "auto",
        peak_tflops: float | None = None,
    ) -> None:
        self.context = context or RunContext(config=cfg or {}, section="runner")
        self.cfg: Mapping[str, Any] = self.context.config if cfg is None else cfg
        self.options = TrainOptions(
            learning_rate=learning_rate,
            max_epochs=max_epochs,
            max_steps=max_steps,
            weight_decay=weight_decay,
            max_grad_norm=max_grad_norm,
            sampler=sampler,
            save_epoch_interval=save_epoch_interval,
            save_iter_interval=save_iter_interval,
            max_keep_ckpts=max_keep_ckpts,
            async_save=async_save,
            lr_scheduler_type=lr_scheduler_type,
            lr_schedule=lr_schedule,
            warmup_ratio=warmup_ratio,
            grad_accumulation_steps=grad_accumulation_steps,
            enable_mixed_precision_training=enable_mixed_precision_training,
            mixed_precision_dtype=mixed_precision_dtype,
            enable_gradient_checkpointing=enable_gradient_checkpointing,
            compile_blocks=compile_blocks,
            init_from=init_from,
            lora=lora,
            ema_decay=ema_decay,
            val_iter_interval=val_iter_interval,
            early_stop_patience=early_stop_patience,
            seed=seed,
            resume_from=resume_from,
            log_iter_interval=log_iter_interval,
            device=device,
            peak_tflops=peak_tflops,
        )
        self.options.check(self.context)
        self.loader_options = LoaderOptions.read(self.cfg, self.context)
        self.lora = self.options.lora_options(self.context)
        self.val_options = LoaderOptions.for_validation(self.cfg, self.context, self.options)
        self.learning_rate, self.weight_decay = learning_rate, weight_decay
        self.max_grad_norm = max_grad_norm
        self.max_epochs, self.max_steps = max_epochs, max_steps
        self.collator = build_collator_from_cfg(collator, self.context)
        self.tokenizer = build_tokenizer_from_cfg(tokenizer, self.context)
        self.metric = build_metric_from_cfg(
            {"type": "VLAMetric"} if metric is None else metric, self.context
        )
        self.optimizer_settings = build_optimizer_from_cfg(
            {"type": "AdamW"} if optimizer is None else optimizer, self.context
        )
        self.hooks = build_hooks(self.context)

    # What a strategy may override.

    def run_setup(self, n_train_examples: int) -> None:
        """Build and wrap the model, its optimizer and its schedule.

        Args:
            n_train_examples: samples in the dataset; with the batch size, an epoch's steps.
        """
        self.vla = self._build_vla()
        self.vla = self._wrap_model(self.vla)
        self.optimizer = self._build_optimizer()
        self.lr_scheduler = self._build_lr_scheduler(n_train_examples)

    def _build_vla(self) -> nn.Module:
        """The config's ``model``, from equal weights on every rank, as the settings have it."""
        from fluxvla_core.train import flops, forward, lora
        from fluxvla_core.train.distributed import on_first
        from fluxvla_core.train.state import seed_all
        from fluxvla_core.train.weights import base_of, base_to_note, exact_place, start_from

        self._prepare()
        if "model" not in self.cfg:
            raise ConfigError(
                "the config has no 'model' to train",
                where=self.context.config_file,
                next="model = dict(type='CompactVLA', …); fluxvla plugins list has what there is",
            )
        seed_all(self.options.seed)
        vla: nn.Module = build_vla_from_cfg(self.cfg["model"], self.context)
        options, before = self.options, self._checkpoint
        # A run that goes on finds all weights in its checkpoint, but for an adapter's base.
        place = base_of(before, options.init_from) if before is not None else options.init_from
        if place is not None:
            # Found once: ranks that looked one after the other could find different ones.
            wanted = place
            found = start_from(vla, on_first(self.world, lambda: exact_place(wanted)))
            if self.lora is not None:
                vla.__dict__["frozen_source"] = str(found)
        if self.lora is not None:
            self.adapter_base = base_to_note(before, options.init_from)
            lora.attach(vla, self.lora, self.context.where(f"{self.context.section}.lora"))
        self.flops = flops.Meter.of(vla, self.world.device, self.compute_dtype, options.peak_tflops)
        if options.enable_gradient_checkpointing:
            forward.checkpoint_activations(vla)
        if options.compile_blocks:
            forward.compile_units(vla)
        return vla

    def _wrap_model(self, vla: nn.Module) -> nn.Module:
        """Put the model where it trains; a strategy splits or replicates it here.

        Raises:
            ConfigError: there are several processes, which this class does not keep together.
        """
        if self.world.size > 1:
            raise ConfigError(
                f"{type(self).__name__} trains on one process, and there are {self.world.size}",
                where=self.context.where(f"{self.context.section}.type"),
                next="use DDPTrainRunner or FSDPTrainRunner, or override _wrap_model",
            )
        return vla.to(self.world.device)

    def _unwrap(self, vla: nn.Module) -> nn.Module:
        """The model inside what ``_wrap_model`` returned, with the names that are saved."""
        from torch.nn.parallel import DistributedDataParallel

        return vla.module if isinstance(vla, DistributedDataParallel) else vla

    def _build_optimizer(self) -> torch.optim.Optimizer:
        """The config's ``optimizer``, with weight decay on matrices only."""
        from fluxvla_core.train.optim import decay_groups

        groups = decay_groups(self.model, self.weight_decay)
        built: torch.optim.Optimizer = self.optimizer_settings.build(groups, self.learning_rate)
        return built

    def _build_lr_scheduler(self, n_train_examples: int) -> Any:
        """The schedule over all steps of the run; has ``step`` and a JSON ``state_dict``."""
        from fluxvla_core.train.optim import ScheduledLR
        from fluxvla_core.train.schedule import make_schedule

        options = self.options
        schedule = make_schedule(
            options.lr_scheduler_type,
            options.learning_rate,
            self._total(self._plan(n_train_examples)),
            options.warmup_ratio,
            options.lr_schedule,
        )
        return ScheduledLR(self.optimizer, schedule, options.learning_rate)

    def _training_step(self, batch: dict[str, Any]) -> Tensor:
        """Forward pass of one batch on the device: its loss, a scalar with a gradient."""
        from fluxvla_core.train.forward import loss_of, sample_losses_of
        from fluxvla_core.train.precision import autocast

        if self._arguments is None:
            raise RuntimeError("a batch's arguments are known inside run() only")
        with autocast(self.world.device, self.compute_dtype):
            output = self.vla(**self._arguments(batch))
        self.sample_losses = sample_losses_of(output)
        return loss_of(output, self.model)

    def _sync_gradients(self, last: bool) -> AbstractContextManager[object]:
        """Entered for each batch of a step; only the ``last`` one exchanges gradients."""
        return nullcontext()

    def _backward(self, loss: Tensor) -> None:
        """Backward pass of one batch; ``loss`` is divided by the number of batches already."""
        loss.backward()  # type: ignore[no-untyped-call]

    def _update(self) -> Tensor | None:
        """Clip, and let the optimizer step; the gradients' norm before, on the device.

        Where ``clip_grad_norm`` tells none it is the norm of what the optimizer uses: gradients
        that are not finite must not go unseen.
        """
        from fluxvla_core.train.optim import gradient_norm

        norm = self.clip_grad_norm()
        if norm is None:
            norm = gradient_norm(self._optimized())
        self.optimizer.step()
        return norm

    def _warm_up(self, batch: dict[str, Any]) -> None:
        """Called with the first batch, before the first step; must leave no trace."""

    def clip_grad_norm(self) -> Tensor | None:
        """Scale the gradients down to ``max_grad_norm``; their norm before, on the device.

        None says nothing of the norm, as where there is no ``max_grad_norm``.
        """
        from fluxvla_core.train.optim import clip_

        return None if self.max_grad_norm is None else clip_(self._optimized(), self.max_grad_norm)

    def _optimized(self) -> list[nn.Parameter]:
        return [p for group in self.optimizer.param_groups for p in group["params"]]

    def save_checkpoint(
        self,
        run_dir: Path,
        global_step: int,
        epoch: int,
        train_loss: float | None = None,
        only_trainable: bool = True,
    ) -> Path | None:
        """Begin to save ``run_dir/checkpoints/step-…``; called on every rank.

        With ``async_save`` it is there, and known to be, after :meth:`settle_saves`.

        Args:
            run_dir: the work dir.
            global_step: optimizer steps done.
            epoch: whole epochs done.
            train_loss: of the last step.
            only_trainable: leave out frozen weights whose module names their ``frozen_source``.

        Raises:
            RunFailed: it cannot be written; the earlier ones are as they were.
        """
        from fluxvla_core.train.saver import Saver
        from fluxvla_core.train.saving import save_snapshot, take_snapshot

        if self._saver is None:
            self._saver = Saver(self.world, False)
        path = save_snapshot(
            self._saver,
            Path(run_dir),
            global_step,
            epoch,
            take_snapshot(self, train_loss, only_trainable),
            self.options.max_keep_ckpts,
            self.progress.best_step,
        )
        if not self._saver.beside:
            self.settle_saves()
        return path

    def _load_model_state(self, state: Mapping[str, Tensor]) -> None:
        """Put a checkpoint's weights, whole and by name, into the model; all of them fit."""
        from fluxvla_core.train.weights import put_model_tensors

        put_model_tensors(self.model, state)

    def _load_optimizer_state(self, state: dict[str, Any]) -> bool:
        """Take an optimizer's state in the form of its ``state_dict``; whether it was taken."""
        self.optimizer.load_state_dict(state)
        return True

    def _model_tensors(self) -> Mapping[str, Tensor]:
        """Weights and buffers by name, to be saved; parts of them where they are sharded."""
        from fluxvla_core.train.weights import model_tensors

        return model_tensors(self.model)

    def _optimizer_tensors(self) -> tuple[Mapping[str, Tensor], dict[str, Any]]:
        """The optimizer's state by ``<parameter>/<key>``, and JSON values of the rest of it."""
        from fluxvla_core.train.optim import named_state

        return named_state(self.model, self.optimizer)

    def _load_optimizer_tensors(
        self, tensors: Mapping[str, Tensor | Stored], described: Mapping[str, Any], where: str
    ) -> bool:
        """The inverse of :meth:`_optimizer_tensors`, by way of :meth:`_load_optimizer_state`."""
        from fluxvla_core.train.optim import torch_state

        state = torch_state(self.model, self.optimizer, tensors, described, where)
        return self._load_optimizer_state(state)

    def resume(self) -> int:
        """Go on from the checkpoint that the run was told to; the step it stands at, 0 afresh.

        Raises:
            CheckpointError: it is of another model, optimizer, dataset or seed.
        """
        from fluxvla_core.train.resuming import restore

        if self._checkpoint is None:
            return 0
        restore(self, self._checkpoint)
        return self.progress.step

    def _run_epoch_based(self) -> int:
        """Steps until ``max_epochs`` are done; the signal that ended them early, or 0."""
        epochs, options, progress = self.max_epochs, self.options, self.progress

        def due() -> bool:
            ended = progress.cursor.samples == 0
            by_epoch = ended and progress.cursor.epoch % options.save_epoch_interval == 0
            return by_epoch or self._steps_due()

        return self.loop.run(lambda: progress.cursor.epoch >= (epochs or 0), due)

    def _run_step_based(self) -> int:
        """Steps until ``max_steps`` are done; the signal that ended them early, or 0."""
        steps = self.max_steps or 0
        return self.loop.run(lambda: self.progress.step >= steps, self._steps_due)
