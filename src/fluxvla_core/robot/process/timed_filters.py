"""``TimedFilter``: an action filter of the user's in the control process, within a time limit.

A filter computes between two commands. One that takes too long would make a command late, one that
hangs would leave the arm to its last command. Here each computes in a thread of its own, and what
is not there in time is left out. A filter that holds the GIL cannot be interrupted:
the main process then sees that the control process does not run, and kills it.
"""

from __future__ import annotations

import inspect
import queue
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from fluxvla_core.contracts.robot import ActionFilter
from fluxvla_core.control import realtime
from fluxvla_core.control.filters import LowPass, SnapGripper, WorkspaceBox
from fluxvla_core.control.safety import BadCommand, FilterLate
from fluxvla_core.robot.process.messages import Array
from fluxvla_core.spec import EmbodimentSpec

SHARE = 0.5
"""Share of the control period that all timed filters together may take: no command is later than
that, and none is skipped."""
MOST_LATE = 3
"""Late commands in a row after which the arm is stopped; the last of them is not sent."""
RESET_S = 0.5
"""How long ``reset`` may take. The control process sends nothing meanwhile; one that does not run
for a second is killed."""
_QUICK = (LowPass, SnapGripper, WorkspaceBox)


def timed_filters(
    filters: Sequence[ActionFilter],
    rate_hz: float,
    warn: Callable[[str], None],
    on_skipped: Callable[[str], None],
) -> list[ActionFilter]:
    """``filters`` in their order, those that are not known to be quick within a time limit.

    The filters of this package run directly, which costs no switch between threads: two of them
    take microseconds, and a ``WorkspaceBox``, which takes up to 2 ms for a target far outside, must
    never be left out. So do classes that add a constructor to one of them and nothing else, such as
    ``URWorkspaceBox``.

    Args:
        filters: bound to the robot.
        rate_hz: commands a second.
        warn: called with a message for people, once an episode for each filter that was late.
        on_skipped: called with a filter's name for each command that is made without it.
    """
    quick = [_is_quick(type(each)) for each in filters]
    share_s = SHARE / rate_hz / max(quick.count(False), 1)
    return [
        each if is_quick else TimedFilter(each, share_s, warn, on_skipped)
        for each, is_quick in zip(filters, quick, strict=True)
    ]


@dataclass(frozen=True)
class _Result:
    """A filter's output, ``(dim,)``, or the exception that it raised."""

    action: Array | None = None
    error: BaseException | None = None


class TimedFilter(ActionFilter):
    """A filter that computes in a thread of its own, and is left out where it is late.

    A thread that still computes is given nothing new: the filter is then late at once. What it
    makes too late is dropped, what it raises too late is raised at the next command.

    Args:
        inner: the filter; bound to the robot.
        share_s: what it may take, in seconds.
        warn: called with a message for people, once an episode.
        on_skipped: called with its name for each command that is made without it.
    """

    def __init__(
        self,
        inner: ActionFilter,
        share_s: float,
        warn: Callable[[str], None],
        on_skipped: Callable[[str], None],
    ) -> None:
        self.name = type(inner).__name__
        self._inner, self._share_s = inner, share_s
        self._warn, self._on_skipped = warn, on_skipped
        self._work: queue.SimpleQueue[Callable[[], Array | None]] = queue.SimpleQueue()
        self._results: queue.SimpleQueue[_Result] = queue.SimpleQueue()
        # Whether the thread was given something that it did not give back.
        self._busy = False
        self._late = 0
        self._warned = False
        name = f"fluxvla-filter-{self.name}"
        threading.Thread(target=self._compute, name=name, daemon=True).start()

    def bind(self, embodiment: EmbodimentSpec) -> None:
        self._inner.bind(embodiment)

    def reset(self, pose: Array) -> None:
        """Begin an episode at ``(dim,)`` ``pose``.

        Raises:
            FilterLate: the filter still computes, or takes longer than ``RESET_S`` for it.
            Exception: what the filter raised.
        """
        self._late, self._warned = 0, False
        deadline = time.monotonic() + RESET_S
        given = pose.copy()

        def work() -> None:
            self._inner.reset(given)

        if self._busy:
            self._take(deadline)
        result = None if self._busy else self._ask(work, deadline)
        if result is None:
            raise FilterLate(
                f"action filter {self.name} was not ready for the episode within {RESET_S:g} s",
                cause="its reset(), or its last call in the episode before, does not return",
                next="prepare what takes long in its bind(), before the robot is connected",
            )
        if result.error is not None:
            raise result.error

    def __call__(self, action: Array) -> Array:
        """The ``(dim,)`` target that takes the place of ``action``; ``action`` if it is late.

        Raises:
            FilterLate: it was late for ``MOST_LATE`` commands in a row.
            BadCommand: it made an action of another shape.
            Exception: what the filter raised.
        """
        deadline = time.monotonic() + self._share_s
        given = action.copy()

        def work() -> Array:
            return np.array(self._inner(given), dtype=np.float64)

        late = self._take(0.0) if self._busy else None
        if late is not None and late.error is not None:
            raise late.error
        result = None if self._busy else self._ask(work, deadline)
        if result is None:
            self._note_late()
            return action
        self._late = 0
        if result.error is not None:
            raise result.error
        assert result.action is not None, "a filter that raised nothing made something"
        if result.action.shape != action.shape:
            raise BadCommand(
                f"action filter {self.name} made an action of shape {result.action.shape} of one "
                f"of shape {action.shape}"
            )
        return result.action

    def _note_late(self) -> None:
        """Report that the filter is late.

        Raises:
            FilterLate: it was so too often.
        """
        self._late += 1
        self._on_skipped(self.name)
        took = f"did not return within {self._share_s * 1e3:.3g} ms"
        if self._late >= MOST_LATE:
            raise FilterLate(
                f"action filter {self.name} {took}, {MOST_LATE} commands in a row",
                cause="it computes for too long, or waits for something",
                next="make it quicker, or --set <section>.control_process=false",
            )
        if not self._warned:
            self._warned = True
            self._warn(f"action filter {self.name} {took} and was left out of a command")

    def _ask(self, work: Callable[[], Array | None], deadline: float) -> _Result | None:
        """Have the thread do ``work``; None if that is not done by ``deadline`` (monotonic)."""
        self._busy = True
        self._work.put(work)
        return self._take(deadline)

    def _take(self, deadline: float) -> _Result | None:
        """The result of what the thread was given; None if it is not there by ``deadline``."""
        try:
            with realtime.shared_gil():
                result = self._results.get(timeout=max(deadline - time.monotonic(), 0.0))
        except queue.Empty:
            return None
        self._busy = False
        return result

    def _compute(self) -> None:
        # As in the sending thread, where filters run otherwise: a busy machine makes none late.
        realtime.raise_priority()
        while True:
            work = self._work.get()
            try:
                result = _Result(work())
            except BaseException as error:  # noqa: BLE001 - raised in the thread that sends
                result = _Result(error=error)
            self._results.put(result)


def _is_quick(cls: type[ActionFilter]) -> bool:
    known = next((base for base in cls.__mro__ if base in _QUICK), None)
    if known is None:
        return False
    derived = cls.__mro__[: cls.__mro__.index(known)]
    added = {name for base in derived for name, value in vars(base).items() if _is_code(value)}
    return added <= {"__init__"}


def _is_code(value: object) -> bool:
    return inspect.isroutine(value) or isinstance(value, property)
