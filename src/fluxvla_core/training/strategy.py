"""``Strategy``: the state of a training run, and the parts of a step that strategies override.

The loop in ``trainer.py`` calls these methods; ``BaseTrainRunner``, which is built from a config,
inherits them. Nothing here imports torch before it is used: a config is checked without it.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fluxvla_core.build import RunContext
from fluxvla_core.contracts.runner import TrainRunner
from fluxvla_core.errors import CheckpointError, ConfigError
from fluxvla_core.hooks import HookCaller
from fluxvla_core.training.lora import LoraOptions
from fluxvla_core.training.options import LoaderOptions, TrainOptions

if TYPE_CHECKING:
    import torch
    from torch import Tensor, nn

    from fluxvla_core.checkpoints.checkpoint import Checkpoint
    from fluxvla_core.checkpoints.lock import WorkDirLock
    from fluxvla_core.checkpoints.shards import Stored
    from fluxvla_core.data.sampler import EpisodeShards, StepPlan
    from fluxvla_core.training.cost import Meter
    from fluxvla_core.training.distributed import World
    from fluxvla_core.training.model import ForwardArguments, Layout
    from fluxvla_core.training.saving import Saver, Snapshot
    from fluxvla_core.training.state import Ema, Progress
    from fluxvla_core.training.weights import ExternalWeights

_NO_CONTEXT = nullcontext()


class Strategy(TrainRunner):
    """Training strategy: puts a model on its devices, trains and saves it; here on one process."""

    # Set by the constructor of BaseTrainRunner.
    context: RunContext
    options: TrainOptions
    loader_options: LoaderOptions
    val_options: LoaderOptions | None
    lora: LoraOptions | None
    weight_decay: float
    learning_rate: float
    max_grad_norm: float | None
    max_epochs: int | None
    max_steps: int | None
    collator: Any
    tokenizer: Any
    metric: Any
    optimizer_settings: Any
    hooks: HookCaller
    # Known from run_setup on.
    vla: Any = None
    optimizer: Any = None
    lr_scheduler: Any = None
    flops: Meter | None = None
    adapter_base: str | None = None
    external_weights: ExternalWeights | None = None
    """Frozen weights that checkpoints do not contain; found when the training begins."""
    resume_checkpoint: Checkpoint | None = None
    """The checkpoint that the run resumes from; None for a fresh start."""
    val_dataset: Any = None
    """The dataset of ``val_dataloader``, if it was built before ``run``, which builds it else."""
    # Known inside run().
    dataset: Any = None
    plan: StepPlan
    progress: Progress
    ema: Ema | None = None
    sample_losses: Tensor | None = None
    late_stop: int = 0
    """The signal that asked for a stop when training was complete: nothing new is to begin."""
    forward_arguments: ForwardArguments | None = None
    """Makes the arguments of the model's ``forward`` from a batch."""
    saver: Saver | None = None
    """Writes checkpoints; a strategy that saves outside ``run()`` gets one that waits."""
    _world: World | None = None
    _work_dir_lock: WorkDirLock | None = None

    # Where the model trains.

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

    def memory_layout(self, model: nn.Module, processes: int, device_type: str) -> Layout:
        """Memory layout of ``model`` on one of ``processes``, for the estimate of a dry run.

        Here everything, as where ``_wrap_model`` copies the model. A strategy that divides it
        overrides this. Nothing is allocated, no process group is there.

        Args:
            model: on the meta device, before ``_wrap_model``.
            processes: that train, all on one machine.
            device_type: ``cuda`` or ``cpu``.
        """
        from fluxvla_core.training.model import replicated_layout

        return replicated_layout(model)

    def unwrap_model(self, vla: nn.Module) -> nn.Module:
        """The model inside what ``_wrap_model`` returned, with the names that are saved."""
        from torch.nn.parallel import DistributedDataParallel

        return vla.module if isinstance(vla, DistributedDataParallel) else vla

    def _build_optimizer(self) -> torch.optim.Optimizer:
        """The config's ``optimizer``, with weight decay on matrices only."""
        from fluxvla_core.training.model import decay_groups

        groups = decay_groups(self.model, self.weight_decay)
        built: torch.optim.Optimizer = self.optimizer_settings.build(groups, self.learning_rate)
        return built

    # One optimizer step.

    def _training_step(self, batch: dict[str, Any]) -> Tensor:
        """Forward pass of one batch on the device: its loss, a scalar with a gradient."""
        from fluxvla_core.training.model import autocast, loss_of, sample_losses_of

        if self.forward_arguments is None:
            raise RuntimeError("a batch's arguments are known inside run() only")
        with autocast(self.world.device, self.compute_dtype):
            output = self.vla(**self.forward_arguments(batch))
        self.sample_losses = sample_losses_of(output)
        return loss_of(output, self.forward_arguments.model_name)

    def sync_gradients(self, last: bool) -> AbstractContextManager[object]:
        """Entered for each batch of a step; only the ``last`` one exchanges gradients."""
        return _NO_CONTEXT

    def backward(self, loss: Tensor) -> None:
        """Backward pass of one batch; ``loss`` is divided by the number of batches already."""
        loss.backward()  # type: ignore[no-untyped-call]

    def optimizer_step(self) -> Tensor | None:
        """Clip, and let the optimizer step; the gradients' norm before, on the device.

        Where ``clip_grad_norm`` returns None it is computed here: gradients that are not finite
        must not go unseen.
        """
        from fluxvla_core.training.model import gradient_norm

        norm = self.clip_grad_norm()
        if norm is None:
            norm = gradient_norm(self._optimized())
        self.optimizer.step()
        return norm

    def before_first_step(self, batch: dict[str, Any]) -> None:
        """Called with the first batch, before the first step.

        It must not change weights, buffers, gradients or random states.
        """
        if type(self).warm_up is not Strategy.warm_up:
            message = f"{type(self).__name__}.warm_up is deprecated, call it before_first_step"
            warnings.warn(message, DeprecationWarning, stacklevel=2)
            self.warm_up(batch)

    def warm_up(self, batch: dict[str, Any]) -> None:
        """Deprecated name of :meth:`before_first_step`."""

    @property
    def left_out(self) -> ExternalWeights | None:
        """Deprecated name of :attr:`external_weights`."""
        _warn_of_left_out()
        return self.external_weights

    @left_out.setter
    def left_out(self, found: ExternalWeights | None) -> None:
        _warn_of_left_out()
        self.external_weights = found

    def clip_grad_norm(self) -> Tensor | None:
        """Scale the gradients down to ``max_grad_norm``; their norm before, on the device.

        None says nothing of the norm, as where there is no ``max_grad_norm``.
        """
        from fluxvla_core.training.model import clip_

        return None if self.max_grad_norm is None else clip_(self._optimized(), self.max_grad_norm)

    def _optimized(self) -> list[nn.Parameter]:
        return [p for group in self.optimizer.param_groups for p in group["params"]]

    # Checkpoints.

    def save_checkpoint(
        self,
        run_dir: Path,
        global_step: int,
        epoch: int,
        train_loss: float | None = None,
        only_trainable: bool = True,
    ) -> Path | None:
        """Begin to save ``run_dir/checkpoints/step-…``; called on every rank.

        With ``async_save`` it is there, and known to be, after :meth:`finish_pending_save`.

        Args:
            run_dir: the work dir.
            global_step: optimizer steps done.
            epoch: whole epochs done.
            train_loss: of the last step.
            only_trainable: leave out frozen weights whose module names their ``frozen_source``.

        Raises:
            RunFailed: it cannot be written; the earlier ones are as they were.
        """
        from fluxvla_core.training.saving import Saver, save_snapshot

        if self.saver is None:
            self.saver = Saver(self.world, False)
        path = save_snapshot(
            self.saver,
            Path(run_dir),
            global_step,
            epoch,
            self._snapshot(train_loss, only_trainable),
            self.options.max_keep_ckpts,
            self.progress.best_step,
        )
        if not self.saver.background:
            self.finish_pending_save()
        return path

    def finish_pending_save(self, wait: bool = True) -> None:
        """Finish the pending checkpoint, if there is one: report it or raise; called on every rank.

        Args:
            wait: for its end; otherwise nothing happens while some rank still writes.

        Raises:
            RunFailed: it could not be written; the earlier ones are as they were.
        """
        saved = self.saver.finish_pending(wait) if self.saver is not None else None
        if saved is None or not self.world.is_rank0:
            return
        from fluxvla_core.checkpoints.checkpoint import name_best

        for warning in saved.warnings:
            self.context.reporter.warn(warning)
        if saved.step == self.progress.best_step:
            name_best(saved.path.parent.parent, saved.step)
        self.context.reporter.artifact("checkpoint", saved.path)
        self.hooks.call("checkpoint_saved", path=saved.path, step=saved.step)

    def _snapshot(self, train_loss: float | None, only_trainable: bool) -> Snapshot:
        """The present moment, without :attr:`external_weights` if so asked."""
        from fluxvla_core.training import lora
        from fluxvla_core.training.saving import Snapshot, run_documents, run_folders
        from fluxvla_core.training.state import seeds_of
        from fluxvla_core.training.weights import ExternalWeights

        external = self.external_weights if only_trainable else None
        external = external or ExternalWeights()
        tensors, (optimizer, described) = self.model_tensors(), self.optimizer_tensors()
        adapter = lora.adapter_names(self.model)
        elsewhere = {*external.names, *adapter}
        documents: dict[str, Mapping[str, Any]] = {}
        if self.world.is_rank0:
            documents |= run_documents(self.context, self.dataset, self.model)
        if self.lora is not None:
            documents[lora.CONFIG] = self.lora.for_peft(self.adapter_base)
        return Snapshot(
            model={name: t for name, t in tensors.items() if name not in elsewhere},
            optimizer=optimizer,
            described=described,
            trainer={
                **self.progress.to_dict(),
                "train_loss": train_loss,
                "scheduler": self.lr_scheduler.state_dict(),
                "metric": self.metric.state_dict(),
                "data_seeds": seeds_of(self.dataset),
                **self.plan.to_dict(),
                "left_out": external.to_dict(),
            },
            ema=self.ema,
            adapter={theirs: tensors[name] for name, theirs in adapter.items()},
            documents=documents,
            folders=run_folders(self.dataset, self.tokenizer),
        )

    def resume(self) -> int:
        """Resume from the chosen checkpoint; the step it was saved at, 0 for a fresh start.

        Everything but the random generators is put back: they are last, when all is built.

        Raises:
            CheckpointError: it is of another model, optimizer, dataset, seed or adapter, or one of
                the two keeps averages.
        """
        from fluxvla_core.checkpoints import checkpoint as ckpt
        from fluxvla_core.training import resuming
        from fluxvla_core.training.state import Progress, SavedOptimizer

        checkpoint = self.resume_checkpoint
        if checkpoint is None:
            return 0
        where = str(checkpoint.path)
        saved, notes = resuming.check_settings(
            checkpoint, self.context, self.plan, self.dataset, self.lora, self.options.ema_decay
        )
        for note in notes if self.world.is_rank0 else ():
            self.context.reporter.warn(note)
        self._load_model_state(resuming.load_weights(checkpoint, self.model, self.external_weights))
        described = checkpoint.json(ckpt.OPTIMIZER_META, SavedOptimizer)
        optimizer = checkpoint.optimizer_tensors()
        if self.load_optimizer_tensors(optimizer, described, where) is False:
            raise CheckpointError(
                f"{type(self).__name__} did not take the checkpoint's optimizer state", where=where
            )
        if self.ema is not None:
            self.ema.load(checkpoint.tensors(ckpt.EMA), where)
        with resuming.state_of("metric", where):
            self.metric.load_state_dict(saved["metric"])
        self.progress = Progress.from_dict(saved)
        with resuming.state_of("scheduler", where):
            self.lr_scheduler.load_state_dict(self._schedule_state(saved))
        return self.progress.step

    def _schedule_state(self, saved: Mapping[str, Any]) -> Any:
        """State of the schedule at resuming; if the step size changed, at the same sample.

        The rate follows the part of the run that is done. A count of the old steps would be past
        the end of fewer, larger ones, and train the rest at a rate of 0.
        """
        from fluxvla_core.training.optimizers import ScheduledLR

        same = saved["step_samples"] == self.plan.step_samples
        if same or not isinstance(self.lr_scheduler, ScheduledLR):
            return saved["scheduler"]
        left = self.total_steps - self.progress.step
        return {"step": self.plan.total_steps(self.max_steps, self.max_epochs) - left}

    def _load_model_state(self, state: Mapping[str, Tensor]) -> None:
        """Load a checkpoint's full tensors, by name, into the model; all of them fit."""
        from fluxvla_core.training.weights import load_full_tensors

        load_full_tensors(self.model, state)

    def _load_optimizer_state(self, state: dict[str, Any]) -> bool:
        """Take an optimizer's state in the form of its ``state_dict``; whether it was taken."""
        self.optimizer.load_state_dict(state)
        return True

    def model_tensors(self) -> Mapping[str, Tensor]:
        """Weights and buffers by name, to be saved; parts of them where they are sharded."""
        from fluxvla_core.training.weights import weights_by_name

        return weights_by_name(self.model)

    def optimizer_tensors(self) -> tuple[Mapping[str, Tensor], dict[str, Any]]:
        """The optimizer's state by ``<parameter>/<key>``, and JSON values of the rest of it."""
        from fluxvla_core.training.state import named_state

        return named_state(self.model, self.optimizer)

    def load_optimizer_tensors(
        self, tensors: Mapping[str, Tensor | Stored], described: Mapping[str, Any], where: str
    ) -> bool:
        """The inverse of :meth:`optimizer_tensors`, with :meth:`_load_optimizer_state`."""
        from fluxvla_core.training.state import torch_state

        state = torch_state(self.model, self.optimizer, tensors, described, where)
        return self._load_optimizer_state(state)

    # Properties of the run.

    @property
    def world(self) -> World:
        """This process among those that train; known from ``run_setup`` on."""
        if self._world is None:
            raise RuntimeError("the world is known from run_setup on")
        return self._world

    @property
    def model(self) -> nn.Module:
        """The model without what trains it around it."""
        return self.unwrap_model(self.vla)

    @cached_property
    def compute_dtype(self) -> torch.dtype | None:
        """The dtype of matrix products; None for the weights' own fp32.

        Weights, gradients and optimizer state stay fp32: in bf16 a parameter of 1.0 does not move
        under steps of 5e-5. fp16 is not offered: it needs loss scaling, and where it is fast bf16
        is.
        """
        import torch

        return torch.bfloat16 if self.options.enable_mixed_precision_training else None

    @property
    def total_steps(self) -> int:
        """Optimizer steps of the whole run: those done, which may have been of another size, and
        those left."""
        done, cursor = self.progress.step, self.progress.cursor
        return done + self.plan.run_steps_left(done, cursor, self.max_steps, self.max_epochs)

    def plan_steps(self, samples: int, shards: EpisodeShards | None = None) -> StepPlan:
        """The plan that cuts epochs of so many samples into steps."""
        from fluxvla_core.data.sampler import StepPlan

        return StepPlan(
            samples,
            self.loader_options.per_device_batch_size,
            self.options.grad_accumulation_steps,
            self.world.size,
            self.options.seed,
            shards,
        )


def _warn_of_left_out() -> None:
    message = "left_out is deprecated, use external_weights"
    warnings.warn(message, DeprecationWarning, stacklevel=3)
