"""What a process knows of being one of several, and how it tells its launcher why it failed.

Each rank of ``fluxvla run --nproc N`` writes its error to a file instead of the terminal: when
one fails the others fail of it, and only the first one's words help.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NoReturn

ERROR_DIR = "FLUXVLA_ERROR_DIR"
LAUNCHER = "FLUXVLA_LAUNCHER_PID"


def rank() -> int:
    """This process's global rank (``RANK``, set by torchrun); 0 when it is alone."""
    return int(os.environ.get("RANK", "0"))


def world_size() -> int | None:
    """How many ranks there are (``WORLD_SIZE``); None when nobody launched ranks."""
    text = os.environ.get("WORLD_SIZE")
    return int(text) if text else None


def leave(code: int) -> NoReturn:
    """End this rank's process at once, with everything it said written out.

    gloo's threads can outlive the interpreter and then abort it ("terminate called without an
    active exception") after all work is done and saved; a launcher takes that for a failure.
    Leaving this way gives them no chance to.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def launched() -> bool:
    """Whether ``fluxvla run --nproc`` started this process."""
    return ERROR_DIR in os.environ


@dataclass(frozen=True)
class Failure:
    """How one rank ended.

    Args:
        time: monotonic seconds, which all processes of a machine share.
        expected: a FluxError, whose text says everything.
        asked: it ended because another rank had: stopped from outside, or cut off from it.
        wordless: it left no record: killed, or crashed below Python.
    """

    rank: int
    time: float
    text: str
    code: int
    expected: bool = False
    asked: bool = False
    wordless: bool = False


def record(text: str, code: int, *, expected: bool) -> bool:
    """Leave an error for the launcher; False if there is none to read it."""
    if not launched():
        return False
    # What training, robot loops and this command line say of a SIGTERM, and training of a rank
    # that is gone.
    asked = "stopped by SIGTERM" in text or "lost another rank" in text
    failure = Failure(rank(), time.monotonic(), text, code, expected, asked)
    path = Path(os.environ[ERROR_DIR]) / f"rank-{failure.rank}.json"
    try:
        path.write_text(json.dumps(asdict(failure)))
    except OSError:  # the launcher is gone, or the disk is full: the terminal is what is left
        return False
    return True


def failures(folder: Path) -> dict[int, Failure]:
    """What ranks recorded, by rank."""
    found = [Failure(**json.loads(path.read_text())) for path in folder.glob("rank-*.json")]
    return {failure.rank: failure for failure in sorted(found, key=lambda f: f.rank)}


def root_cause(found: Sequence[Failure]) -> Failure:
    """The failure that the others followed from, as well as can be told.

    A rank that was asked to stop never is. A FluxError names a cause; a rank that was killed
    explains the broken connections of the others; else the earliest is.
    """
    return min(found, key=lambda f: (f.asked, not f.expected, not f.wordless, f.time))
