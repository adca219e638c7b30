"""The training loop: steps, accumulation, logging, validation, saving and stopping.

What a strategy does differently in a step is in the methods of ``strategy.Strategy``.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from itertools import chain
from typing import TYPE_CHECKING, Any

import torch.distributed as dist

from fluxvla_core.checkpoints.retention import name_best
from fluxvla_core.contracts.training import Dataset
from fluxvla_core.data.loader import make_loader
from fluxvla_core.hooks import HookCaller
from fluxvla_core.training import memory
from fluxvla_core.training.batches import IDS, StepSampler, episode_shards, loader_source, to_device
from fluxvla_core.training.ema import Ema
from fluxvla_core.training.model import ForwardArguments
from fluxvla_core.training.parameters import trainable
from fluxvla_core.training.resuming import forget_missing, restore_rng
from fluxvla_core.training.rng import take_seed
from fluxvla_core.training.saving import Saver
from fluxvla_core.training.step_metrics import StepMetrics, as_metrics
from fluxvla_core.training.stop import StopRequest
from fluxvla_core.training.validation import NotFinite, Validation, validation_dataset
from fluxvla_core.training.weights import left_out

if TYPE_CHECKING:
    from fluxvla_core.training.strategy import Strategy


class Trainer:
    """Runs optimizer steps; the host waits for the device only every ``log_iter_interval``.

    Making one builds everything that is left to build, and puts ``run`` where it starts or resumes.

    Args:
        run: the runner, after its ``run_setup``.
        dataset: ``get_sample(index, epoch)``, ``__len__``.
        stop: asked after every step.
    """

    def __init__(self, run: Strategy, dataset: Any, stop: StopRequest) -> None:
        options, world, context = run.options, run.world, run.context
        self._run, self._stop = run, stop
        if not world.first:
            run.hooks = HookCaller(context)
        run.dataset = dataset
        take_seed(dataset, options.seed)
        warnings = Dataset.adapt(dataset).warnings()
        for warning in warnings if world.first else ():
            context.reporter.warn(warning)
        where = context.where("train_dataloader.shuffle_episodes")
        shards = episode_shards(dataset, run.loader_options.shuffle_episodes, where)
        run.plan = run.plan_steps(len(dataset), shards)
        run.saver = Saver(world, options.async_save, run.optimizer)
        where = context.where(f"{context.section}.collator")
        run.forward_arguments = ForwardArguments(run.model, where)
        if run.left_out is None:
            run.left_out = left_out(run.model)
        if options.ema_decay is not None:
            run.ema = Ema(trainable(run.model), options.ema_decay)
        run.resume()
        forget_missing(run.progress, world, context.work_dir, run.resume_checkpoint)
        self._validation: Validation | None = None
        if run.val_options is not None:
            self._validation = Validation(
                validation_dataset(context, dataset, options.seed),
                run.collator,
                run.val_options,
                world,
                options.seed,
                stop,
            )
        if world.first:
            reported = run.progress.step - (run.progress.unvalidated is not None)
            run.metric.start(reported, context.config)
        self._window = StepMetrics(world, Dataset.adapt(dataset).parts)
        sampler: Any = StepSampler(run.plan, world.rank, run.progress.cursor)
        loader = make_loader(
            loader_source(dataset, run.collator, world.device),
            run.collator,
            sampler,
            run.loader_options.per_device_num_workers,
            pin_memory=world.device.type == "cuda",
            reporter=context.reporter if world.first else None,
            seed=options.seed,
        )
        self._loader = iter(loader)
        self._batches: Iterator[Any] = self._loader
        run.vla.train()
        run.hooks.call("run_started", embodiment=None)
        # Last, so that nothing above has drawn from the generators that are restored.
        restore_rng(world, run.resume_checkpoint, options.seed)

    def run(self, finished: Callable[[], bool], due: Callable[[], bool]) -> int:
        """Step until ``finished()``, saving whenever ``due()``, and at the end.

        Returns:
            The signal that asked for a stop, 0 if none did.
        """
        run, every = self._run, self._run.options.log_iter_interval
        stopped = self._catch_up()
        over = stopped or finished() or self._stops_early()
        if not over:
            self._look_ahead()
        self._window.restart_clock()
        while not over:
            step = run.progress.step + 1
            run.hooks.call("before_step", step=step)
            self._step(step)
            stopped, last = self._stop.wanted(step), finished()
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
                    run.progress.unvalidated = records.pop()
                self._report(records)
                save = save or better or bool(stopped) or self._stops_early()
            if save:
                self.save()
            elif self._stop.due(step):
                run.settle_saves(wait=False)
            over = stopped or last or self._stops_early()
        return stopped

    def _step(self, step: int) -> None:
        """One optimizer step: gradients of all its micro-batches, clipping, update, schedule."""
        run = self._run
        parts = run.options.grad_accumulation_steps
        losses, ids, each, waited = [], [], [], 0.0
        for part in range(parts):
            asked = time.perf_counter()
            batch = to_device(next(self._batches), run.world.device)
            waited += time.perf_counter() - asked
            with run.sync_gradients(last=part == parts - 1):
                loss = run._training_step(batch)
                run.backward(loss / parts if parts > 1 else loss)
            losses.append(loss.detach())
            ids.append(batch.get(IDS))
            each.append(run.sample_losses)
        rate = run.optimizer.param_groups[0]["lr"]
        norm = run.optimizer_step()
        run.lr_scheduler.step()
        run.optimizer.zero_grad(set_to_none=True)
        if run.ema is not None:
            run.ema.update(step)
        plan, progress = run.plan, run.progress
        epoch = progress.cursor.epoch + progress.cursor.samples / plan.length
        progress.step, progress.cursor = step, plan.after_step(progress.cursor)
        self._window.add(step, epoch, rate, losses, ids, norm, plan.step_samples, waited, each)

    def _fetch(self) -> list[dict[str, Any]]:
        """The records of the steps since the last fetch, as a metric is given them."""
        run = self._run
        steps = self._window.fetch()
        run.progress.loss = steps[-1].loss
        self._stop.pace(sum(s.step_time for s in steps) / len(steps))
        records = [as_metrics(step) for step in steps]
        if run.flops is not None:
            for record in records:
                parts = run.options.grad_accumulation_steps
                record["mfu"] = run.flops.mfu(parts, record["step_time"])
        cuda = run.world.device.type == "cuda"
        records[-1]["memory_gb"] = memory.peak_bytes(cuda) / memory.GB
        return records

    def _report(self, records: list[dict[str, Any]]) -> None:
        """Give the records to the metric, and the newest one to people and hooks."""
        run = self._run
        if not (run.world.first and records):
            return
        for record in records:
            run.metric.commit(**record)
        shown = dict(records[-1])
        step = shown.pop("global_step")
        run.metric.push()
        run.context.reporter.progress("train", step, run.total_steps, **shown)
        run.hooks.call("after_step", step=step, metrics=shown)

    def save(self) -> None:
        """Begin a checkpoint of where the run stands, unless there is one already."""
        run, progress = self._run, self._run.progress
        if progress.saved == progress.step:
            return
        run.settle_saves()
        self._stop.asked(now=True)
        if run.world.first:
            run.metric.sync()
        run.save_checkpoint(
            run.context.work_dir, progress.step, progress.cursor.epoch, progress.loss
        )
        progress.saved = progress.step
        self._window.restart_clock()

    def close(self) -> None:
        """End the loader's workers now; left to the garbage collector it takes them seconds."""
        self._batches = iter(())
        close = getattr(self._loader, "close", None)
        if close is not None:
            close()

    def _look_ahead(self) -> None:
        """Pass the first batch to what needs one before the first step."""
        run = self._run
        first = next(self._batches)
        self._batches = chain([first], self._batches)
        shown = to_device(first, run.world.device)
        if run.flops is not None and run.forward_arguments is not None:
            trouble = run.flops.count(run.forward_arguments(shown))
            if trouble is not None and run.world.first:
                run.context.reporter.warn(f"mfu is not reported: {trouble}")
        run.warm_up(shown)

    # Validation, and what follows from it.

    def _validates(self, save: bool, last: bool) -> bool:
        if self._validation is None:
            return False
        every = self._run.options.val_iter_interval
        return last or (save if every is None else self._run.progress.step % every == 0)

    def _stops_early(self) -> bool:
        patience = self._run.options.early_stop_patience
        return patience is not None and self._run.progress.worse >= patience

    def _catch_up(self) -> int:
        """Make up for the validation that a stop left out; the signal that ended it, 0 if none."""
        run, record = self._run, self._run.progress.unvalidated
        if record is None:
            return 0
        better = False
        if self._validation is not None:
            stopped, better = self._validate(record)
            if stopped:
                return stopped
        run.progress.unvalidated = None
        self._report([record])
        if better:
            # There already, unless it was another work dir's.
            self.save()
            if run.world.first:
                name_best(run.context.work_dir, run.progress.step)
        return 0

    def _try_validation(self, records: list[dict[str, Any]], save: bool) -> tuple[int, bool]:
        """Validate the last step of ``records``; if it fails, first do the ``save`` that is due."""
        run = self._run
        try:
            return self._validate(records[-1])
        except Exception as error:
            # In a process group the other ranks may know nothing of it, or wait in an exchange,
            # and sharding may have left the model half gathered.
            if save and (isinstance(error, NotFinite) or not dist.is_initialized()):
                run.progress.unvalidated = records.pop()
                self._report(records)
                self.save()
                run.settle_saves()
            raise

    def _validate(self, record: dict[str, Any]) -> tuple[int, bool]:
        """Add the validation loss to a step's ``record``.

        Returns:
            The signal that ended it before there was one, and whether it is the best so far.
        """
        run = self._run
        assert self._validation is not None
        loss = self._validation.loss(run.vla, run._training_step, run.ema, run.progress.step)
        if loss is None:
            return self._stop.asked(), False
        record["val_loss"] = loss
        better = run.progress.validated(loss)
        if self._stops_early() and run.world.first:
            run.context.reporter.info(
                f"no better validation loss than {run.progress.best:.6g} (step "
                f"{run.progress.best_step}) in {run.progress.worse} validations: training ends"
            )
        self._window.restart_clock()
        return 0, better
