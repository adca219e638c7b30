"""``VLAMetric``: averages the numbers of each training step and hands them to trackers."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from fluxvla_core.build import RunContext
from fluxvla_core.contracts.training import Metric
from fluxvla_core.errors import ConfigError
from fluxvla_core.training.trackers import Guarded, check_trackers, open_tracker

WALL_CLOCK = ("step_time", "samples_per_s", "data_wait", "mfu", "memory_gb", "time")
"""Fields that differ between two runs of the same training; all others are equal."""


class VLAMetric(Metric):
    """One record an optimizer step: loss, learning rate, gradient norm, throughput.

    The runner calls ``start``, then ``commit`` for every step, ``push`` and ``sync`` now and then,
    and ``finalize``, on the first rank only. Any class of ``fluxvla.metrics`` with these methods
    and ``state_dict``/``load_state_dict`` (JSON values) can take its place.

    Args:
        active_trackers: of ``jsonl``, ``tensorboard``, ``trackio``, ``wandb``.
        run_dir: where trackers write; the work dir by default.
        run_id: the name that trackers show; the work dir's name by default. Which run of theirs
            goes on when this one does is kept in ``run_dir``.
        hparams: what is recorded as the run's settings; the config by default.
        window_size: the ``loss`` of a record is the mean over N steps; with more than one,
            ``loss_raw`` is the step's own.
        grad_accumulation_steps: recorded with the settings; the runner's losses are already
            averaged over the batches of a step.
        context: filled in by the builder.

    Raises:
        ConfigError: an unknown tracker, one whose package is missing, or ``window_size`` below 1.
    """

    def __init__(
        self,
        active_trackers: Sequence[str] = ("jsonl",),
        run_dir: str | None = None,
        run_id: str | None = None,
        hparams: Mapping[str, Any] | None = None,
        window_size: int = 1,
        grad_accumulation_steps: int = 1,
        context: RunContext | None = None,
    ) -> None:
        self.context = context or RunContext()
        table = f"{self.context.section}.metric"
        if window_size < 1:
            raise ConfigError(
                f"window_size must be at least 1, got {window_size}",
                where=self.context.where(f"{table}.window_size"),
            )
        self.active_trackers = tuple(active_trackers)
        check_trackers(self.active_trackers, self.context.where(f"{table}.active_trackers"))
        self.run_dir = Path(run_dir) if run_dir is not None else self.context.work_dir
        self.run_id = run_id or self.run_dir.name
        self.hparams = hparams
        self.grad_accumulation_steps = grad_accumulation_steps
        self._losses: deque[float] = deque(maxlen=window_size)
        self._records: list[tuple[int, dict[str, float]]] = []
        self._trackers: list[Guarded] = []
        self._status = "no step yet"

    def start(self, step: int, config: Mapping[str, Any]) -> None:
        """Open the trackers of a run that has done ``step`` steps before."""
        settings = {
            "grad_accumulation_steps": self.grad_accumulation_steps,
            **(config if self.hparams is None else self.hparams),
        }
        self._trackers = [
            open_tracker(name, self.context.reporter, self.run_dir, self.run_id, step, settings)
            for name in self.active_trackers
        ]

    def commit(
        self, *, global_step: int, epoch: float, loss: float, lr: float, **more: float | None
    ) -> None:
        """Record one step; values that are None are left out."""
        self._losses.append(loss)
        mean = sum(self._losses) / len(self._losses)
        record = {"epoch": epoch, "loss": mean, "lr": lr}
        if self._losses.maxlen != 1:
            record["loss_raw"] = loss
        record.update({name: value for name, value in more.items() if value is not None})
        record["time"] = time.time()
        self._records.append((global_step, record))

    def push(self) -> str:
        """Hand the records since the last push to the trackers; one line about the newest."""
        records, self._records = self._records, []
        if records:
            for tracker in self._trackers:
                tracker.log(records)
            step, newest = records[-1]
            self._status = (
                f"step {step} · epoch {newest['epoch']:.2f} · loss {newest['loss']:.5f} · "
                f"lr {newest['lr']:.3g}"
            )
        return self._status

    def sync(self) -> None:
        """Make what was pushed durable; called before a checkpoint is saved."""
        for tracker in self._trackers:
            tracker.sync()

    def state_dict(self) -> dict[str, Any]:
        """State that lets a resumed run record the same as an uninterrupted one."""
        return {"losses": list(self._losses)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """The inverse of :meth:`state_dict`."""
        self._losses.extend(state["losses"])

    def finalize(self) -> None:
        """Push what is left and close the trackers."""
        self.push()
        for tracker in self._trackers:
            tracker.close()
        self._trackers = []
