"""``BaseTrainRunner``: trains on one process, and is what every strategy builds on.

The loop itself is in ``trainer.py``, the settings in ``options.py``. A strategy overrides
:meth:`BaseTrainRunner._wrap_model` and, where it must, ``unwrap_model``, ``sync_gradients``,
``backward``, ``optimizer_step``, ``clip_grad_norm`` and how tensors are saved and loaded. Nothing
here imports torch before it is used: a config is checked without it.
"""

from __future__ import annotations

import inspect
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
from fluxvla_core.training.options import LoaderOptions, TrainOptions

if TYPE_CHECKING:
    import torch
    from torch import Tensor, nn

    from fluxvla_core.checkpoints.checkpoint import Checkpoint
    from fluxvla_core.checkpoints.owner import Claim
    from fluxvla_core.checkpoints.parts import Stored
    from fluxvla_core.data.sampler import EpisodeShards
    from fluxvla_core.training.batches import StepPlan
    from fluxvla_core.training.distributed import World
    from fluxvla_core.training.ema import Ema
    from fluxvla_core.training.flops import Meter
    from fluxvla_core.training.model import ForwardArguments
    from fluxvla_core.training.saving import Saver
    from fluxvla_core.training.state import Progress
    from fluxvla_core.training.trainer import Trainer
    from fluxvla_core.training.weights import LeftOut


