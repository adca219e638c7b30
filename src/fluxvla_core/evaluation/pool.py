"""A pool of worker processes for jobs that may crash.

A worker is built once per process by a factory and then called with one job after another. A
process that dies, hangs or raises is replaced: what made one job fail may be broken for good in it,
as a lost renderer is. The job that it had is tried once more in another process; if that fails too
it is an error of that job, and the others continue. What cannot get better by trying again (a
``FluxError`` that means bad input) ends the run at once.
"""

from __future__ import annotations

import multiprocessing
import os
import time
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import Any

from fluxvla_core.errors import EXIT_BAD_INPUT, FluxError, RunFailed
from fluxvla_core.plugins.registry import load_plugin_files, plugin_files
from fluxvla_core.signals import held_back, leave_stopping_to_the_parent, signal_name

Work = Callable[[Any], Any]
Factory = Callable[..., Work]
Link = Callable[[], Connection]

ONE_THREAD: Mapping[str, str] = {
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "LP_NUM_THREADS": "1",
}
"""Environment of workers: each is one of several, and sums must not depend on a thread count.
``LP_NUM_THREADS`` is the software renderer's."""

ATTEMPTS = 2
"""How often a job is tried."""
_GRACE_S = 5.0


@dataclass(frozen=True)
class Outcome:
    """The result of one job, or its error.

    Args:
        index: the job's place in the sequence that was given.
        result: what the worker returned; None after an error.
        error: why there is no result, with the worker's traceback if it raised.
        attempts: how many times it was tried.
    """

    index: int
    result: Any
    error: str | None
    attempts: int


class _Worker:
    """One process and the job that it has."""

    def __init__(self, factory: Factory, link: Link | None) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        more = None if link is None else link()
        arguments = (theirs, factory, plugin_files(), more)
        self.process = context.Process(target=_serve, args=arguments, daemon=True)
        with _environment(ONE_THREAD), held_back("spawn"):
            self.process.start()
        theirs.close()
        if more is not None:
            more.close()
        self.ready = False
        self.job: int | None = None
        self.deadline: float | None = None

    def give(self, index: int, job: Any, timeout_s: float | None) -> None:
        self.job = index
        self.deadline = None if timeout_s is None else time.monotonic() + timeout_s
        with suppress(OSError):  # it died since; reading its end of the pipe will show it
            self.connection.send(job)

    def end(self, grace_s: float = 0.0) -> None:
        with suppress(OSError):
            self.connection.close()
        self.process.join(grace_s)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()


