"""The steps of a run. What a strategy does differently is in the runner's methods."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from itertools import chain
from typing import Any

import torch

from fluxvla_core.data.loader import make_loader
from fluxvla_core.hooks import HookCaller
from fluxvla_core.train.batches import StepSampler
from fluxvla_core.train.ema import Ema
from fluxvla_core.train.forward import IDS, ForwardArguments, to_device
from fluxvla_core.train.optim import trainable
from fluxvla_core.train.resuming import restore_rng
from fluxvla_core.train.stop import StopRequest
from fluxvla_core.train.strategy import Strategy
from fluxvla_core.train.weights import left_out
from fluxvla_core.train.window import StepRecord, Window


def begin(run: Strategy, dataset: Any, stop: StopRequest) -> StepLoop:
    """Put ``run`` where it starts or goes on, and give the loop that takes it from there."""
    options, world, context = run.options, run.world, run.context
    if not world.first:
        run.hooks = HookCaller(context)
    run.dataset, run.plan = dataset, run._plan(len(dataset))
    run._arguments = ForwardArguments(run.model, context.where(f"{context.section}.collator"))
    run.left_out = left_out(run.model)
    if options.ema_decay is not None:
        run.ema = Ema(trainable(run.model), options.ema_decay)
    run.resume()
    if world.first:
        run.metric.start(run.progress.step, context.config)
    sampler: Any = StepSampler(run.plan, world.rank, run.progress.cursor)
    loader = make_loader(
        dataset,
        run.collator,
        sampler,
        run.loader_options.per_device_num_workers,
        pin_memory=world.device.type == "cuda",
        reporter=context.reporter if world.first else None,
    )
    loop = StepLoop(run, iter(loader), stop)
    run.vla.train()
    run.hooks.call("run_started")
    # Last, so that nothing above has drawn from the generators that are restored.
    restore_rng(world, run._checkpoint, options.seed)
    return loop


class StepLoop:
    """Runs optimizer steps; the host waits for the device only every ``log_iter_interval``.

    Args:
        run: the runner.
        batches: micro-batches of this rank, from the run's cursor on, without end.
        stop: asked after every step.
    """

    def __init__(self, run: Strategy, batches: Iterator[Any], stop: StopRequest) -> None:
        self._run = run
        self._source = self._batches = batches
        self._stop = stop
        self._window = Window(run.world)

    def run(self, finished: Callable[[], bool], due: Callable[[], bool]) -> int:
        """Step until ``finished()``, saving whenever ``due()``, and at the end.

        Returns:
            The signal that asked for a stop, 0 if none did.
        """
        run, stopped = self._run, 0
        if not finished():
            first = next(self._batches)
            run._warm_up(to_device(first, run.world.device))
            self._batches = chain([first], self._batches)
        self._window.restart_clock()
        while not stopped and not finished():
            step = run.progress.step + 1
            run.hooks.call("before_step", step=step)
            self._step(step)
            stopped = self._stop.wanted(step)
            save = due() or bool(stopped) or finished()
            if save or step == 1 or step % run.options.log_iter_interval == 0:
                self._report()
            if save:
                self.save()
        return stopped

    def close(self) -> None:
        """End the loader's workers now; left to the garbage collector it takes them seconds."""
        self._batches = iter(())
        close = getattr(self._source, "close", None)
        if close is not None:
            close()

    def _step(self, step: int) -> None:
        run = self._run
        parts = run.options.grad_accumulation_steps
        losses, ids, waited = [], [], 0.0
        for part in range(parts):
            asked = time.perf_counter()
            batch = to_device(next(self._batches), run.world.device)
            waited += time.perf_counter() - asked
            with run._sync_gradients(last=part == parts - 1):
                loss = run._training_step(batch)
                torch.autograd.backward(loss / parts if parts > 1 else loss)
            losses.append(loss.detach())
            ids.append(batch.get(IDS))
        norm = run.clip_grad_norm()
        rate = run.optimizer.param_groups[0]["lr"]
        run.optimizer.step()
        run.lr_scheduler.step()
        run.optimizer.zero_grad(set_to_none=True)
        if run.ema is not None:
            run.ema.update(step)
        plan, progress = run.plan, run.progress
        epoch = progress.cursor.epoch + progress.cursor.samples / plan.length
        progress.step, progress.cursor = step, plan.after_step(progress.cursor)
        self._window.add(step, epoch, rate, losses, ids, norm, plan.step_samples, waited)

    def _report(self) -> None:
        run = self._run
        records = self._window.fetch()
        if not records:
            return
        last = records[-1]
        run.progress.loss = last.loss
        self._stop.pace(sum(r.step_time for r in records) / len(records))
        if not run.world.first:
            return
        for record in records:
            run.metric.commit(**as_metrics(record))
        shown = dict(as_metrics(last))
        shown.pop("global_step")
        run.metric.push()
        run.context.reporter.progress("train", last.step, run.total_steps, **shown)
        run.hooks.call("after_step", step=last.step, metrics=shown)

    def save(self) -> None:
        """A checkpoint of where the run stands, unless there is one already."""
        run, progress = self._run, self._run.progress
        if progress.saved == progress.step:
            return
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
    }
