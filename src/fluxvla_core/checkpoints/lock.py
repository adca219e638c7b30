"""The lock of a work dir: one training at a time writes its checkpoints.

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

from fluxvla_core.checkpoints.checkpoint import folders
from fluxvla_core.errors import RunFailed, UsageError

LOCK = "run.lock"
PATIENCE_S = 5.0
"""How long a process that was killed just now may take to be gone."""


class WorkDirLock:
    """The lock of a work dir, held until it is closed; ``lock_work_dir`` makes it.

    Args:
        work_dir: absolute, with symbolic links as they are: one may be made to lead elsewhere.
        file: the lock; None where there is none to give back.
        outer: the lock that this process has already; it lives as long as this one.
    """

    def __init__(
        self, work_dir: Path, file: IO[str] | None, outer: WorkDirLock | None = None
    ) -> None:
        self.work_dir, self._file, self._outer, self.active = work_dir, file, outer, False
        self._place = os.open(work_dir, os.O_RDONLY)
        self.active = True

    def __del__(self) -> None:
        self.close()

    def close(self) -> None:
        """Release the lock; may be called several times."""
        if self.active:
            os.close(self._place)
        file, self._file, self._outer, self.active = self._file, None, None, False
        if file is not None:
            file.close()

    def check(self) -> None:
        """Raise an error if the work dir is no longer the one that was locked.

        A training that continued would fill a place that somebody cleared, or another one's.

        Raises:
            RunFailed: it was removed, moved or replaced; and where its checkpoints are now.
        """
        if self._outer is not None:
            self._outer.check()
            return
        same = _is_at(self._place, self.work_dir)
        if not same:
            raise self._lost(_path_of(self._place))
        if self._file is not None and not _is_at(self._file.fileno(), self.work_dir / LOCK):
            cause = f"{LOCK} in it was removed or replaced: another training may have begun there"
            raise self._lost(self.work_dir, cause)

    def _lost(self, now: Path | None, cause: str | None = None) -> RunFailed:
        if cause is None:
            cause = "it was removed" if now is None else f"it is at {now} now"
            if self.work_dir.exists():
                cause += "; what is there now is not this training's, and was left as it is"
        saved = folders(now) if now is not None else []
        advice = "start it again with a --work-dir that stays"
        if now is None:
            cause += "; what was saved there is gone with it"
        elif saved:
            cause += f"; the newest checkpoint is {saved[-1]}"
            advice = (
                f"continue with --work-dir {now} --resume auto, when no other training is there"
            )
        else:
            cause += "; nothing was saved there yet"
        return RunFailed(
            f"the work dir {self.work_dir} was taken away from this training, which has stopped",
            cause=cause,
            next=advice,
            reason="work dir lost",
        )

    @property
    def held(self) -> bool:
        """Whether this lock is held."""
        return self._file is not None


# The key holds the process id because a forked process inherits this table but not the locks: it
# would take its parent's lock for its own.
_held: WeakValueDictionary[tuple[int, Path], WorkDirLock] = WeakValueDictionary()


def lock_work_dir(work_dir: Path, warn: Callable[[str], None]) -> WorkDirLock:
    """Keep other trainings out of ``work_dir``, which must exist, until the lock is closed.

    Args:
        warn: called if the file system has no locks; the lock then keeps nobody out.

    Raises:
        UsageError: another process has it; says which.
    """
    # realpath, because resolve() fails on links that lead to themselves.
    place, path = work_dir.absolute(), Path(os.path.realpath(work_dir)) / LOCK
    before = _held.get((os.getpid(), path))
    if before is not None and before.active:
        return WorkDirLock(place, None, before)
    try:
        file = _locked(path)
    except OSError as error:
        file = None
        warn(
            f"{path} cannot be locked ({error.strerror or error}): nothing keeps a second training "
            "out of this work dir"
        )
    found = _held[os.getpid(), path] = WorkDirLock(place, file)
    return found


def _is_at(descriptor: int, path: Path) -> bool:
    """Whether ``path`` still names what is open as ``descriptor``.

    Only what says that it does not counts: a server that does not answer may do so again.
    """
    try:
        return os.path.samestat(os.fstat(descriptor), os.stat(path))
    except OSError as error:
        return error.errno not in (errno.ENOENT, errno.ENOTDIR, errno.ESTALE)


def _path_of(descriptor: int) -> Path | None:
    """The current path of an open folder, if the system has it (Linux); None if removed."""
    try:
        found = Path(os.readlink(f"/proc/self/fd/{descriptor}"))
    except OSError:
        return None
    return found if _is_at(descriptor, found) else None


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
    """Try to take the lock; a process that was killed just now may keep it for a moment."""
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
