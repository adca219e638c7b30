"""The training loop: steps, accumulation, logging, validation, saving and stopping.

What a strategy does differently in a step is in the methods of ``strategy.Strategy``.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from itertools import chain
from statistics import fmean
from typing import TYPE_CHECKING, Any

import torch.distributed as dist

from fluxvla_core.checkpoints.checkpoint import name_best
from fluxvla_core.contracts.training import Dataset
from fluxvla_core.data.loader import IDS, loader_source, make_loader, to_device
from fluxvla_core.data.sampler import StepSampler, episode_shards
from fluxvla_core.errors import located
from fluxvla_core.hooks import HookCaller
from fluxvla_core.training.cost import GB, peak_bytes
from fluxvla_core.training.fit_checks import check_observations
from fluxvla_core.training.model import ForwardArguments, observations_of, trainable
from fluxvla_core.training.resuming import forget_missing, restore_rng
from fluxvla_core.training.saving import Saver
from fluxvla_core.training.state import Ema
from fluxvla_core.training.step_metrics import Step, StepMetrics
from fluxvla_core.training.stop import StopRequest
from fluxvla_core.training.validation import NotFinite, Validation, validation_dataset
from fluxvla_core.training.weights import external_weights

if TYPE_CHECKING:
    from fluxvla_core.training.strategy import Strategy


class Trainer:
    """Runs optimizer steps; the host waits for the device only every ``log_iter_interval``.

    Its constructor builds what ``run_setup`` left out, and resumes.

    Args:
        runner: after its ``run_setup``.
        dataset: ``get_sample(index, epoch)``, ``__len__``.
        stop: asked after every step.
    """

    def __init__(self, runner: Strategy, dataset: Any, stop: StopRequest) -> None:
        self._runner, self._stop = runner, stop
        self._prepare_runner(dataset)
        self._resume()
        self._validation = self._make_validation(dataset)
        self._start_metrics(dataset)
        self._loader = self._start_loader(dataset)
        self._batches: Iterator[Any] = self._loader
        runner.vla.train()
        runner.hooks.call("run_started", embodiment=None)
        # Last, so that nothing above has drawn from the generators that are restored.
        restore_rng(runner.world, runner.resume_checkpoint, runner.options.seed)

    def _prepare_runner(self, dataset: Any) -> None:
        """Give the runner what its steps and its checkpoints need, and the dataset its seed."""
        runner = self._runner
        options, world, context = runner.options, runner.world, runner.context
        self._data_where = context.where("train_dataloader.dataset")
        self._model_where = context.where("model")
        if not world.is_rank0:
            runner.hooks = HookCaller(context)
        runner.dataset = dataset
        described = Dataset.adapt(dataset)
        described.use_seed(options.seed)
        warnings = described.warnings()
        for warning in warnings if world.is_rank0 else ():
            context.reporter.warn(warning)
        where = context.where("train_dataloader.shuffle_episodes")
        shards = episode_shards(dataset, runner.loader_options.shuffle_episodes, where)
        runner.plan = runner.plan_steps(len(dataset), shards)
        runner.saver = Saver(world, options.async_save, runner.optimizer)
        where = context.where(f"{context.section}.collator")
        runner.forward_arguments = ForwardArguments(runner.model, where)
        check_observations(observations_of(runner.model), dataset, context)
        if runner.external_weights is None:
            runner.external_weights = external_weights(runner.model)
        if options.ema_decay is not None:
            runner.ema = Ema(trainable(runner.model), options.ema_decay)

    def _resume(self) -> None:
        """Load the checkpoint that ``run_setup`` chose, if it chose one."""
        runner = self._runner
        runner.resume()
        checkpoint, work_dir = runner.resume_checkpoint, runner.context.work_dir
        forget_missing(runner.progress, runner.world, work_dir, checkpoint)

    def _make_validation(self, dataset: Any) -> Validation | None:
        runner = self._runner
        if runner.val_options is None:
            return None
        seed = runner.options.seed
        held_out = runner.val_dataset
        if held_out is None:
            held_out = validation_dataset(runner.context, dataset, seed)
        takes = observations_of(runner.model)
        check_observations(takes, held_out, runner.context, "val_dataloader")
        return Validation(
            held_out, runner.collator, runner.val_options, runner.world, seed, self._stop
        )

    def _start_metrics(self, dataset: Any) -> None:
        runner = self._runner
        if runner.world.is_rank0:
            progress = runner.progress
            reported = progress.step - (progress.pending_validation is not None)
            runner.metric.start(reported, runner.context.config)
        self._window = StepMetrics(runner.world, Dataset.adapt(dataset).parts)

    def _start_loader(self, dataset: Any) -> Iterator[Any]:
        """Start the loader at the run's position in the data, and its workers."""
        runner = self._runner
        world = runner.world
        loader = make_loader(
            loader_source(dataset, runner.collator, world.device),
            runner.collator,
            StepSampler(runner.plan, world.rank, runner.progress.cursor),
            runner.loader_options.per_device_num_workers,
            pin_memory=world.device.type == "cuda",
            reporter=runner.context.reporter if world.is_rank0 else None,
            seed=runner.options.seed,
        )
        return iter(loader)

    def run(self, finished: Callable[[], bool], due: Callable[[], bool]) -> int:
        """Step until ``finished()``, saving whenever ``due()``, and at the end.

        Returns:
            The signal that asked for a stop, 0 if none did.
        """
        runner, every = self._runner, self._runner.options.log_iter_interval
        stopped = self._run_pending_validation()
        over = stopped or finished() or self._stops_early()
        if not over:
            self._peek_first_batch()
        self._window.restart_clock()
        while not over:
            step = runner.progress.step + 1
            runner.hooks.call("before_step", step=step)
            self._step(step)
            stopped, last = self._stop.poll(step), finished()
            save = due() or last
            validate = self._validates(save, last)
            log = step == 1 or step % every == 0
            if log or save or stopped or validate:
                records, better = self._fetch(), False
                if validate and not stopped:
                    stopped, better = self._try_validation(records, save)
                if validate and stopped:
                    # A stop request is often followed by a kill. The resumed run makes up for the
                    # validation, and reports this step then.
                    runner.progress.pending_validation = records.pop()
                self._report(records)
                save = save or better or bool(stopped) or self._stops_early()
            if save:
                self.save()
            elif self._stop.is_sync_step(step):
                runner.finish_pending_save(wait=False)
            over = stopped or last or self._stops_early()
        return stopped

    def _step(self, step: int) -> None:
        """One optimizer step: gradients of all its micro-batches, clipping, update, schedule."""
        runner = self._runner
        parts = runner.options.grad_accumulation_steps
        losses, ids, each, waited = [], [], [], 0.0
        for part in range(parts):
            asked = time.perf_counter()
            with located(self._data_where):
                batch = to_device(next(self._batches), runner.world.device)
            waited += time.perf_counter() - asked
            with runner.sync_gradients(last=part == parts - 1), located(self._model_where):
                loss = runner._training_step(batch)
                runner.backward(loss / parts if parts > 1 else loss)
            losses.append(loss.detach())
            ids.append(batch.get(IDS))
            each.append(runner.sample_losses)
        rate = runner.optimizer.param_groups[0]["lr"]
        norm = runner.optimizer_step()
        runner.lr_scheduler.step()
        runner.optimizer.zero_grad(set_to_none=True)
        if runner.ema is not None:
            runner.ema.update(step)
        plan, progress = runner.plan, runner.progress
        epoch = progress.cursor.epoch + progress.cursor.samples / plan.length
        progress.step, progress.cursor = step, plan.after_step(progress.cursor)
        samples = plan.step_samples
        self._window.add(Step(step, epoch, rate, losses, ids, norm, samples, waited, each))

    def _fetch(self) -> list[dict[str, Any]]:
        """The records of the steps since the last fetch, as a metric is given them."""
        runner = self._runner
        records = self._window.fetch()
        runner.progress.loss = records[-1]["loss"]
        self._stop.set_interval(fmean(record["step_time"] for record in records))
        if runner.flops is not None:
            for record in records:
                parts = runner.options.grad_accumulation_steps
                record["mfu"] = runner.flops.mfu(parts, record["step_time"])
        records[-1]["memory_gb"] = peak_bytes(runner.world.device.type == "cuda") / GB
        return records

    def _report(self, records: list[dict[str, Any]]) -> None:
        """Give the records to the metric, and the newest one to people and hooks."""
        runner = self._runner
        if not (runner.world.is_rank0 and records):
            return
        for record in records:
            runner.metric.commit(**record)
        shown = dict(records[-1])
        step = shown.pop("global_step")
        runner.metric.push()
        runner.context.reporter.progress("train", step, runner.total_steps, **shown)
        runner.hooks.call("after_step", step=step, metrics=shown)

    def save(self) -> None:
        """Begin a checkpoint of where the run stands, unless there is one already."""
        runner, progress = self._runner, self._runner.progress
        if progress.saved == progress.step:
            return
        runner.finish_pending_save()
        self._stop.poll_now(check=True)
        if runner.world.is_rank0:
            runner.metric.sync()
        runner.save_checkpoint(
            runner.context.work_dir, progress.step, progress.cursor.epoch, progress.loss
        )
        progress.saved = progress.step
        self._window.restart_clock()

    def close(self) -> None:
        """End the loader's workers now; left to the garbage collector it takes them seconds."""
        self._batches = iter(())
        close = getattr(self._loader, "close", None)
        if close is not None:
            close()

    def _peek_first_batch(self) -> None:
        """Show the first batch to the FLOP counter and to the strategy, before the first step."""
        runner = self._runner
        with located(self._data_where):
            first = next(self._batches)
        self._batches = chain([first], self._batches)
        shown = to_device(first, runner.world.device)
        if runner.flops is not None and runner.forward_arguments is not None:
            trouble = runner.flops.count(runner.forward_arguments(shown))
            if trouble is not None and runner.world.is_rank0:
                runner.context.reporter.warn(f"mfu is not reported: {trouble}")
        runner.before_first_step(shown)

    # Validation, and what follows from it.

    def _validates(self, save: bool, last: bool) -> bool:
        if self._validation is None:
            return False
        every = self._runner.options.val_iter_interval
        return last or (save if every is None else self._runner.progress.step % every == 0)

    def _stops_early(self) -> bool:
        patience = self._runner.options.early_stop_patience
        return patience is not None and self._runner.progress.bad_validations >= patience

    def _run_pending_validation(self) -> int:
        """Run the validation that a stop left out; the signal that ended it, 0 if none."""
        runner, record = self._runner, self._runner.progress.pending_validation
        if record is None:
            return 0
        better = False
        if self._validation is not None:
            stopped, better = self._validate(record)
            if stopped:
                return stopped
        runner.progress.pending_validation = None
        self._report([record])
        if better:
            # There already, unless it was another work dir's.
            self.save()
            if runner.world.is_rank0:
                name_best(runner.context.work_dir, runner.progress.step)
        return 0

    def _try_validation(self, records: list[dict[str, Any]], save: bool) -> tuple[int, bool]:
        """Validate the last step of ``records``; if it fails, first do the ``save`` that is due."""
        runner = self._runner
        try:
            return self._validate(records[-1])
        except Exception as error:
            # In a process group the other ranks may know nothing of it, or wait in an exchange,
            # and sharding may have left the model half gathered.
            if save and (isinstance(error, NotFinite) or not dist.is_initialized()):
                runner.progress.pending_validation = records.pop()
                self._report(records)
                self.save()
                runner.finish_pending_save()
            raise

    def _validate(self, record: dict[str, Any]) -> tuple[int, bool]:
        """Add the validation loss to a step's ``record``.

        Returns:
            The signal that ended it before there was one, and whether it is the best so far.
        """
        runner = self._runner
        assert self._validation is not None
        loss = self._validation.loss(
            runner.vla, runner._training_step, runner.ema, runner.progress.step
        )
        if loss is None:
            return self._stop.poll_now(), False
        record["val_loss"] = loss
        better = runner.progress.validated(loss)
        if self._stops_early() and runner.world.is_rank0:
            progress = runner.progress
            runner.context.reporter.info(
                f"no better validation loss than {progress.best:.6g} (step "
                f"{progress.best_step}) in {progress.bad_validations} validations: training ends"
            )
        self._window.restart_clock()
        return 0, better
