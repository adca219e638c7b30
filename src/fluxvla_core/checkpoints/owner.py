"""Whose a work dir is: one training at a time writes its checkpoints.

The lock is the system's record lock on a file (POSIX ``fcntl``). It ends with its process, however
that ends, is not passed on to forked loader workers as one of ``flock`` would be, and holds between
machines on file systems that they share. It belongs to the process: two runs in one process are
not kept apart, and the file must not be opened and closed elsewhere in it, which would let go.
"""

from __future__ import annotations

import errno
import json
import os
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import IO
from weakref import WeakValueDictionary

from fluxvla_core.errors import UsageError

LOCK = "run.lock"
PATIENCE_S = 5.0
"""How long a process that was killed just now may take to be gone."""


class Claim:
    """A work dir that is this process's until it is closed; ``claim`` makes it.

    Args:
        file: the lock; None where there is none to give back.
        outer: the claim that this process has already; it lives as long as this one.
    """

    def __init__(self, file: IO[str] | None, outer: Claim | None = None) -> None:
        self._file, self._outer = file, outer
        self.active = True

    def close(self) -> None:
        """Let others have it; any number of times."""
        file, self._file, self._outer, self.active = self._file, None, None, False
        if file is not None:
            file.close()

    @property
    def held(self) -> bool:
        """Whether it is this one that keeps others out."""
        return self._file is not None


# By process too: a fork inherits the table, and not the locks.
_held: WeakValueDictionary[tuple[int, Path], Claim] = WeakValueDictionary()


def claim(work_dir: Path, warn: Callable[[str], None]) -> Claim:
    """Keep other trainings out of ``work_dir``, which must exist, until the claim is closed.

    Args:
        warn: is told if the file system has no locks; the claim then keeps nobody out.

    Raises:
        UsageError: another process has it; says which.
    """
    path = work_dir.resolve() / LOCK
    before = _held.get((os.getpid(), path))
    if before is not None and before.active:
        return Claim(None, before)
    try:
        file = _locked(path)
    except OSError as error:
        file = None
        warn(
            f"{path} cannot be locked ({error.strerror or error}): nothing keeps a second training "
            "out of this work dir"
        )
    found = _held[os.getpid(), path] = Claim(file)
    return found


def _locked(path: Path) -> IO[str]:
    """The file at ``path``, with the lock on it and this process's name in it."""
    file = path.open("a+")
    try:
        if not _lock(file):
            file.seek(0)
            raise _in_use(path, file.read())
        file.truncate(0)
        since = time.strftime("%Y-%m-%d %H:%M:%S")
        file.write(json.dumps({"host": socket.gethostname(), "pid": os.getpid(), "since": since}))
        file.flush()
    except BaseException:
        file.close()
        raise
    return file


def _lock(file: IO[str]) -> bool:
    """Whether the lock could be had; a predecessor is given time to be gone."""
    import fcntl

    until = time.monotonic() + PATIENCE_S
    while True:
        try:
            fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno not in (errno.EACCES, errno.EAGAIN):
                raise
        else:
            return True
        if time.monotonic() >= until:
            return False
        time.sleep(0.1)


def _in_use(path: Path, said: str) -> UsageError:
    who, end = "", "end it"
    try:
        owner = json.loads(said)
        who = f": process {owner['pid']} on {owner['host']}, since {owner['since']}"
        end = f"end it (kill {owner['pid']})"
    except (ValueError, KeyError, TypeError):
        # It has begun this very moment.
        pass
    return UsageError(
        f"{path.parent} is in use by another training{who}",
        cause="the same command was started twice, or processes of a run that was killed live on",
        next=f"wait for it, {end}, or name another --work-dir; if its machine is gone for good: "
        f"rm {path}",
    )
