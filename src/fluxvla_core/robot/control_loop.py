"""The control loop of an episode: ask the policy, join its chunks, play them, until it is over.

The thread that calls ``run`` alone sends commands, on the absolute deadlines of the control rate.
On a robot the policy observes and thinks in a thread of its own, so that a slow, hung or raising
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
from typing import NoReturn

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.reporter import Reporter
from fluxvla_core.errors import FluxError
from fluxvla_core.robot.control.chunks import Chunk, check_beginning
from fluxvla_core.robot.control.commands import CommandSender, Sent
from fluxvla_core.robot.control.interrupt import Interrupts
from fluxvla_core.robot.control.joiners import ChunkJoiner
from fluxvla_core.robot.control.safety import BadChunk, SafetySettings, Starved
from fluxvla_core.robot.control.tracking import TrackingWatch
from fluxvla_core.robot.events import ChunkAccepted, CommandSent, Event, Phase, Reading, Refused
from fluxvla_core.robot.observation import ObservationReader
from fluxvla_core.robot.policy_calls import Answer, PolicyCaller, PolicyEnded, PolicyThread
from fluxvla_core.robot.robot import Robot

Array = npt.NDArray[np.float64]
# How often a wait that may be long looks whether somebody wants it to end.
_LOOK_S = 0.02


@dataclass(frozen=True)
class Asked:
    """A question under way: the ``(D,)`` command that the arm had then, and, in lockstep, the time
    before which the answer does not count as there."""

    future: Future[Answer]
    last: Array
    due: float


@dataclass(frozen=True)
class ControlLoop:
    """Plays a policy's chunks on a robot, for one episode.

    Args:
        robot: whose clock counts.
        reader: makes observations.
        policy: is asked for chunks.
        joiner: makes one motion of them.
        sender: started at the arm's pose; sends every command.
        supervisor: of the episode; learns when a chunk is there.
        safety: ``starvation_s``, ``first_chunk_s`` and what a chunk's beginning is held against.
        thread: where the policy thinks.
        interrupts: looked at while waiting; the supervisor looks at them at every tick.
        emit: takes the events ``ChunkAccepted`` and ``Refused``.
        keyframe_hz, horizon: keyframes a second, and in each answer of the policy.
        keyframes: how many of a chunk's keyframes are played; None plays all.
        latency_s: how long, in lockstep, an answer takes.
        holds: send the last command again at every tick while the first answer is awaited: the arm
            was commanded before, and some drivers stop an arm that they hear nothing for.
    """

    robot: Robot
    reader: ObservationReader
    policy: PolicyCaller
    joiner: ChunkJoiner
    sender: CommandSender
    supervisor: Supervisor
    safety: SafetySettings
    thread: PolicyThread
    interrupts: Interrupts
    emit: Callable[[Event], None]
    keyframe_hz: float
    horizon: int
    keyframes: int | None = None
    latency_s: float = 0.0
    holds: bool = False

    def run(self) -> str:
        """Run until the supervisor says that it is over, or the policy has no more chunks.

        Returns:
            How it ended.

        Raises:
            SafetyStop: no chunk came in time, or one was refused.
            Exception: what observing, the policy or the robot raised.
        """
        self.joiner.reset()
        try:
            self._receive(*self._first())
            self.sender.rate.reset()
            if self.joiner.streamed:
                self._play_streamed()
            else:
                self._play_whole()
        except (EpisodeOver, PolicyEnded) as over:
            return over.outcome

    def _play_whole(self) -> NoReturn:
        while True:
            self.sender.play(self._targets())
            asked, since = self._ask(), self.robot.clock.now()
            while not self._arrived(asked):
                self._check_starved(self.robot.clock.now() - since)
                self.sender.hold()
            # The arm may have been braking: the chunk starts where it is commanded to be now.
            self._receive(self._answer(asked), self.sender.limiter.last)

    def _play_streamed(self) -> NoReturn:
        period = self.sender.rate.period
        asked: Asked | None = None
        starved_since: float | None = None
        ended: PolicyEnded | None = None
        while True:
            now = self.robot.clock.now()
            try:
                asked = self._take(asked)
                if asked is None and ended is None and self.joiner.wants_chunk(now):
                    asked = self._take(self._ask())
            except PolicyEnded as over:
                asked, ended = None, over
            target = self.joiner.target(now + period)
            if target is not None:
                starved_since = None
                self.sender.play(target[None])
                continue
            if ended is not None:
                raise ended
            starved_since = now if starved_since is None else starved_since
            self._check_starved(now - starved_since)
            self.sender.hold()

    def _targets(self) -> Array:
        """The joined chunk at every tick, as far as it reaches: ``(N, D)``."""
        now, period = self.robot.clock.now(), self.sender.rate.period
        rows: list[Array] = []
        while (row := self.joiner.target(now + (len(rows) + 1) * period)) is not None:
            rows.append(row)
        if not rows:
            raise BadChunk(
                f"a chunk at {self.keyframe_hz:g} Hz holds no command at "
                f"{self.sender.rate.hz:g} Hz: it is too short"
            )
        return np.array(rows)

    def _ask(self) -> Asked:
        last, ahead = self.sender.limiter.last, self.joiner.ahead()

        def think(reading: Reading) -> Answer:
            rest = None if ahead is None else ahead.seen_at(reading.at, self.horizon)
            return self.policy.ask(reading, rest)

        due = self.robot.clock.now() + self.latency_s
        if self.robot.lockstep:
            until = time.monotonic() + self.safety.first_chunk_s
            reading = self.reader.read()
            if time.monotonic() > until:
                raise self._no_chunk(until)
            return Asked(self.thread.submit(lambda: think(reading)), last, due)
        return Asked(self.thread.submit(lambda: think(self.reader.read())), last, due)

    def _first(self) -> tuple[Answer, Array]:
        """The first answer: nothing moves, and the policy may have to warm up.

        On a robot it is asked again: by the time of a long answer, what it saw is old. If the
        second one takes long as well, a third shows whether it always does. The episode begins
        with the last.
        """
        until = time.monotonic() + self.safety.first_chunk_s
        asked = self._ask()
        answer = self._idle(asked, until)
        for _ in range(0 if self.robot.lockstep else 2):
            self.policy.reset()
            began = time.monotonic()
            asked = self._ask()
            answer = self._idle(asked, until)
            if time.monotonic() - began <= self.safety.starvation_s:
                break
        return answer, asked.last

    def _take(self, asked: Asked | None) -> Asked | None:
        """Receive the answer if it is there; else the question is still under way."""
        if asked is None or not self._arrived(asked):
            return asked
        self._receive(self._answer(asked), asked.last)
        return None

    def _arrived(self, asked: Asked) -> bool:
        if self.robot.lockstep:
            # Half a microsecond: the clock sums its steps, and the sum is rounded.
            return self.robot.clock.now() >= asked.due - 5e-7
        return asked.future.done()

    def _answer(self, asked: Asked) -> Answer:
        # In lockstep time stands still until it is there.
        if not self.robot.lockstep:
            return asked.future.result()
        return self._idle(asked, time.monotonic() + self.safety.first_chunk_s)

    def _idle(self, asked: Asked, until: float) -> Answer:
        """The answer, waited for in real time; meanwhile the arm is held, if it was commanded."""
        while not asked.future.done():
            if time.monotonic() > until:
                raise self._no_chunk(until)
            if self.holds:
                self.sender.hold()
            else:
                self.interrupts.check()
                wait((asked.future,), timeout=_LOOK_S)
        return asked.future.result()

    def _receive(self, answer: Answer, anchor: Array) -> None:
        accepted = self._accepted(answer)
        chunk = Chunk(accepted, self.keyframe_hz, answer.reading.at, anchor)
        self.joiner.add(chunk, self.robot.clock.now())

    def _accepted(self, answer: Answer) -> Array:
        """The ``(T, D)`` keyframes of an answer that are played, as it arrives."""
        robot, keyframes = self.robot, answer.keyframes
        try:
            if isinstance(keyframes, BadChunk):
                raise keyframes
            last = self.sender.limiter.last
            check_beginning(keyframes, robot.embodiment, last, self.keyframe_hz, self.safety)
        except BadChunk:
            self.emit(Refused(robot.clock.now(), "chunk", {"answer": answer.chunk}))
            raise
        self.supervisor.chunk_accepted()
        self.emit(ChunkAccepted(robot.clock.now(), answer.reading, keyframes, answer.stages))
        return keyframes[: self.keyframes]

    def _no_chunk(self, until: float) -> Starved:
        most = self.safety.first_chunk_s
        late, seconds = self.robot.delays.longest(until - most)
        return Starved(
            f"there was no chunk within {most:g} s: {late.name} took {seconds:.2f} s of that",
            cause=late.cause,
            next="safety.first_chunk_s sets how long the first one may take",
        )

    def _check_starved(self, seconds: float) -> None:
        if seconds > self.safety.starvation_s:
            late, share = self.robot.delays.longest(time.monotonic() - seconds)
            raise Starved(
                f"the robot waits for a chunk for {seconds:.2f} s, "
                f"safety.starvation_s is {self.safety.starvation_s:g}: "
                f"{late.name} took {share:.2f} s of that",
                cause=late.cause,
                next=late.next,
            )


class EpisodeOver(BaseException):
    """Ends an episode from inside a tick. Not an error, and nobody's ``except Exception``."""

    def __init__(self, outcome: str) -> None:
        self.outcome = outcome
        super().__init__(outcome)


