"""``BaseTrainRunner``: a training run from its config to its end; trains on one process.

``strategy.py`` has the methods that training strategies override, ``trainer.py`` the loop,
``options.py`` the settings. Nothing here imports torch before it is used: a config is checked
without it.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from fluxvla_core.build import (
    RunContext,
    bind_options,
    build_collator_from_cfg,
    build_metric_from_cfg,
    build_optimizer_from_cfg,
    build_tokenizer_from_cfg,
    build_vla_from_cfg,
)
from fluxvla_core.errors import ConfigError, RunFailed, located
from fluxvla_core.hooks import build_hooks
from fluxvla_core.training.options import LoaderOptions, TrainOptions
from fluxvla_core.training.strategy import Strategy

if TYPE_CHECKING:
    from torch import nn

    from fluxvla_core.training.trainer import Trainer


class BaseTrainRunner(Strategy):
    """The training loop with everything around it; works as it is on one process.

    Called as ``run_setup(n_train_examples)`` and then ``run(dataset)``. Batch size and loader
    workers are ``per_device_batch_size`` and ``per_device_num_workers`` of the config's
    ``train_dataloader``.

    Args:
        cfg: the whole config tree; filled in by the builder.
        context: the run; filled in by the builder.
        options: the settings, by the fields of ``TrainOptions``.

    Raises:
        ConfigError: an invalid setting, with its place.
    """

    api: ClassVar[str] = "1.0"
    Options: ClassVar[type[TrainOptions]] = TrainOptions
    """The settings: its fields are the constructor's further keywords."""
    needs_process_group: ClassVar[bool] = False
    """Whether the strategy needs torch's process group on a single process too."""

    _trainer: Trainer | None = None

    def __init__(
        self,
        *,
        cfg: Mapping[str, Any] | None = None,
        context: RunContext | None = None,
        **options: Any,
    ) -> None:
        self.context = context or RunContext(config=cfg or {}, section="runner")
        self.cfg: Mapping[str, Any] = self.context.config if cfg is None else cfg
        name = type(self).__name__
        self.options = given = bind_options(self.Options, options, name, self.context)
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
        from fluxvla_core.training.failures import explain
        from fluxvla_core.training.state import Progress
        from fluxvla_core.training.stop import StopRequest, stopped
        from fluxvla_core.training.trainer import Trainer

        self._join()
        self.progress = Progress()
        outcome = "failed"
        # Until everything is closed: what the run has saved is not to be lost by a signal.
        with StopRequest(self.world, self.check_work_dir) as stop:
            try:
                self._trainer = Trainer(self, vla_dataset, stop)
                signal = (
                    self._run_epoch_based() if self.max_steps is None else self._run_step_based()
                )
                self._trainer.save()
                self.finish_pending_save()
                self.late_stop = stop.poll_now()
                outcome = "interrupted" if signal else "ok"
            except (RuntimeError, MemoryError, OSError, RunFailed) as error:
                self.check_work_dir()
                if isinstance(error, RunFailed):
                    raise
                known = explain(error, self.progress.step + 1, self.world)
                if known is None:
                    raise
                raise known from error
            finally:
                self._close(outcome)
        if signal:
            raise stopped(signal, f"step {self.progress.step} in {self.context.work_dir}")
        self.late_stop = self.late_stop or stop.received
        return self.context.work_dir

    def _close(self, outcome: str) -> None:
        """End what the run has started, whatever ended it."""
        from fluxvla_core.training import distributed

        if self._trainer is not None:
            self._trainer.close()
        if self.saver is not None:
            self.saver.close()
        if self.world.is_rank0:
            self.metric.finalize()
        self.hooks.call("run_finished", outcome=outcome)
        if self._work_dir_lock is not None:
            self._work_dir_lock.close()
        distributed.stop(self.world, failed=outcome == "failed")

    def run_setup(self, n_train_examples: int) -> None:
        """Join the other ranks, choose a checkpoint to resume from, build model and optimizer.

        The checkpoint is loaded by ``Trainer``, once the dataset is known.

        Args:
            n_train_examples: samples in the dataset; with the batch size, an epoch's steps.
        """
        self._join()
        self.vla = self._build_vla()
        self.vla = self._wrap_model(self.vla)
        self.optimizer = self._build_optimizer()
        self.lr_scheduler = self._build_lr_scheduler(n_train_examples)

    def _build_vla(self) -> nn.Module:
        """The config's ``model``, from equal weights on every rank, as the settings have it."""
        from fluxvla_core.contracts.training import VLA
        from fluxvla_core.training import lora
        from fluxvla_core.training.cost import Meter
        from fluxvla_core.training.fit_checks import check_start
        from fluxvla_core.training.model import checkpoint_activations, compile_units
        from fluxvla_core.training.part_weights import load_part_weights
        from fluxvla_core.training.state import seed_all
        from fluxvla_core.training.weights import adapter_base_to_record, start_training_with

        # For a ``run_setup`` that calls this method alone.
        self._join()
        if "model" not in self.cfg:
            raise ConfigError(
                "the config has no 'model' to train",
                where=self.context.config_file,
                next="model = dict(type='CompactVLA', …); fluxvla plugins list has what there is",
            )
        seed_all(self.options.seed)
        check_start(self.context, self.options.init_from, self.resume_checkpoint)
        with located(self.context.where("model")):
            vla: nn.Module = build_vla_from_cfg(self.cfg["model"], self.context)
        options, before = self.options, self.resume_checkpoint
        init_from = options.init_from or VLA.adapt(vla).pretrained_name_or_path
        own = options.init_from is None
        asked = "model.pretrained_name_or_path" if own else f"{self.context.section}.init_from"
        if init_from is None and before is None:
            load_part_weights(vla, VLA.adapt(vla).part_weights)
        with located(self.context.where(asked)):
            start_training_with(vla, init_from, before, self.lora is not None, self.world)
        if self.lora is not None:
            self.adapter_base = adapter_base_to_record(before, init_from)
            where = self.context.where(f"{self.context.section}.lora")
            self.lora = lora.attach(vla, self.lora, where)
        self.flops = Meter.of(vla, self.world.device, self.compute_dtype, options.peak_tflops)
        if options.enable_gradient_checkpointing:
            checkpoint_activations(vla)
        if options.compile_blocks:
            compile_units(vla)
        return vla

    def _build_lr_scheduler(self, n_train_examples: int) -> Any:
        """The schedule over all steps of the run; has ``step`` and a JSON ``state_dict``."""
        from fluxvla_core.training.optimizers import ScheduledLR, make_schedule

        options = self.options
        schedule = make_schedule(
            options.lr_scheduler_type,
            options.learning_rate,
            self.plan_steps(n_train_examples).total_steps(self.max_steps, self.max_epochs),
            options.warmup_ratio,
            options.lr_schedule,
        )
        return ScheduledLR(self.optimizer, schedule, options.learning_rate)

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

    @property
    def trainer(self) -> Trainer:
        """The loop of the present ``run``."""
        if self._trainer is None:
            raise RuntimeError("there is a trainer only inside run()")
        return self._trainer

    def _steps_due(self) -> bool:
        every = self.options.save_steps
        return every is not None and self.progress.step % every == 0

    def _join(self) -> None:
        """Join the other ranks, lock the work dir, choose a checkpoint to resume from; once."""
        from fluxvla_core.training import distributed
        from fluxvla_core.training.resuming import choose_checkpoint

        if self._world is not None:
            return
        self._world = distributed.start(self.options.device, self.needs_process_group)
        distributed.run_on_rank0(self._world, self._own_work_dir)
        configured = self.options.resume_from
        wanted = self.context.resume or configured
        self.resume_checkpoint = choose_checkpoint(
            self._world, self.context, wanted, first=configured
        )

    def _own_work_dir(self) -> str:
        """Make the work dir's folder of checkpoints, and keep other trainings out; on rank 0 only.

        Raises:
            UsageError: it cannot be written, or another training is using it.
        """
        from fluxvla_core.atomic import prepare_folder
        from fluxvla_core.checkpoints.lock import lock_work_dir
        from fluxvla_core.checkpoints.manifest import FOLDER

        work_dir = self.context.work_dir
        what, advice = (
            "folder of the checkpoints",
            "name a folder that can be written: --work-dir DIR",
        )
        prepare_folder(work_dir / FOLDER, what, next=advice)
        self._work_dir_lock = lock_work_dir(work_dir, self.context.reporter.warn)
        return ""

    def check_work_dir(self) -> None:
        """Raise an error if the work dir is no longer this run's; the first rank has the lock.

        Raises:
            RunFailed: it was removed, moved or replaced.
        """
        if self._work_dir_lock is not None:
            self._work_dir_lock.check()
