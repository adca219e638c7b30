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
    build_tokenizer_from_cfg,
    build_vla_from_cfg,
)
from fluxvla_core.errors import ConfigError
from fluxvla_core.hooks import build_hooks
from fluxvla_core.train.options import LoaderOptions, TrainOptions

if TYPE_CHECKING:
    import torch
    from torch import Tensor, nn

    from fluxvla_core.train.batches import StepPlan
    from fluxvla_core.train.checkpoint import Checkpoint
    from fluxvla_core.train.distributed import World
    from fluxvla_core.train.ema import Ema
    from fluxvla_core.train.forward import ForwardArguments
    from fluxvla_core.train.loop import StepLoop
    from fluxvla_core.train.progress import Progress
    from fluxvla_core.train.weights import LeftOut


class BaseTrainRunner:
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
        lr_scheduler_type: ``constant``, ``linear-warmup+cosine-decay``, ``step-based``, ``wsd``.
        lr_schedule: for ``step-based``: ``{part of the run: rate}``, with 0.
        warmup_ratio: part of the run over which the rate rises.
        grad_accumulation_steps: batches per optimizer step; gradients are averaged over them.
        enable_mixed_precision_training: compute in ``mixed_precision_dtype``; weights and
            optimizer stay fp32.
        mixed_precision_dtype: ``bf16``.
        enable_gradient_checkpointing: recompute the model's ``fsdp_units`` in the backward pass.
        ema_decay: keep averaged weights too, and act with those; None does not.
        seed: initial weights, order of samples, and everything drawn.
        resume_from: ``auto`` or a checkpoint's path; the command line's ``--resume`` goes first.
        log_iter_interval: fetch losses, and look for NaN, every so many steps; every step is
            logged all the same.
        device: ``auto`` (a GPU if there is one), ``cpu``, ``cuda``.

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
        save_epoch_interval: int = 1,
        save_iter_interval: int | None = None,
        max_keep_ckpts: int = 2,
        lr_scheduler_type: str = "constant",
        lr_schedule: Mapping[Any, float] | None = None,
        warmup_ratio: float = 0.0,
        grad_accumulation_steps: int = 1,
        enable_mixed_precision_training: bool = False,
        mixed_precision_dtype: str = "bf16",
        enable_gradient_checkpointing: bool = False,
        ema_decay: float | None = None,
        seed: int = 42,
        resume_from: str | None = None,
        log_iter_interval: int = 10,
        device: str = "auto",
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
            lr_scheduler_type=lr_scheduler_type,
            lr_schedule=lr_schedule,
            warmup_ratio=warmup_ratio,
            grad_accumulation_steps=grad_accumulation_steps,
            enable_mixed_precision_training=enable_mixed_precision_training,
            mixed_precision_dtype=mixed_precision_dtype,
            enable_gradient_checkpointing=enable_gradient_checkpointing,
            ema_decay=ema_decay,
            seed=seed,
            resume_from=resume_from,
            log_iter_interval=log_iter_interval,
            device=device,
        )
        self.options.check(self.context)
        self.loader_options = LoaderOptions.read(self.cfg, self.context)
        self.learning_rate, self.weight_decay = learning_rate, weight_decay
        self.max_grad_norm = max_grad_norm
        self.max_epochs, self.max_steps = max_epochs, max_steps
        self.collator = build_collator_from_cfg(collator, self.context)
        self.tokenizer = build_tokenizer_from_cfg(tokenizer, self.context)
        self.metric = build_metric_from_cfg(
            {"type": "VLAMetric"} if metric is None else metric, self.context
        )
        self.hooks = build_hooks(self.context)
        self.vla: Any = None
        self.optimizer: Any = None
        self.lr_scheduler: Any = None
        self.ema: Ema | None = None
        self.dataset: Any = None
        self.left_out: LeftOut | None = None
        self.plan: StepPlan
        self.progress: Progress
        self._world: World | None = None
        self._checkpoint: Checkpoint | None = None
        self._arguments: ForwardArguments | None = None
        self._loop: StepLoop | None = None

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
        """The config's ``model``, from equal random weights on every rank."""
        from fluxvla_core.train.forward import checkpoint_activations
        from fluxvla_core.train.state import seed_all

        self._prepare()
        if "model" not in self.cfg:
            raise ConfigError(
                "the config has no 'model' to train",
                where=self.context.config_file,
                next="model = dict(type='CompactVLA', …); fluxvla plugins list has what there is",
            )
        seed_all(self.options.seed)
        vla: nn.Module = build_vla_from_cfg(self.cfg["model"], self.context)
        if self.options.enable_gradient_checkpointing:
            checkpoint_activations(vla)
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
        """AdamW with decay on matrices only."""
        from fluxvla_core.train.optim import make_adamw

        return make_adamw(self.model, self.learning_rate, self.weight_decay)

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
        return ScheduledLR(self.optimizer, schedule)

    def _training_step(self, batch: dict[str, Any]) -> Tensor:
        """Forward pass of one batch on the device: its loss, a scalar with a gradient."""
        from fluxvla_core.train.forward import loss_of
        from fluxvla_core.train.precision import autocast

        if self._arguments is None:
            raise RuntimeError("a batch's arguments are known inside run() only")
        with autocast(self.world.device, self.compute_dtype):
            return loss_of(self.vla(**self._arguments(batch)), self.model)

    def _sync_gradients(self, last: bool) -> AbstractContextManager[object]:
        """Entered for each batch of a step; only the ``last`` one exchanges gradients."""
        return nullcontext()

    def _warm_up(self, batch: dict[str, Any]) -> None:
        """Called with the first batch, before the first step; must leave no trace."""

    def clip_grad_norm(self) -> Tensor | None:
        """Scale the gradients down to ``max_grad_norm``; their norm before, on the device."""
        from fluxvla_core.train.optim import clip_

        if self.max_grad_norm is None:
            return None
        parameters = [p for group in self.optimizer.param_groups for p in group["params"]]
        return clip_(parameters, self.max_grad_norm)

    def save_checkpoint(
        self,
        run_dir: Path,
        global_step: int,
        epoch: int,
        train_loss: float | None = None,
        only_trainable: bool = True,
    ) -> Path | None:
        """Save ``run_dir/checkpoints/step-…``; called on every rank.

        Args:
            run_dir: the work dir.
            global_step: optimizer steps done.
            epoch: whole epochs done.
            train_loss: of the last step.
            only_trainable: leave out frozen weights whose module names their ``frozen_source``.

        Raises:
            RunFailed: it cannot be written; the earlier ones are as they were.
        """
        from fluxvla_core.train.saving import save_snapshot, take_snapshot

        path = save_snapshot(
            self.world,
            Path(run_dir),
            global_step,
            epoch,
            take_snapshot(self, train_loss, only_trainable),
            self.options.max_keep_ckpts,
            self.context.reporter.warn,
        )
        if self.world.first:
            self.context.reporter.artifact("checkpoint", path)
            self.hooks.call("checkpoint_saved", path=path, step=global_step)
        return path

    def _load_model_state(self, state: Mapping[str, Tensor]) -> None:
        """Put a checkpoint's weights, whole and by name, into the model; all of them fit."""
        from fluxvla_core.train.weights import put_model_tensors

        put_model_tensors(self.model, state)

    def _load_optimizer_state(self, state: dict[str, Any]) -> bool:
        """Take an optimizer's state in the form of its ``state_dict``; whether it was taken."""
        self.optimizer.load_state_dict(state)
        return True

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

    # What is the same for all.

    def run(self, vla_dataset: Any) -> Path:
        """Train on ``vla_dataset`` (``get_sample(index, epoch)``, ``__len__``) to the end.

        Returns:
            The work dir, with the last checkpoint in it.

        Raises:
            KeyboardInterrupt: after SIGINT, with everything saved.
            RunFailed: after SIGTERM, with everything saved; a loss that is not finite; another
                rank that was lost; a checkpoint that could not be written.
            CheckpointError, ConfigError, DataError: the inputs do not fit.
        """
        from fluxvla_core.train import distributed
        from fluxvla_core.train.loop import begin
        from fluxvla_core.train.progress import Progress
        from fluxvla_core.train.stop import StopRequest, stopped

        self._prepare()
        self.progress = Progress()
        outcome = "failed"
        try:
            with StopRequest(self.world) as stop:
                self._loop = begin(self, vla_dataset, stop)
                steps = self.max_steps is not None
                number = self._run_step_based() if steps else self._run_epoch_based()
                self.loop.save()
            outcome = "interrupted" if number else "ok"
        except RuntimeError as error:
            lost = distributed.explain(error, self.world, self.progress.step + 1)
            if lost is None:
                raise
            raise lost from error
        finally:
            if self._loop is not None:
                self._loop.close()
            if self.world.first:
                self.metric.finalize()
            self.hooks.call("run_finished", outcome=outcome)
            distributed.stop(self.world, failed=outcome == "failed")
        if number:
            raise stopped(number, f"step {self.progress.step} in {self.context.work_dir}")
        return self.context.work_dir

    @property
    def world(self) -> World:
        """This process among those that train; known from ``_build_vla`` on."""
        if self._world is None:
            raise RuntimeError("the world is known from _build_vla on")
        return self._world

    @property
    def loop(self) -> StepLoop:
        """The loop of the present ``run``."""
        if self._loop is None:
            raise RuntimeError("there is a loop only inside run()")
        return self._loop

    @property
    def model(self) -> nn.Module:
        """The model without what trains it around it."""
        return self._unwrap(self.vla)

    @property
    def compute_dtype(self) -> torch.dtype | None:
        """What the forward pass computes in; None for the weights' own fp32."""
        from fluxvla_core.train.precision import compute_dtype

        options = self.options
        return compute_dtype(options.enable_mixed_precision_training, options.mixed_precision_dtype)

    @property
    def total_steps(self) -> int:
        """Optimizer steps of the whole run."""
        return self._total(self.plan)

    def _prepare(self) -> None:
        """Join the other ranks, see that checkpoints can be written, choose one to go on from."""
        from fluxvla_core.train import distributed
        from fluxvla_core.train.resuming import choose

        if self._world is not None:
            return
        self._world = distributed.start(self.options.device, self.needs_process_group)
        wanted = self.context.resume or self.options.resume_from
        self._checkpoint = choose(self._world, self.context, wanted)

    def _plan(self, samples: int) -> StepPlan:
        from fluxvla_core.train.batches import StepPlan

        return StepPlan(
            samples,
            self.loader_options.per_device_batch_size,
            self.options.grad_accumulation_steps,
            self.world.size,
            self.options.seed,
        )

    def _total(self, plan: StepPlan) -> int:
        return self.max_steps or plan.steps_per_epoch * (self.max_epochs or 0)

    def _steps_due(self) -> bool:
        every = self.options.save_steps
        return every is not None and self.progress.step % every == 0
