"""The steps of a run. What a strategy does differently is in the runner's methods."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from itertools import chain
from typing import Any

import torch.distributed as dist

from fluxvla_core.checkpoints.checkpoint import FOLDER, step_name
from fluxvla_core.checkpoints.shelf import name_best
from fluxvla_core.data.loader import make_loader
from fluxvla_core.hooks import HookCaller
from fluxvla_core.train.batches import StepSampler
from fluxvla_core.train.distributed import agree
from fluxvla_core.train.ema import Ema
from fluxvla_core.train.forward import IDS, ForwardArguments, to_device
from fluxvla_core.train.memory import GB, peak_bytes
from fluxvla_core.train.optim import trainable
from fluxvla_core.train.pictures import source
from fluxvla_core.train.resuming import restore_rng
from fluxvla_core.train.saver import Saver
from fluxvla_core.train.state import take_seed
from fluxvla_core.train.stop import StopRequest
from fluxvla_core.train.strategy import Strategy
from fluxvla_core.train.validation import NotFinite, Validation
from fluxvla_core.train.weights import left_out
from fluxvla_core.train.window import StepRecord, Window


def begin(run: Strategy, dataset: Any, stop: StopRequest) -> StepLoop:
    """Put ``run`` where it starts or goes on, and give the loop that takes it from there."""
    options, world, context = run.options, run.world, run.context
    if not world.first:
        run.hooks = HookCaller(context)
    run.dataset = dataset
    take_seed(dataset, options.seed)
    doubts: list[str] = getattr(dataset, "doubts", list)()
    for doubt in doubts if world.first else ():
        context.reporter.warn(doubt)
    run.plan = run._plan(len(dataset), run._shards(dataset))
    run._saver = Saver(world, options.async_save, run.optimizer)
    run._arguments = ForwardArguments(run.model, context.where(f"{context.section}.collator"))
    if run.left_out is None:
        run.left_out = left_out(run.model)
    if options.ema_decay is not None:
        run.ema = Ema(trainable(run.model), options.ema_decay)
    run.resume()
    take_stock(run)
    validation = None if run.val_options is None else Validation(run, stop)
    if world.first:
        told = run.progress.step - (run.progress.owed is not None)
        run.metric.start(told, context.config)
    sampler: Any = StepSampler(run.plan, world.rank, run.progress.cursor)
    loader = make_loader(
        source(dataset, run.collator, world.device),
        run.collator,
        sampler,
        run.loader_options.per_device_num_workers,
        pin_memory=world.device.type == "cuda",
        reporter=context.reporter if world.first else None,
        seed=options.seed,
    )
    loop = StepLoop(run, iter(loader), stop, validation)
    run.vla.train()
    run.hooks.call("run_started")
    # Last, so that nothing above has drawn from the generators that are restored.
    restore_rng(world, run._checkpoint, options.seed)
    return loop


def take_stock(run: Strategy) -> None:
    """Forget checkpoints that the resumed one tells of and this work dir does not have.

    The best one may have been removed in favour of a better one that was lost since. Of a
    checkpoint from elsewhere, neither itself nor the best one before it is here.
    """
    progress, world, work_dir = run.progress, run.world, run.context.work_dir
    elsewhere = lost = False
    if world.first:
        here = work_dir / FOLDER / step_name(progress.step)
        elsewhere = run._checkpoint is None or run._checkpoint.path.resolve() != here.resolve()
        lost = not name_best(work_dir, -1 if elsewhere else progress.best_step)
    if agree(world, elsewhere):
        progress.saved = -1
    if agree(world, lost):
        progress.best, progress.best_step = None, -1


class StepLoop:
    """Runs optimizer steps; the host waits for the device only every ``log_iter_interval``.

    Args:
        run: the runner.
        batches: micro-batches of this rank, from the run's cursor on, without end.
        stop: asked after every step.
        validation: of the run, if it has one.
    """

    def __init__(
        self,
        run: Strategy,
        batches: Iterator[Any],
        stop: StopRequest,
        validation: Validation | None = None,
    ) -> None:
        self._run = run
        self._source = self._batches = batches
        self._stop = stop
        self._validation = validation
        self._window = Window(run.world, getattr(run.dataset, "parts", {}))

    def run(self, finished: Callable[[], bool], due: Callable[[], bool]) -> int:
        """Step until ``finished()``, saving whenever ``due()``, and at the end.

        Returns:
            The signal that asked for a stop, 0 if none did.
        """
        run, stopped = self._run, self._catch_up()
        if not (stopped or finished() or self._enough()):
            self._look_ahead()
        self._window.restart_clock()
        while not (stopped or finished() or self._enough()):
            step = run.progress.step + 1
            run.hooks.call("before_step", step=step)
            self._step(step)
            stopped = self._stop.wanted(step)
            save = due() or finished()
            validate = self._validates(save, finished())
            if (
                save
                or stopped
                or validate
                or step == 1
                or step % run.options.log_iter_interval == 0
            ):
                found, better = self._fetch(), False
                if validate and not stopped:
                    stopped, better = self._try_validation(found, save)
                if validate and stopped:
                    # Whoever asks for a stop may kill soon. The run that goes on makes up for it,
                    # and tells of this step then.
                    run.progress.owed = found.pop()
                self._report(found)
                save = save or better or bool(stopped) or self._enough()
            if save:
                self.save()
            elif self._stop.due(step):
                run.settle_saves(wait=False)
        return stopped

    def _catch_up(self) -> int:
        """Validate where that was left out, as if it had not been; the signal that ended it."""
        run, owed = self._run, self._run.progress.owed
        if owed is None:
            return 0
        better = False
        if self._validation is not None:
            stopped, better = self._validate(owed)
            if stopped:
                return stopped
        run.progress.owed = None
        self._report([owed])
        if better:
            # There already, unless it was another work dir's.
            self.save()
            if run.world.first:
                name_best(run.context.work_dir, run.progress.step)
        return 0

    def _look_ahead(self) -> None:
        """Show the first batch to whoever has to see one before the first step."""
        run = self._run
        first = next(self._batches)
        self._batches = chain([first], self._batches)
        shown = to_device(first, run.world.device)
        if run.flops is not None and run._arguments is not None:
            trouble = run.flops.look(run._arguments(shown))
            if trouble is not None and run.world.first:
                run.context.reporter.warn(f"mfu is not reported: {trouble}")
        run._warm_up(shown)

    def _enough(self) -> bool:
        patience = self._run.options.early_stop_patience
        return patience is not None and self._run.progress.worse >= patience

    def _validates(self, save: bool, last: bool) -> bool:
        if self._validation is None:
            return False
        every = self._run.options.val_iter_interval
        return last or (save if every is None else self._run.progress.step % every == 0)

    def _try_validation(self, found: list[dict[str, Any]], save: bool) -> tuple[int, bool]:
        """Validate the last step of ``found``; if that fails, first do the ``save`` that is due."""
        run = self._run
        try:
            return self._validate(found[-1])
        except Exception as error:
            # In a process group the other ranks may know nothing of it, or wait in an exchange,
            # and sharding may have left the model half gathered.
            if save and (isinstance(error, NotFinite) or not dist.is_initialized()):
                run.progress.owed = found.pop()
                self._report(found)
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
        loss = self._validation.loss(run)
        if loss is None:
            return self._stop.asked(), False
        record["val_loss"] = loss
        better = run.progress.validated(loss)
        if self._enough() and run.world.first:
            run.context.reporter.info(
                f"no better validation loss than {run.progress.best:.6g} (step "
                f"{run.progress.best_step}) in {run.progress.worse} validations: training ends"
            )
        self._window.restart_clock()
        return 0, better

    def close(self) -> None:
        """End the loader's workers now; left to the garbage collector it takes them seconds."""
        self._batches = iter(())
        close = getattr(self._source, "close", None)
        if close is not None:
            close()

    def _step(self, step: int) -> None:
        run = self._run
        parts = run.options.grad_accumulation_steps
        losses, ids, each, waited = [], [], [], 0.0
        for part in range(parts):
            asked = time.perf_counter()
            batch = to_device(next(self._batches), run.world.device)
            waited += time.perf_counter() - asked
            with run._sync_gradients(last=part == parts - 1):
                loss = run._training_step(batch)
                run._backward(loss / parts if parts > 1 else loss)
            losses.append(loss.detach())
            ids.append(batch.get(IDS))
            each.append(run.sample_losses)
        rate = run.optimizer.param_groups[0]["lr"]
        norm = run._update()
        run.lr_scheduler.step()
        run.optimizer.zero_grad(set_to_none=True)
        if run.ema is not None:
            run.ema.update(step)
        plan, progress = run.plan, run.progress
        epoch = progress.cursor.epoch + progress.cursor.samples / plan.length
        progress.step, progress.cursor = step, plan.after_step(progress.cursor)
        self._window.add(step, epoch, rate, losses, ids, norm, plan.step_samples, waited, each)

    def _fetch(self) -> list[dict[str, Any]]:
        """What the steps since the last time gave, as a metric is given it."""
        run = self._run
        records = self._window.fetch()
        run.progress.loss = records[-1].loss
        self._stop.pace(sum(r.step_time for r in records) / len(records))
        found = [as_metrics(record) for record in records]
        if run.flops is not None:
            for values in found:
                parts = run.options.grad_accumulation_steps
                values["mfu"] = run.flops.mfu(parts, values["step_time"])
        found[-1]["memory_gb"] = peak_bytes(run.world.device.type == "cuda") / GB
        return found

    def _report(self, found: list[dict[str, Any]]) -> None:
        run = self._run
        if not (run.world.first and found):
            return
        for values in found:
            run.metric.commit(**values)
        shown = dict(found[-1])
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
        if run.world.first:
            run.metric.sync()
        run.save_checkpoint(
            run.context.work_dir, progress.step, progress.cursor.epoch, progress.loss
        )
        progress.saved = progress.step
        self._window.restart_clock()


def as_metrics(record: StepRecord) -> dict[str, Any]:
    """The fields that a metric is given for one step."""
    seconds = record.step_time
    return {
        "global_step": record.step,
        "epoch": record.epoch,
        "loss": record.loss,
        "grad_norm": record.grad_norm,
        "lr": record.lr,
        "step_time": seconds,
        "samples_per_s": record.samples_per_s,
        "data_wait": record.data_wait / seconds if seconds > 0 else 0.0,
        **{f"loss/{name}": loss for name, loss in record.by_dataset.items()},
    }
