"""``--nproc N``: N ranks of this command, started by torch's own elastic agent."""

from __future__ import annotations

import ctypes
import logging
import os
import signal
import sys
import tempfile
import time
import uuid
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from fluxvla_core.cli import ranks
from fluxvla_core.cli.terminal import say
from fluxvla_core.errors import EXIT_DONE, EXIT_FAILED, EXIT_INTERRUPTED, RunFailed, UsageError
from fluxvla_core.signals import requests_to_stop, signal_name

_STOP_S = 30
"""Seconds that torch's agent gives the other ranks to end when one has failed."""
_PR_SET_PDEATHSIG = 1  # linux/prctl.h


def launch(
    nproc: int, argv: Sequence[str], work_dir: Path, restarts: int = 0, grace: int = ranks.GRACE_S
) -> tuple[int, int]:
    """Run ``fluxvla run *argv`` in ``nproc`` processes with RANK, WORLD_SIZE and the like set.

    Ranks share this terminal; rank 0 alone reports. When one fails the others are stopped. Up to
    ``restarts`` times all are started again, from the newest checkpoint; after that the message and
    the exit code of the one that failed first are this command's. Asked to stop, they have
    ``grace`` seconds to save in ``work_dir``; then they are killed.

    Returns:
        The exit code, and the signal that asked to stop when all was done, or 0.

    Raises:
        UsageError: torch is not installed, or this process is itself a rank.
        RunFailed: a rank was killed, or this command was; there is no temporary folder.
        KeyboardInterrupt: Ctrl-C.
    """
    if ranks.world_size() is not None:
        raise UsageError(
            "--nproc starts ranks, and this process is one already (torchrun set WORLD_SIZE)",
            next="leave --nproc out under torchrun",
        )
    try:
        from torch.distributed.elastic.multiprocessing import DefaultLogsSpecs, SignalException
        from torch.distributed.elastic.multiprocessing.errors import ChildFailedError
        from torch.distributed.launcher.api import LaunchConfig, elastic_launch

        from fluxvla_core.training.distributed import loopback_store
    except ModuleNotFoundError as error:
        raise UsageError(
            f"--nproc needs {error.name}, which is not installed",
            next="pip install 'fluxvla-core[train]'",
        ) from error

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    os.environ.setdefault("OMP_NUM_THREADS", str(max(1, (cores or 1) // nproc)))
    # Its agent reports failures in its own way; ours are the ranks' own messages.
    logging.disable(logging.CRITICAL)
    try:
        with _scratch() as folder:
            os.environ[ranks.ERROR_DIR] = folder
            os.environ[ranks.LAUNCHER] = str(os.getpid())
            store = loopback_store()
            config = LaunchConfig(
                min_nodes=1,
                max_nodes=1,
                nproc_per_node=nproc,
                run_id=uuid.uuid4().hex,
                rdzv_backend="static",
                rdzv_endpoint=f"{store.host}:{store.port}",
                rdzv_configs={"rank": 0},
                local_addr=store.host,
                max_restarts=restarts,
                signals_to_handle=",".join(signal.Signals(n).name for n in requests_to_stop()),
                shutdown_timeout=grace,
                logs_specs=DefaultLogsSpecs(log_dir=folder),
            )
            agent = elastic_launch(config, sys.executable)
            try:
                code = _watch(agent, argv, Path(folder), ChildFailedError)
                return code, max(ranks.finished(Path(folder)).values(), default=0)
            except SignalException as error:
                number = signal.Signals(error.sigval)
                return _signalled(number, Path(folder), nproc, work_dir, grace)
    finally:
        for name in (ranks.ERROR_DIR, ranks.LAUNCHER):
            os.environ.pop(name, None)
        logging.disable(logging.NOTSET)


def _scratch() -> tempfile.TemporaryDirectory[str]:
    """A temporary folder for the messages of ranks.

    Raises:
        RunFailed: there is no place for it.
    """
    try:
        return tempfile.TemporaryDirectory(prefix="fluxvla-ranks-")
    except OSError as error:
        # tempfile says "no such file" where all places are full.
        raise RunFailed(
            f"no temporary folder can be made for the ranks: {error.strerror or error}",
            cause="the disk of the temporary files is full or cannot be written",
            next="make room there, or name another place: export TMPDIR=DIR",
        ) from error


def _watch(agent: Any, argv: Sequence[str], folder: Path, failed: type[Any]) -> int:
    try:
        agent("-m", "fluxvla_core", "run", *argv)
    except failed as error:
        return _report_failure(ranks.root_cause(_all(error.failures, ranks.failures(folder))))
    return 0


def _signalled(
    number: signal.Signals, folder: Path, nproc: int, work_dir: Path, grace: int
) -> tuple[int, int]:
    """How this command ends after a signal: well, if all ranks had done all by then."""
    done, said = ranks.finished(folder), list(ranks.failures(folder).values())
    if len(done) == nproc:
        return EXIT_DONE, number
    unsaved = _unsaved(nproc - len(done) - len(said), nproc, work_dir, grace)
    return _stopped(number, said, unsaved), 0


def _stopped(number: signal.Signals, said: list[ranks.Failure], unsaved: RunFailed | None) -> int:
    """How this command ends after a signal, by the records of the ranks."""
    failed = [f for f in said if not f.asked and f.code != EXIT_INTERRUPTED]
    if failed:
        return _report_failure(ranks.root_cause(failed))
    if number == signal.SIGINT:
        if unsaved is not None:
            raise KeyboardInterrupt(str(unsaved)) from unsaved
        raise KeyboardInterrupt(_after("interrupted", said))
    if unsaved is not None:
        raise unsaved
    return _report_failure(ranks.root_cause(said))


def _unsaved(silent: int, nproc: int, work_dir: Path, grace: int) -> RunFailed | None:
    """The error where ``silent`` ranks left no record, as they had to be killed."""
    from fluxvla_core.checkpoints.checkpoint import folders

    if not silent:
        return None
    # A checkpoint gets its name when it is complete; verifying its hashes would take long.
    found = folders(work_dir)
    left = f"the newest checkpoint is {found[-1]}" if found else "there is no checkpoint yet"
    return RunFailed(
        f"{silent} of {nproc} ranks were killed, or had not begun, when they were to stop and save",
        cause=f"saving took longer than --grace {grace} (seconds)",
        next=f"{left}: run the same command again with --resume auto",
    )


def _all(ended: Mapping[int, Any], reported: Mapping[int, ranks.Failure]) -> list[ranks.Failure]:
    """The failure of each rank: its own record, or how its process ended."""
    now = time.monotonic()
    first = min((f.time for f in reported.values()), default=now)
    failures = []
    for rank, process in ended.items():
        if rank in reported:
            failures.append(reported[rank])
            continue
        # SIGTERM came from us, and so did SIGKILL to one that did not answer it in time.
        late = process.exitcode == -signal.SIGKILL and now - first >= _STOP_S
        terminated = late or process.exitcode == -signal.SIGTERM
        code = process.exitcode
        ending = f"killed by {signal_name(-code)}" if code < 0 else f"exit code {code}"
        text = f"ended without an error message: {ending}"
        if process.exitcode == -signal.SIGKILL:
            text += (
                "\n  likely cause: this machine, or its container, ran out of memory (see "
                "dmesg), or somebody killed it"
            )
        elif process.exitcode < 0:
            text += (
                "\n  likely cause: a crash below Python; python -X faulthandler shows where, or "
                "somebody sent it the signal"
            )
        text += "\n  next: run the same command again with --resume auto"
        failures.append(ranks.Failure(rank, now, text, EXIT_FAILED, asked=terminated, silent=True))
    return failures


def _report_failure(failure: ranks.Failure) -> int:
    """Print the rank's message; returns its exit code."""
    join = " " if failure.silent else " failed:\n"
    text = failure.text if failure.expected else f"rank {failure.rank}{join}{failure.text}"
    say(text, sys.stderr)
    return failure.code


def _after(prefix: str, said: list[ranks.Failure]) -> str:
    """The rest of an interrupted rank's message (where it saved), without the prefix."""
    texts = [
        f.text.removeprefix(prefix).removeprefix(": ") for f in said if f.code == EXIT_INTERRUPTED
    ]
    return texts[0] if texts else ""


def die_with_parent() -> None:
    """Make this rank end when its launcher, or torchrun's agent, does, even by ``kill -9``.

    Ranks that trained on would keep the work dir locked for the next ``--resume auto``.
    """
    if not sys.platform.startswith("linux"):
        return
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_PDEATHSIG) failed")
    # It may have been gone before the call; torchrun's agent does not say which process it is.
    if str(os.getppid()) != os.environ.get(ranks.LAUNCHER, str(os.getppid())):
        raise RunFailed("the launcher of this rank has ended")
