"""Ranks: a process's place among those of a training, and its records for the launcher.

Each rank of ``fluxvla run --nproc N`` writes its error to a file instead of the terminal: when
one fails the others fail because of it, and only the first error helps.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NoReturn

from fluxvla_core.errors import EndReason, RunFailed

ERROR_DIR = "FLUXVLA_ERROR_DIR"
LAUNCHER = "FLUXVLA_LAUNCHER_PID"
JOB = "run.job"
"""File of a work dir: the job of several processes that began to train there last."""
_TAKEN = "taken"  # in the agent's folder: its job's work dir was taken away, with the message
_NO_ID = "none"  # torchrun's --rdzv-id, of any job that was given none
GRACE_S = 600
"""Seconds for a checkpoint, between asking ranks to stop and killing them."""


def rank() -> int:
    """This process's global rank (``RANK``, set by torchrun); 0 when it is alone."""
    return int(os.environ.get("RANK", "0"))


def world_size() -> int | None:
    """The number of ranks (``WORLD_SIZE``); None when nobody launched ranks."""
    text = os.environ.get("WORLD_SIZE")
    return int(text) if text else None


def attempt() -> int:
    """The number of earlier restarts of this job's processes (torchrun counts them)."""
    return int(os.environ.get("TORCHELASTIC_RESTART_COUNT", "0"))


def resume_from(asked: str | None, work_dir: Path) -> str | None:
    """The checkpoint to resume from: ``--resume``, or after a restart the newest one.

    The newest one only if this job wrote it: an attempt that was refused is refused again, and does
    not continue from the checkpoints of others.
    """
    if attempt() == 0 or not _started_here(work_dir):
        return asked
    from fluxvla_core.checkpoints.checkpoint import folders

    return "auto" if asked is None or folders(work_dir) else asked


def mark_started(work_dir: Path) -> None:
    """Mark ``work_dir`` as this job's, once its setup has succeeded."""
    from fluxvla_core.atomic import write_text

    if rank() != 0:
        return
    if has_agent():
        write_text(work_dir / JOB, json.dumps(_job()))
    else:  # nothing restarts this process, and the place is no longer the earlier job's
        (work_dir / JOB).unlink(missing_ok=True)


def refuse_lost_work_dir() -> None:
    """Refuse to restart a job that lost its work dir: another one may be there now.

    Raises:
        RunFailed: the error that it ended with.
    """
    place = _agent_folder()
    if attempt() and place is not None and (place / _TAKEN).exists():
        raise RunFailed((place / _TAKEN).read_text(encoding="utf-8"))


def _agent_folder() -> Path | None:
    """The agent's own folder, which it makes once: AGENT/attempt_N/RANK/error.json is in it."""
    file = os.environ.get("TORCHELASTIC_ERROR_FILE", "")
    return Path(file).parents[2] if file.count(os.sep) > 2 else None


def _started_here(work_dir: Path) -> bool:
    """Whether it is this job that began last in ``work_dir``."""
    own_job = _job()
    try:
        saved_job = json.loads((work_dir / JOB).read_text(encoding="utf-8"))
        # Of several machines another may have the first rank now. On the same one, a name that
        # is used again and again is another job's.
        moved = saved_job["id"] == own_job["id"] != _NO_ID and saved_job["host"] != own_job["host"]
    except (OSError, ValueError, KeyError, TypeError):
        return False
    return bool(saved_job == own_job or moved)


def _job() -> dict[str, str]:
    """The identity of a job, which is the same after a restart."""
    import socket

    # The parent is the agent too, but in containers all have the same number, and a script may be
    # between.
    agent = str(_agent_folder() or os.getppid())
    job = os.environ.get("TORCHELASTIC_RUN_ID", _NO_ID)
    return {"id": job, "host": socket.gethostname(), "agent": agent}


