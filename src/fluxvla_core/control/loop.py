"""One episode: observe, predict, join, send, until it is over; then hold.

The thread that calls ``run`` alone sends commands, on the absolute deadlines of the path's rate. On
a robot the policy observes and thinks in a thread of its own, so that a slow, hung or raising
policy never keeps a command from being sent: without a chunk the arm brakes and holds, and after
``safety.starvation_s`` the motion is stopped. In a lockstep simulation, where time stands still
between commands, observing happens in the sending thread (renderers are bound to one), and answers
take as long as they are said to: none, or ``latency_s``.

A chunk is played whole before the next is asked for (``Synchronous``), or the policy is asked again
while its last answer is being played (the joiners that are ``streamed``).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Future, wait
from dataclasses import dataclass
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.continuation import Continuation
from fluxvla_core.contracts.protocols import Clock
from fluxvla_core.control.interrupt import Interrupts
from fluxvla_core.control.joining import Chunk, Joiner
from fluxvla_core.control.path import CommandPath
from fluxvla_core.control.worker import Worker
from fluxvla_core.safety.settings import SafetySettings
from fluxvla_core.safety.stops import BadChunk, Starved

Array = npt.NDArray[np.float64]
# How often a wait that may be long looks whether somebody wants it to end.
_LOOK_S = 0.02


class EpisodeOver(BaseException):
    """Ends an episode from inside the beat. Not an error, and nobody's ``except Exception``."""

    def __init__(self, outcome: str) -> None:
        self.outcome = outcome
        super().__init__(outcome)


@dataclass(frozen=True)
class Seen:
    """An observation for the policy, and the time that it is of, on the loop's clock."""

    observation: Any
    at: float


@dataclass(frozen=True)
class Asked:
    """A question under way: the ``(D,)`` command that the arm had then, and, in lockstep, the time
    before which the answer does not count as there."""

    future: Future[tuple[Seen, Any]]
    last: Array
    due: float