class WorkerPool:
    """Worker processes, started when there are jobs and kept until :meth:`close`.

    Use as a context manager.

    Args:
        factory: makes the worker, in its process; it, the jobs and the results are pickled.
        workers: processes; never more than there are jobs.
        timeout_s: how long one attempt may take before its process is ended.
        link: gives each new process a connection of its own to something in this one; the factory
            is called with it then.

    Attributes:
        ready_s: how long the first worker took to be built; None before there is one.

    Raises:
        ValueError: ``workers`` is below 1.
    """

    def __init__(
        self,
        factory: Factory,
        workers: int,
        timeout_s: float | None = None,
        link: Link | None = None,
    ) -> None:
        if workers < 1:
            raise ValueError(f"workers must be at least 1, got {workers}")
        self.ready_s: float | None = None
        self._factory = factory
        self._most = workers
        self._timeout_s = timeout_s
        self._link = link
        self._workers: list[_Worker] = []
        self._failed_starts = 0
        self._began = 0.0
        self._jobs: Sequence[Any] = ()
        self._waiting: deque[int] = deque()
        self._attempts: list[int] = []

    def run(self, jobs: Sequence[Any]) -> Generator[Outcome, None, None]:
        """Outcomes of ``jobs``, which are given out in their order, as they end.

        Closing the generator, or an exception in it, closes the pool.

        Raises:
            RunFailed: a worker cannot be started.
            FluxError: one that means bad input, from the factory or a job, as it was raised.
        """
        self._jobs, self._waiting = jobs, deque(range(len(jobs)))
        self._attempts = [0] * len(jobs)
        left = len(jobs)
        try:
            if not self._workers:
                self._began = time.monotonic()
            for worker in self._workers:
                if worker.ready:
                    self._next(worker)
            while len(self._workers) < min(self._most, left):
                self._workers.append(_Worker(self._factory, self._link))
            while left:
                for outcome in self._wait():
                    left -= 1
                    yield outcome
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """End the workers; any number of times."""
        # Idle workers leave by themselves when their pipe closes; busy ones are ended.
        for worker in self._workers:
            with suppress(OSError):
                worker.connection.close()
        for worker in self._workers:
            worker.end(0.0 if worker.job is not None else _GRACE_S)
        self._workers = []

    def __enter__(self) -> WorkerPool:
        return self

    def __exit__(self, *details: object) -> None:
        self.close()

    def _wait(self) -> list[Outcome]:
        readable = wait([w.connection for w in self._workers], timeout=self._patience())
        ended = []
        for worker in list(self._workers):
            late = worker.deadline is not None and time.monotonic() > worker.deadline
            # An answer may have come since: what kept this process may have kept it too long.
            if worker.connection in readable or (late and worker.connection.poll()):
                outcome = self._receive(worker)
            elif late:
                outcome = self._lost(worker, f"took longer than {self._timeout_s:g} s")
            else:
                continue
            if outcome is not None:
                ended.append(outcome)
        return ended

    def _patience(self) -> float | None:
        deadlines = [w.deadline for w in self._workers if w.deadline is not None]
        return max(0.0, min(deadlines) - time.monotonic()) + 0.01 if deadlines else None

    def _receive(self, worker: _Worker) -> Outcome | None:
        try:
            kind, value = worker.connection.recv()
        except (EOFError, OSError):
            worker.process.join(_GRACE_S)
            return self._lost(worker, f"its process died ({_cause(worker.process.exitcode)})")
        if kind == "refused":
            raise value
        if kind == "unusable":
            raise RunFailed(f"a worker process could not be set up:\n{value}")
        if kind == "ready":
            worker.ready = True
            if self.ready_s is None:
                self.ready_s = time.monotonic() - self._began
            self._next(worker)
            return None
        if kind == "raised":
            return self._lost(worker, str(value))
        index, worker.job, worker.deadline = worker.job, None, None
        assert index is not None
        self._next(worker)
        return Outcome(index, value, None, self._attempts[index])

    def _next(self, worker: _Worker) -> None:
        if self._waiting:
            index = self._waiting.popleft()
            self._attempts[index] += 1
            worker.give(index, self._jobs[index], self._timeout_s)

    def _lost(self, worker: _Worker, why: str) -> Outcome | None:
        """Replace a worker that is gone, or must go, and settle the job that it had."""
        index, ready = worker.job, worker.ready
        self._workers.remove(worker)
        worker.end()
        if not ready:
            self._failed_starts += 1
            if self._failed_starts > len(self._workers) + 1:
                raise RunFailed(
                    f"worker processes die before they have begun: {why}",
                    cause="out of memory, or a library that crashes while it is loaded",
                    next="try again with one: --set <section>.workers=1",
                )
        outcome = None if index is None else self._again(index, why)
        if self._waiting:
            self._workers.append(_Worker(self._factory, self._link))
        return outcome

    def _again(self, index: int, why: str) -> Outcome | None:
        if self._attempts[index] == ATTEMPTS:
            return Outcome(index, None, why, self._attempts[index])
        self._waiting.appendleft(index)
        for worker in self._workers:
            if worker.ready and worker.job is None:
                self._next(worker)
                break
        return None


def _cause(exitcode: int | None) -> str:
    if exitcode is None:
        return "no exit code"
    if exitcode < 0:
        return signal_name(-exitcode)
    return f"exit code {exitcode}"


@contextmanager
def _environment(extra: Mapping[str, str]) -> Iterator[None]:
    """``extra`` in this process's environment while a child is started, for it to inherit."""
    before = {name: os.environ.get(name) for name in extra}
    os.environ.update(extra)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _serve(
    connection: Connection,
    factory: Factory,
    plugins: tuple[str, ...],
    link: Connection | None,
) -> None:
    """Main function of a worker process: build the worker, run jobs until the pipe closes."""
    leave_stopping_to_the_parent()
    with suppress(EOFError, OSError):  # the parent is gone: no answer is needed
        try:
            load_plugin_files(plugins)
            work = factory() if link is None else factory(link)
        except FluxError as error:
            connection.send(("refused", error))
            return
        except Exception:  # noqa: BLE001 - whatever it is belongs to the parent
            connection.send(("unusable", traceback.format_exc()))
            return
        connection.send(("ready", None))
        while True:
            connection.send(_answer(work, connection.recv()))


def _answer(work: Work, job: Any) -> tuple[str, Any]:
    try:
        return "done", work(job)
    except FluxError as error:
        if error.exit_code == EXIT_BAD_INPUT:
            return "refused", error
        return "raised", str(error)
    except Exception:  # noqa: BLE001 - an episode's crash is counted, not raised
        return "raised", traceback.format_exc()