def restart_notice() -> list[str]:
    """Messages to report first after a restart: which one it is, and why it was needed."""
    if attempt() == 0:
        return []
    why = "a process ended without an error message"
    if launched():
        folder = Path(os.environ[ERROR_DIR])
        said = failures(folder, attempt() - 1)
        ended = {*said, *dict(_read_records(folder, "done", attempt() - 1))}
        silent = [str(rank) for rank in range(world_size() or 1) if rank not in ended]
        found = [failure for failure in said.values() if not failure.asked]
        if found:
            first = root_cause(found)
            why = f"rank {first.rank} failed:\n{first.text.rstrip()}"
        elif silent:
            listed = ", ".join(silent)
            why = f"rank {listed} ended without an error message: killed, or crashed below Python"
    return [f"restart {attempt()}: {why}"]


def exit_now(code: int) -> NoReturn:
    """Flush the output and end this rank's process at once.

    gloo's threads can outlive the interpreter and then abort it ("terminate called without an
    active exception") after all work is done and saved, which a launcher takes for a failure.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def launched() -> bool:
    """Whether ``fluxvla run --nproc`` started this process."""
    return ERROR_DIR in os.environ


def has_agent() -> bool:
    """Whether torch's agent started this process: ``fluxvla run --nproc``, or torchrun."""
    return launched() or "TORCHELASTIC_RUN_ID" in os.environ


@dataclass(frozen=True)
class Failure:
    """The end of one rank.

    Args:
        time: monotonic seconds, which all processes of a machine share.
        expected: a FluxError, whose text says everything.
        asked: it ended because another rank had: stopped from outside, or cut off from it.
        silent: it left no record: killed, or crashed below Python.
    """

    rank: int
    time: float
    text: str
    code: int
    expected: bool = False
    asked: bool = False
    silent: bool = False


def record_failure(
    text: str, code: int, *, expected: bool, reason: EndReason | None = None
) -> bool:
    """Leave an error for the launcher; False if there is none to read it.

    Args:
        expected: it is a FluxError.
        reason: what ended this rank's work, where that is known.
    """
    place = _agent_folder()
    if reason == "work dir lost" and place is not None and place.is_dir():
        with suppress(OSError):  # what follows says it too
            (place / _TAKEN).write_text(text, encoding="utf-8")
    if not launched():
        return False
    asked = reason in ("stopped", "rank lost")
    failure = Failure(rank(), time.monotonic(), text, code, expected, asked)
    return _write_record("rank", asdict(failure))


def record_finished(late: int) -> None:
    """Report to the launcher that this rank is done.

    Args:
        late: the signal that asked it to stop when there was nothing left to stop, or 0.
    """
    if launched():
        _write_record("done", [rank(), late])


def failures(folder: Path, which: int | None = None) -> dict[int, Failure]:
    """Recorded failures by rank, in the ``which``-th attempt; in the last one by default."""
    found = [Failure(**said) for said in _read_records(folder, "rank", which)]
    return {failure.rank: failure for failure in sorted(found, key=lambda f: f.rank)}


def finished(folder: Path) -> dict[int, int]:
    """The ranks that were done in the last attempt, each with the signal that came late, or 0."""
    return dict(_read_records(folder, "done"))


def _write_record(kind: str, said: object) -> bool:
    """Write a record for the launcher; False if that cannot be."""
    from fluxvla_core.atomic import write_text

    try:
        path = Path(os.environ[ERROR_DIR]) / f"{kind}-{rank()}.{attempt()}.json"
        write_text(path, json.dumps(said))
    except OSError:  # the launcher is gone, or the disk is full: the terminal is what is left
        return False
    return True


def _read_records(folder: Path, kind: str, which: int | None = None) -> list[Any]:
    """The records of an attempt, the last one by default."""
    paths = {path: int(path.name.split(".")[1]) for path in folder.glob("*-*.*.json")}
    if which is None:
        which = max(paths.values(), default=0)
    found = []
    for path, number in paths.items():
        if number == which and path.name.startswith(kind):
            # A disk that is full, or fails, must not hide what the other ranks said.
            with suppress(OSError, ValueError):
                found.append(json.loads(path.read_text(encoding="utf-8")))
    return found


def root_cause(found: Sequence[Failure]) -> Failure:
    """The failure that most likely caused the others.

    A rank that was asked to stop never is. A FluxError names a cause; a rank that was killed
    explains the broken connections of the others; else the earliest is.
    """
    return min(found, key=lambda f: (f.asked, not f.expected, not f.silent, f.time))