@dataclass(frozen=True)
class Loop:
    """What one episode is run with.

    Args:
        path: started at the arm's pose; sends every command.
        joiner: makes one motion of the chunks.
        observe: makes an observation.
        think: asks the policy, which may have to go on from the motion under way, and checks what
            it says; what takes long belongs here, not in the thread that sends.
        admit: the ``(T, D)`` keyframes of an answer that are played, as it arrives; refuses it, or
            takes note of it.
        keyframe_hz, horizon: keyframes a second, and in each answer of the policy.
        clock: the operator's.
        lockstep: whether time stands still between commands.
        settings: ``starvation_s`` and ``first_chunk_s``.
        worker: where the policy thinks.
        interrupts: looked at while waiting; the beat looks at them too.
        latency_s: how long, in lockstep, an answer takes.
        begin_anew: makes the policy forget the answer that warmed it up.
        holds: send the last command again at every beat while the first answer is awaited: the arm
            was commanded before, and some drivers stop an arm that they hear nothing for.
    """

    path: CommandPath
    joiner: Joiner
    observe: Callable[[], Seen]
    think: Callable[[Seen, Continuation | None], Any]
    admit: Callable[[Seen, Any], Array]
    keyframe_hz: float
    horizon: int
    clock: Clock
    lockstep: bool
    settings: SafetySettings
    worker: Worker
    interrupts: Interrupts
    latency_s: float = 0.0
    begin_anew: Callable[[], None] = lambda: None
    holds: bool = False

    def run(self) -> str:
        """Run until the beat says that the episode is over.

        Returns:
            How it ended: the ``EpisodeOver``'s outcome.

        Raises:
            SafetyStop: no chunk came in time, or one was refused.
            Exception: what observing, the policy or the robot raised.
        """
        self.joiner.reset()
        try:
            self._receive(*self._first())
            self.path.rate.reset()
            if self.joiner.streamed:
                self._play_streamed()
            else:
                self._play_whole()
        except EpisodeOver as over:
            return over.outcome

    def _play_whole(self) -> NoReturn:
        while True:
            self.path.play(self._targets())
            asked, since = self._ask(), self.clock.now()
            while not self._arrived(asked):
                self._check_starved(self.clock.now() - since)
                self.path.hold()
            # The arm may have been braking: the chunk starts where it is commanded to be now.
            self._receive(self._answer(asked), self.path.limiter.last)

    def _play_streamed(self) -> NoReturn:
        period = self.path.rate.period
        asked: Asked | None = None
        starved_since: float | None = None
        while True:
            now = self.clock.now()
            asked = self._take(asked)
            if asked is None and self.joiner.wants_chunk(now):
                asked = self._take(self._ask())
            target = self.joiner.target(now + period)
            if target is not None:
                starved_since = None
                self.path.play(target[None])
                continue
            starved_since = now if starved_since is None else starved_since
            self._check_starved(now - starved_since)
            self.path.hold()

    def _targets(self) -> Array:
        """The joined chunk at every beat, as far as it reaches: ``(N, D)``."""
        now, period = self.clock.now(), self.path.rate.period
        rows: list[Array] = []
        while (row := self.joiner.target(now + (len(rows) + 1) * period)) is not None:
            rows.append(row)
        if not rows:
            raise BadChunk(
                f"a chunk at {self.keyframe_hz:g} Hz holds no command at "
                f"{self.path.rate.hz:g} Hz: it is too short"
            )
        return np.array(rows)

    def _ask(self) -> Asked:
        last, ahead = self.path.limiter.last, self.joiner.ahead()

        def think(seen: Seen) -> tuple[Seen, Any]:
            rest = None if ahead is None else ahead.seen_at(seen.at, self.horizon)
            return seen, self.think(seen, rest)

        due = self.clock.now() + self.latency_s
        if self.lockstep:
            seen = self.observe()
            return Asked(self.worker.submit(lambda: think(seen)), last, due)
        return Asked(self.worker.submit(lambda: think(self.observe())), last, due)

    def _first(self) -> tuple[tuple[Seen, Any], Array]:
        """The first answer: nothing moves, and the policy may have to warm up.

        On a robot it is asked again: by the time of a long answer, what it saw is old. If the
        second one takes long as well, a third tells whether that is its way. The episode begins
        with the last.
        """
        until = time.monotonic() + self.settings.first_chunk_s
        asked = self._ask()
        answer = self._idle(asked, until)
        for _ in range(0 if self.lockstep else 2):
            self.begin_anew()
            began = time.monotonic()
            asked = self._ask()
            answer = self._idle(asked, until)
            if time.monotonic() - began <= self.settings.starvation_s:
                break
        return answer, asked.last

    def _take(self, asked: Asked | None) -> Asked | None:
        """Receive the answer if it is there; else the question is still under way."""
        if asked is None or not self._arrived(asked):
            return asked
        self._receive(self._answer(asked), asked.last)
        return None

    def _arrived(self, asked: Asked) -> bool:
        if self.lockstep:
            # Half a microsecond: the clock sums its steps, and the sum is rounded.
            return self.clock.now() >= asked.due - 5e-7
        return asked.future.done()

    def _answer(self, asked: Asked) -> tuple[Seen, Any]:
        # In lockstep time stands still until it is there.
        if not self.lockstep:
            return asked.future.result()
        return self._idle(asked, time.monotonic() + self.settings.first_chunk_s)

    def _idle(self, asked: Asked, until: float) -> tuple[Seen, Any]:
        """The answer, waited for in real time; meanwhile the arm is held, if it was commanded."""
        while not asked.future.done():
            if time.monotonic() > until:
                raise Starved(
                    f"the policy gave no chunk within {self.settings.first_chunk_s:g} s",
                    cause="it hangs, or it is far slower than this robot needs",
                    next="safety.first_chunk_s sets how long it may take to warm up",
                )
            if self.holds:
                self.path.hold()
            else:
                self.interrupts.check()
                wait((asked.future,), timeout=_LOOK_S)
        return asked.future.result()

    def _receive(self, answer: tuple[Seen, Any], anchor: Array) -> None:
        seen, keyframes = answer
        admitted = self.admit(seen, keyframes)
        self.joiner.add(Chunk(admitted, self.keyframe_hz, seen.at, anchor), self.clock.now())

    def _check_starved(self, seconds: float) -> None:
        if seconds > self.settings.starvation_s:
            raise Starved(
                f"the robot waits for a chunk for {seconds:.2f} s, "
                f"safety.starvation_s is {self.settings.starvation_s:g}",
                cause="the policy hangs, or is slower than its chunks are long",
                next="play longer chunks (execute_horizon), or use a faster policy",
            )
