"""What every train runner does the same way: the frame of a run, and what it knows of itself."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, cast

from fluxvla_core.build import RunContext
from fluxvla_core.errors import ConfigError
from fluxvla_core.train.options import LoaderOptions, TrainOptions

if TYPE_CHECKING:
    import torch
    from torch import Tensor, nn

    from fluxvla_core.checkpoints.checkpoint import Checkpoint
    from fluxvla_core.checkpoints.owner import Claim
    from fluxvla_core.data.order import EpisodeShards
    from fluxvla_core.hooks import HookCaller
    from fluxvla_core.train.batches import StepPlan
    from fluxvla_core.train.distributed import World
    from fluxvla_core.train.ema import Ema
    from fluxvla_core.train.flops import Meter
    from fluxvla_core.train.forward import ForwardArguments
    from fluxvla_core.train.loop import StepLoop
    from fluxvla_core.train.lora import LoraOptions
    from fluxvla_core.train.progress import Progress
    from fluxvla_core.train.saver import Saver
    from fluxvla_core.train.strategy import Strategy
    from fluxvla_core.train.weights import LeftOut


class TrainRun:
    """The part of ``BaseTrainRunner`` that no strategy overrides."""

    cfg: Mapping[str, Any]
    context: RunContext
    options: TrainOptions
    loader_options: LoaderOptions
    val_options: LoaderOptions | None
    lora: LoraOptions | None
    max_epochs: int | None
    max_steps: int | None
    metric: Any
    hooks: HookCaller
    plan: StepPlan
    progress: Progress
    needs_process_group: ClassVar[bool]
    vla: Any = None
    optimizer: Any = None
    lr_scheduler: Any = None
    dataset: Any = None
    ema: Ema | None = None
    left_out: LeftOut | None = None
    adapter_base: str | None = None
    flops: Meter | None = None
    sample_losses: Tensor | None = None
    late_stop: int = 0
    """The signal that asked for a stop when training was complete: nothing new is to begin."""
    _world: World | None = None
    _claim: Claim | None = None
    _checkpoint: Checkpoint | None = None
    _arguments: ForwardArguments | None = None
    _loop: StepLoop | None = None
    _saver: Saver | None = None

    if TYPE_CHECKING:

        def _unwrap(self, vla: nn.Module) -> nn.Module: ...
        def _run_epoch_based(self) -> int: ...
        def _run_step_based(self) -> int: ...

    def run(self, vla_dataset: Any) -> Path:
        """Train on ``vla_dataset`` (``get_sample(index, epoch)``, ``__len__``) to the end.

        Returns:
            The work dir, with the last checkpoint in it.

        Raises:
            KeyboardInterrupt: after SIGINT, with everything saved.
            RunFailed: after SIGTERM, with everything saved; a loss that is not finite; another
                rank that was lost; a checkpoint that could not be written; memory that ran out.
            CheckpointError, ConfigError, DataError: the inputs do not fit.
        """
        from fluxvla_core.train import distributed, memory
        from fluxvla_core.train.loop import begin
        from fluxvla_core.train.progress import Progress
        from fluxvla_core.train.stop import StopRequest, stopped

        self._prepare()
        self.progress = Progress()
        outcome = "failed"
        try:
            with StopRequest(self.world) as stop:
                self._loop = begin(cast("Strategy", self), vla_dataset, stop)
                steps = self.max_steps is not None
                number = self._run_step_based() if steps else self._run_epoch_based()
                self.loop.save()
                self.settle_saves()
                self.late_stop = stop.asked()
            outcome = "interrupted" if number else "ok"
        except (RuntimeError, MemoryError, OSError) as error:
            step = self.progress.step + 1
            known = memory.explain(error, step) or distributed.explain(error, self.world, step)
            if known is None:
                raise
            raise known from error
        finally:
            if self._loop is not None:
                self._loop.close()
            if self._saver is not None:
                self._saver.close()
            if self.world.first:
                self.metric.finalize()
            self.hooks.call("run_finished", outcome=outcome)
            if self._claim is not None:
                self._claim.close()
            distributed.stop(self.world, failed=outcome == "failed")
        if number:
            raise stopped(number, f"step {self.progress.step} in {self.context.work_dir}")
        return self.context.work_dir

    def settle_saves(self, wait: bool = True) -> None:
        """Take note of what became of the checkpoint on its way; called on every rank.

        Args:
            wait: for its end; otherwise nothing happens while some rank still writes.

        Raises:
            RunFailed: it could not be written; the earlier ones are as they were.
        """
        from fluxvla_core.checkpoints.shelf import name_best

        saved = self._saver.settle(wait) if self._saver is not None else None
        if saved is None or not self.world.first:
            return
        for warning in saved.warnings:
            self.context.reporter.warn(warning)
        if saved.step == self.progress.best_step:
            name_best(saved.path.parent.parent, saved.step)
        self.context.reporter.artifact("checkpoint", saved.path)
        self.hooks.call("checkpoint_saved", path=saved.path, step=saved.step)

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
        """Optimizer steps of the whole run: those done, which may have been of another size, and
        those left."""
        return self.progress.step + self._steps_left()

    @property
    def planned_step(self) -> int:
        """Which of the steps that the schedule was made for comes next."""
        return self._total(self.plan) - self._steps_left()

    def _prepare(self) -> None:
        """Join the other ranks, take over the work dir, choose a checkpoint to go on from."""
        from fluxvla_core.train import distributed
        from fluxvla_core.train.resuming import choose, take_over

        if self._world is not None:
            return
        self._world = distributed.start(self.options.device, self.needs_process_group)
        self._claim = take_over(self._world, self.context)
        configured = self.options.resume_from
        wanted = self.context.resume or configured
        self._checkpoint = choose(self._world, self.context, wanted, first=configured)

    def _plan(self, samples: int, shards: EpisodeShards | None = None) -> StepPlan:
        from fluxvla_core.train.batches import StepPlan

        return StepPlan(
            samples,
            self.loader_options.per_device_batch_size,
            self.options.grad_accumulation_steps,
            self.world.size,
            self.options.seed,
            shards,
        )

    def _shards(self, dataset: Any) -> EpisodeShards | None:
        """How ``shuffle_episodes`` of the ``train_dataloader`` cuts the dataset.

        Raises:
            ConfigError: the dataset does not say where its episodes end.
        """
        from fluxvla_core.data.order import EpisodeShards

        together = self.loader_options.shuffle_episodes
        if together is None:
            return None
        where = self.context.where("train_dataloader.shuffle_episodes")
        ends = getattr(dataset, "episode_ends", None)
        if ends is None:
            raise ConfigError(
                f"{type(dataset).__name__} does not say where its episodes end, so "
                "shuffle_episodes cannot be used with it",
                where=where,
                next="remove shuffle_episodes: all samples are then mixed",
            )
        return EpisodeShards(ends, together)

    def _total(self, plan: StepPlan) -> int:
        return self.max_steps or plan.steps_per_epoch * (self.max_epochs or 0)

    def _steps_left(self) -> int:
        if self.max_steps is not None:
            return max(0, self.max_steps - self.progress.step)
        cursor = self.progress.cursor
        epochs = (self.max_epochs or 0) - cursor.epoch
        after = (epochs - 1) * self.plan.steps_per_epoch
        return self.plan.steps_left(cursor) + after if epochs > 0 else 0

    def _steps_due(self) -> bool:
        every = self.options.save_steps
        return every is not None and self.progress.step % every == 0
