"""``PolicyThread``: where a policy computes, so that commands never wait for it."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future, wait
from typing import Any, TypeVar

T = TypeVar("T")


class PolicyThread:
    """One thread in which a policy thinks, so that the one that sends commands never waits for it.

    Runs jobs one after the other in a daemon thread; a job that hangs cannot keep the process.

    ``concurrent.futures.ThreadPoolExecutor`` would wait for a hung job when the program ends.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._jobs: queue.SimpleQueue[tuple[Future[Any], Callable[[], Any]] | None] = (
            queue.SimpleQueue()
        )
        self._thread: threading.Thread | None = None
        self._newest: Future[Any] | None = None

    def idle_within(self, seconds: float) -> bool:
        """Whether no job runs or waits any more after so many seconds at most."""
        return self._newest is None or bool(wait((self._newest,), seconds).done)

    def submit(self, job: Callable[[], T]) -> Future[T]:
        """Have ``job`` run; its result, or what it raised, is in the future."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name=self._name, daemon=True)
            self._thread.start()
        future: Future[T] = Future()
        self._newest = future
        self._jobs.put((future, job))
        return future

    def close(self, timeout: float) -> bool:
        """Let the thread end after its present job; whether it did within ``timeout`` seconds."""
        if self._thread is None:
            return True
        self._jobs.put(None)
        self._thread.join(timeout)
        ended = not self._thread.is_alive()
        self._thread = None
        return ended

    def _run(self) -> None:
        while (item := self._jobs.get()) is not None:
            future, job = item
            try:
                future.set_result(job())
            except BaseException as error:  # noqa: BLE001 - it is raised where the result is read
                future.set_exception(error)