class BaseTrainRunner:
    """The training loop with everything around it; works as it is on one process.

    Called as ``run_setup(n_train_examples)`` and then ``run(dataset)``. Batch size and loader
    workers are ``per_device_batch_size`` and ``per_device_num_workers`` of the config's
    ``train_dataloader``.

    Args:
        cfg: the whole config tree; filled in by the builder.
        context: the run; filled in by the builder.
        options: the settings, by the fields of ``TrainOptions``.

    Raises:
        ConfigError: a setting that cannot be meant, with its place.
    """

    api: ClassVar[str] = "1.0"
    Options: ClassVar[type[TrainOptions]] = TrainOptions
    """The settings: its fields are the constructor's further keywords."""
    needs_process_group: ClassVar[bool] = False
    """Whether the strategy needs torch's process group on a single process too."""

    # Known from run_setup on.
    vla: Any = None
    optimizer: Any = None
    lr_scheduler: Any = None
    flops: Meter | None = None
    adapter_base: str | None = None
    left_out: LeftOut | None = None
    # Known inside run().
    dataset: Any = None
    plan: StepPlan
    progress: Progress
    ema: Ema | None = None
    sample_losses: Tensor | None = None
    late_stop: int = 0
    """The signal that asked for a stop when training was complete: nothing new is to begin."""
    _world: World | None = None
    _claim: Claim | None = None
    _checkpoint: Checkpoint | None = None
    _arguments: ForwardArguments | None = None
    _trainer: Trainer | None = None
    _saver: Saver | None = None

    def __init__(
        self,
        *,
        cfg: Mapping[str, Any] | None = None,
        context: RunContext | None = None,
        **options: Any,
    ) -> None:
        self.context = context or RunContext(config=cfg or {}, section="runner")
        self.cfg: Mapping[str, Any] = self.context.config if cfg is None else cfg
        try:
            bound = inspect.signature(self.Options).bind(**options)
        except TypeError as error:
            raise ConfigError(
                f"{type(self).__name__}: {error}",
                where=self.context.where(self.context.section),
                next=f"fluxvla plugins show {type(self).__name__}",
            ) from error
        self.options = given = self.Options(*bound.args, **bound.kwargs)
        given.check(self.context)
        self.loader_options = LoaderOptions.read(self.cfg, self.context)
        self.lora = given.lora_options(self.context)
        self.val_options = LoaderOptions.for_validation(self.cfg, self.context, given)
        self.learning_rate, self.weight_decay = given.learning_rate, given.weight_decay
        self.max_grad_norm = given.max_grad_norm
        self.max_epochs, self.max_steps = given.max_epochs, given.max_steps
        self.collator = build_collator_from_cfg(given.collator, self.context)
        self.tokenizer = build_tokenizer_from_cfg(given.tokenizer, self.context)
        self.metric = build_metric_from_cfg(
            {"type": "VLAMetric"} if given.metric is None else given.metric, self.context
        )
        self.optimizer_settings = build_optimizer_from_cfg(
            {"type": "AdamW"} if given.optimizer is None else given.optimizer, self.context
        )
        self.hooks = build_hooks(self.context)

    def run(self, vla_dataset: Any) -> Path:
        """Train on ``vla_dataset`` (``get_sample(index, epoch)``, ``__len__``) to the end.

        Returns:
            The work dir, with the last checkpoint in it.

        Raises:
            KeyboardInterrupt: after SIGINT, with everything saved.
            RunFailed: after SIGTERM or SIGHUP, with everything saved; a loss that is not finite;
                another rank that was lost; a checkpoint that could not be written; memory that
                ran out; a work dir that was removed, or replaced by another.
            CheckpointError, ConfigError, DataError: the inputs do not fit.
        """
        from fluxvla_core.training.trainer import train

        return train(self, vla_dataset)

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
        from fluxvla_core.training import flops, lora
        from fluxvla_core.training.model import checkpoint_activations, compile_units
        from fluxvla_core.training.state import seed_all
        from fluxvla_core.training.weights import base_to_note, start_training_from

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
        start_training_from(vla, options.init_from, before, self.lora is not None, self.world)
        if self.lora is not None:
            self.adapter_base = base_to_note(before, options.init_from)
            lora.attach(vla, self.lora, self.context.where(f"{self.context.section}.lora"))
        self.flops = flops.Meter.of(vla, self.world.device, self.compute_dtype, options.peak_tflops)
        if options.enable_gradient_checkpointing:
            checkpoint_activations(vla)
        if options.compile_blocks:
            compile_units(vla)
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

    def unwrap_model(self, vla: nn.Module) -> nn.Module:
        """The model inside what ``_wrap_model`` returned, with the names that are saved."""
        from torch.nn.parallel import DistributedDataParallel

        return vla.module if isinstance(vla, DistributedDataParallel) else vla

    def _build_optimizer(self) -> torch.optim.Optimizer:
        """The config's ``optimizer``, with weight decay on matrices only."""
        from fluxvla_core.training.optim import decay_groups

        groups = decay_groups(self.model, self.weight_decay)
        built: torch.optim.Optimizer = self.optimizer_settings.build(groups, self.learning_rate)
        return built

    def _build_lr_scheduler(self, n_train_examples: int) -> Any:
        """The schedule over all steps of the run; has ``step`` and a JSON ``state_dict``."""
        from fluxvla_core.training.optim import ScheduledLR
        from fluxvla_core.training.schedule import make_schedule

        options = self.options
        schedule = make_schedule(
            options.lr_scheduler_type,
            options.learning_rate,
            self.plan_steps(n_train_examples).total_steps(self.max_steps, self.max_epochs),
            options.warmup_ratio,
            options.lr_schedule,
        )
        return ScheduledLR(self.optimizer, schedule, options.learning_rate)

    def _training_step(self, batch: dict[str, Any]) -> Tensor:
        """Forward pass of one batch on the device: its loss, a scalar with a gradient."""
        from fluxvla_core.training.model import autocast, loss_of, sample_losses_of

        if self._arguments is None:
            raise RuntimeError("a batch's arguments are known inside run() only")
        with autocast(self.world.device, self.compute_dtype):
            output = self.vla(**self._arguments(batch))
        self.sample_losses = sample_losses_of(output)
        return loss_of(output, self.model)

    def sync_gradients(self, last: bool) -> AbstractContextManager[object]:
        """Entered for each batch of a step; only the ``last`` one exchanges gradients."""
        return nullcontext()

    def backward(self, loss: Tensor) -> None:
        """Backward pass of one batch; ``loss`` is divided by the number of batches already."""
        loss.backward()  # type: ignore[no-untyped-call]

    def optimizer_step(self) -> Tensor | None:
        """Clip, and let the optimizer step; the gradients' norm before, on the device.

        Where ``clip_grad_norm`` tells none it is the norm of what the optimizer uses: gradients
        that are not finite must not go unseen.
        """
        from fluxvla_core.training.optim import gradient_norm

        norm = self.clip_grad_norm()
        if norm is None:
            norm = gradient_norm(self._optimized())
        self.optimizer.step()
        return norm

    def warm_up(self, batch: dict[str, Any]) -> None:
        """Called with the first batch, before the first step; must leave no trace."""

    def clip_grad_norm(self) -> Tensor | None:
        """Scale the gradients down to ``max_grad_norm``; their norm before, on the device.

        None says nothing of the norm, as where there is no ``max_grad_norm``.
        """
        from fluxvla_core.training.optim import clip_

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
        from fluxvla_core.training.saving import Saver, save_snapshot, take_snapshot

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

    def settle_saves(self, wait: bool = True) -> None:
        """Learn what became of the checkpoint that is being written; called on every rank.

        Args:
            wait: for its end; otherwise nothing happens while some rank still writes.

        Raises:
            RunFailed: it could not be written; the earlier ones are as they were.
        """
        saved = self._saver.settle(wait) if self._saver is not None else None
        if saved is None or not self.world.first:
            return
        from fluxvla_core.checkpoints.directory import name_best

        for warning in saved.warnings:
            self.context.reporter.warn(warning)
        if saved.step == self.progress.best_step:
            name_best(saved.path.parent.parent, saved.step)
        self.context.reporter.artifact("checkpoint", saved.path)
        self.hooks.call("checkpoint_saved", path=saved.path, step=saved.step)

    def _load_model_state(self, state: Mapping[str, Tensor]) -> None:
        """Put a checkpoint's weights, whole and by name, into the model; all of them fit."""
        from fluxvla_core.training.weights import put_model_tensors

        put_model_tensors(self.model, state)

    def _load_optimizer_state(self, state: dict[str, Any]) -> bool:
        """Take an optimizer's state in the form of its ``state_dict``; whether it was taken."""
        self.optimizer.load_state_dict(state)
        return True

    def model_tensors(self) -> Mapping[str, Tensor]:
        """Weights and buffers by name, to be saved; parts of them where they are sharded."""
        from fluxvla_core.training.weights import model_tensors

        return model_tensors(self.model)

    def optimizer_tensors(self) -> tuple[Mapping[str, Tensor], dict[str, Any]]:
        """The optimizer's state by ``<parameter>/<key>``, and JSON values of the rest of it."""
        from fluxvla_core.training.optim import named_state

        return named_state(self.model, self.optimizer)

    def load_optimizer_tensors(
        self, tensors: Mapping[str, Tensor | Stored], described: Mapping[str, Any], where: str
    ) -> bool:
        """The inverse of :meth:`optimizer_tensors`, by way of :meth:`_load_optimizer_state`."""
        from fluxvla_core.training.optim import torch_state

        state = torch_state(self.model, self.optimizer, tensors, described, where)
        return self._load_optimizer_state(state)

    def resume(self) -> int:
        """Resume from the chosen checkpoint; the step it was saved at, 0 for a fresh start.

        Raises:
            CheckpointError: it is of another model, optimizer, dataset or seed.
        """
        from fluxvla_core.training.resuming import restore

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

        return self.trainer.run(lambda: progress.cursor.epoch >= (epochs or 0), due)

    def _run_step_based(self) -> int:
        """Steps until ``max_steps`` are done; the signal that ended them early, or 0."""
        steps = self.max_steps or 0
        return self.trainer.run(lambda: self.progress.step >= steps, self._steps_due)

    # What the run knows of itself.

    @property
    def world(self) -> World:
        """This process among those that train; known from ``_build_vla`` on."""
        if self._world is None:
            raise RuntimeError("the world is known from _build_vla on")
        return self._world

    @property
    def trainer(self) -> Trainer:
        """The loop of the present ``run``."""
        if self._trainer is None:
            raise RuntimeError("there is a trainer only inside run()")
        return self._trainer

    @property
    def model(self) -> nn.Module:
        """The model without what trains it around it."""
        return self.unwrap_model(self.vla)

    @property
    def compute_dtype(self) -> torch.dtype | None:
        """What the forward pass computes in; None for the weights' own fp32."""
        from fluxvla_core.training.model import compute_dtype

        options = self.options
        return compute_dtype(options.enable_mixed_precision_training, options.mixed_precision_dtype)

    @property
    def total_steps(self) -> int:
        """Optimizer steps of the whole run: those done, which may have been of another size, and
        those left."""
        done, cursor = self.progress.step, self.progress.cursor
        return done + self.plan.run_steps_left(done, cursor, self.max_steps, self.max_epochs)

    def plan_steps(self, samples: int, shards: EpisodeShards | None = None) -> StepPlan:
        """How epochs of so many samples are cut into steps."""
        from fluxvla_core.training.batches import StepPlan

        return StepPlan(
            samples,
            self.loader_options.per_device_batch_size,
            self.options.grad_accumulation_steps,
            self.world.size,
            self.options.seed,
            shards,
        )

    def _steps_due(self) -> bool:
        every = self.options.save_steps
        return every is not None and self.progress.step % every == 0

    def _prepare(self) -> None:
        """Join the other ranks, take over the work dir, choose a checkpoint to resume from."""
        from fluxvla_core.training import distributed
        from fluxvla_core.training.resuming import choose, take_over

        if self._world is not None:
            return
        self._world = distributed.start(self.options.device, self.needs_process_group)
        self._claim = take_over(self._world, self.context)
        configured = self.options.resume_from
        wanted = self.context.resume or configured
        self._checkpoint = choose(self._world, self.context, wanted, first=configured)

    def check_work_dir(self) -> None:
        """See that the work dir is still this run's; the first rank has the claim.

        Raises:
            RunFailed: it was removed, moved or replaced.
        """
        if self._claim is not None:
            self._claim.check()