class Supervisor:
    """Watches the robot at every tick: its state, its tracking error, signals, the episode's end.

    Args:
        robot: connected.
        tracking: holds its state against its commands.
        interrupts: of the run.
        max_steps: commands of the phase ``run`` after which the episode is over.
        reporter: of the run.
        emit: takes the event ``CommandSent``.

    ``phase`` is where the episode is.
    """

    def __init__(
        self,
        robot: Robot,
        tracking: TrackingWatch,
        interrupts: Interrupts,
        max_steps: int,
        reporter: Reporter,
        emit: Callable[[Event], None],
    ) -> None:
        self.phase = Phase.START
        self._robot = robot
        self._tracking = tracking
        self._interrupts = interrupts
        self._max_steps = max_steps
        self._steps = 0
        self._reporter = reporter
        self._emit = emit

    def chunk_accepted(self) -> None:
        """The policy's motion begins, or goes on."""
        self.phase = Phase.RUN

    def after_tick(self, sent: Sent | None, sent_at: float, late_s: float) -> None:
        """The tick after each command: reported always, supervised while it may still stop.

        Args:
            sent: the command; None at a tick without one.
            sent_at: when it was sent.
            late_s: how late that was.

        Raises:
            EpisodeOver: the task is done, or there were enough commands.
            NotFollowing: the arm is not where it is commanded to be.
            Interrupted: a signal came.
            FluxError: the state could not be read.
        """
        robot, phase = self._robot, self.phase
        try:
            measured, problem = robot.state(), None
        except FluxError as error:
            # What was sent is recorded all the same; and a stream that fell silent stops an arm,
            # it does not keep it from braking.
            measured, problem = None, error
        if sent is not None and phase is not Phase.OVER:
            state = None if measured is None else measured.state
            self._emit(CommandSent(robot.clock.now(), sent, phase, state, robot.sent_s, late_s))
        # Between two episodes, too: an arm that is held may be switched off, or moved.
        if phase not in (Phase.RAMP, Phase.READY, Phase.RUN, Phase.OVER):
            return
        if problem is not None:
            raise problem
        self._interrupts.check()
        if sent is not None:
            self._tracking.sent(sent.command, sent_at)
        if measured is not None and robot.follows:
            self._tracking.check(measured.state, measured.at)
        if phase is not Phase.RUN or sent is None:
            return
        self._steps += 1
        self._reporter.progress("commands", self._steps, self._max_steps)
        if robot.done():
            raise EpisodeOver("done")
        if self._steps >= self._max_steps:
            raise EpisodeOver("max_steps")
