"""``VLAMetric``: averages the numbers of each training step and hands them to trackers."""

from __future__ import annotations

import json
import os
import secrets
import sys
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stdout
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from fluxvla_core import atomic
from fluxvla_core.build import RunContext
from fluxvla_core.contracts.runner import Reporter
from fluxvla_core.contracts.training import Metric
from fluxvla_core.errors import ConfigError, nearest

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
        hparams: recorded as the run's settings; the config by default.
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
        """Sync the trackers' files; called before a checkpoint is saved."""
        for tracker in self._trackers:
            tracker.sync()

    def state_dict(self) -> dict[str, Any]:
        """State that lets a resumed run record the same as an uninterrupted one."""
        return {"losses": list(self._losses)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """The inverse of :meth:`state_dict`."""
        self._losses.extend(state["losses"])

    def finalize(self) -> None:
        """Push the last records and close the trackers."""
        self.push()
        for tracker in self._trackers:
            tracker.close()
        self._trackers = []


Records = Sequence[tuple[int, Mapping[str, float]]]
"""Optimizer steps, in order, each with its values."""


class Tracker(Protocol):
    """Receives the values of each step, in order."""

    def log(self, records: Records) -> None:
        """Take the values of optimizer steps."""

    def sync(self) -> None:
        """Make everything so far survive a crash of the machine."""

    def close(self) -> None:
        """Finish; nothing follows."""


class JsonlTracker:
    """One JSON object a line in ``<run_dir>/metrics.jsonl``.

    A run that resumes after ``step`` drops the lines of later steps, so that the file is that of
    a run that was never interrupted.
    """

    def __init__(self, run_dir: Path, run_id: str, step: int, hparams: Mapping[str, Any]) -> None:
        path = run_dir / "metrics.jsonl"
        kept = [line for line in _lines(path) if _step(line) <= step]
        run_dir.mkdir(parents=True, exist_ok=True)
        atomic.write_text(path, "".join(kept))
        self._file = path.open("a", encoding="utf-8")

    def log(self, records: Records) -> None:
        lines = [atomic.json_text({"step": step, **values}) + "\n" for step, values in records]
        self._file.write("".join(lines))
        self._file.flush()

    def sync(self) -> None:
        os.fsync(self._file.fileno())

    def close(self) -> None:
        self._file.close()


class TensorboardTracker:
    """TensorBoard event files in ``<run_dir>/tensorboard`` (or ``TENSORBOARD_LOG_PATH``)."""

    def __init__(self, run_dir: Path, run_id: str, step: int, hparams: Mapping[str, Any]) -> None:
        from torch.utils.tensorboard import SummaryWriter

        place = os.environ.get("TENSORBOARD_LOG_PATH") or str(run_dir / "tensorboard")
        # Steps that a resumed run does again, or one that starts again in the folder of a run that
        # was killed before its first checkpoint, replace what was shown for them.
        self._writer: Any = SummaryWriter(place, purge_step=step + 1)

    def log(self, records: Records) -> None:
        for step, values in records:
            for name, value in values.items():
                self._writer.add_scalar(f"train/{name}", value, step)

    def sync(self) -> None:
        self._writer.flush()

    def close(self) -> None:
        self._writer.close()


class WandbTracker:
    """Weights & Biases; ``WANDB_PROJECT``, ``WANDB_ENTITY`` and ``WANDB_MODE`` as it reads them."""

    def __init__(self, run_dir: Path, run_id: str, step: int, hparams: Mapping[str, Any]) -> None:
        import wandb

        self._run: Any = wandb.init(
            project=os.environ.get("WANDB_PROJECT", "fluxvla"),
            name=run_id,
            id=_identity("wandb", run_dir, step),
            resume="allow",
            dir=str(run_dir),
            config=dict(hparams),
        )

    def log(self, records: Records) -> None:
        for step, values in records:
            self._run.log({f"train/{name}": value for name, value in values.items()}, step=step)

    def sync(self) -> None:
        return

    def close(self) -> None:
        self._run.finish()


class TrackioTracker:
    """Trackio, which keeps runs on this machine (in ``TRACKIO_DIR``); ``trackio show`` has them.

    ``TRACKIO_PROJECT`` names the project. It knows a run by its name alone, which therefore ends
    with something that no other run of the same name has.
    """

    def __init__(self, run_dir: Path, run_id: str, step: int, hparams: Mapping[str, Any]) -> None:
        # It greets people on standard output, where a program may be reading JSON.
        with redirect_stdout(sys.stderr):
            import trackio

            self._trackio: Any = trackio
            run: Any = trackio.init(
                project=os.environ.get("TRACKIO_PROJECT", "fluxvla"),
                name=f"{run_id}-{_identity('trackio', run_dir, step)}",
                config=json.loads(json.dumps(dict(hparams), default=str)),
                resume="allow",
                embed=False,
                auto_log_cpu=False,
                auto_log_gpu=False,
            )
        # It cannot replace a step, and would show one that a resumed run does again twice. Only it
        # knows what it has kept of the steps before a kill.
        self._first: int = getattr(run, "_next_step", 0)

    def log(self, records: Records) -> None:
        for step, values in records:
            if step >= self._first:
                shown = {f"train/{name}": value for name, value in values.items()}
                self._trackio.log(shown, step=step)

    def sync(self) -> None:
        return

    def close(self) -> None:
        with redirect_stdout(sys.stderr):
            self._trackio.finish()


_KINDS: Mapping[str, tuple[Callable[..., Tracker], str | None]] = {
    "jsonl": (JsonlTracker, None),
    "tensorboard": (TensorboardTracker, "tensorboard"),
    "trackio": (TrackioTracker, "trackio"),
    "wandb": (WandbTracker, "wandb"),
}
"""Name -> the tracker, and the package that it needs; an extra of fluxvla-core has its name."""


def check_trackers(names: tuple[str, ...], where: str | None = None) -> None:
    """Refuse, before training, trackers that do not exist or whose package is not installed.

    Raises:
        ConfigError: names the package.
    """
    import importlib.util

    for name in names:
        if name not in _KINDS:
            near = nearest(name, _KINDS)
            hint = f"did you mean {near!r}?" if near else f"there are {', '.join(_KINDS)}"
            raise ConfigError(f"there is no tracker {name!r}; {hint}", where=where)
        package = _KINDS[name][1]
        if package is not None and importlib.util.find_spec(package) is None:
            raise ConfigError(
                f"tracker {name!r} needs the package {package}, which is not installed",
                where=where,
                next=f"pip install 'fluxvla-core[{name}]'",
            )


class Guarded:
    """Passes calls on to a tracker until one fails; that is said once, and the run continues."""

    def __init__(self, name: str, reporter: Reporter, make: Callable[[], Tracker]) -> None:
        self._name, self._reporter = name, reporter
        self._tracker: Tracker | None = None
        self._guard(lambda: setattr(self, "_tracker", make()))

    def log(self, records: Records) -> None:
        if self._tracker is not None:
            self._guard(partial(self._tracker.log, records))

    def sync(self) -> None:
        if self._tracker is not None:
            self._guard(self._tracker.sync)

    def close(self) -> None:
        if self._tracker is not None:
            self._guard(self._tracker.close)
        self._tracker = None

    def _guard(self, call: Callable[[], object]) -> None:
        try:
            call()
        except Exception as error:  # noqa: BLE001 - watching a run must not end it
            self._tracker = None
            self._reporter.warn(
                f"tracker {self._name} failed and is left out for the rest of the run: "
                f"{type(error).__name__}: {error}"
            )


def open_tracker(
    name: str, reporter: Reporter, run_dir: Path, run_id: str, step: int, hparams: Mapping[str, Any]
) -> Guarded:
    """The tracker ``name``, guarded; ``step`` steps of the run have been done before."""
    return Guarded(name, reporter, partial(_KINDS[name][0], run_dir, run_id, step, hparams))


def _identity(tracker: str, run_dir: Path, step: int) -> str:
    """The run's id at the tracker: random, kept with the run, a new one for a new run."""
    path = run_dir / f"{tracker}_run_id"
    if step and path.is_file():
        return path.read_text(encoding="utf-8").strip()
    made = secrets.token_hex(4)
    run_dir.mkdir(parents=True, exist_ok=True)
    atomic.write_text(path, made + "\n")
    return made


def _lines(path: Path) -> list[str]:
    if not path.is_file():
        return []
    text = path.read_text(encoding="utf-8")
    # A killed process may leave half a line at the end.
    return [line for line in text.splitlines(keepends=True) if line.endswith("\n")]


def _step(line: str) -> float:
    try:
        return float(json.loads(line)["step"])
    except (KeyError, TypeError, ValueError):
        return float("inf")
