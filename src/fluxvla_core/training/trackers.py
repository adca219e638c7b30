"""Trackers: JSON lines, TensorBoard, Weights & Biases, Trackio. One that fails ends no run."""

from __future__ import annotations

import json
import os
import secrets
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stdout
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from fluxvla_core import atomic
from fluxvla_core.contracts.runner import Reporter
from fluxvla_core.errors import ConfigError, nearest

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
    make = _KINDS[name][0]
    return Guarded(name, reporter, lambda: make(run_dir, run_id, step, hparams))


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
