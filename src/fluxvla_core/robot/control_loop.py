"""An episode's control loop (``ControlLoop``), and its checks at each tick (``Supervisor``).

The loop queries the policy, joins its chunks and plays them, until the episode is over. Only the
thread that calls ``run`` sends commands, on the absolute deadlines of the control rate; the one
exception is the operator's own ``stop``, which has a thread and a time limit of its own.
On a robot the policy observes and thinks in a thread of its own, so that a slow, hung or raising
policy never keeps a command from being sent: without a chunk the arm brakes and holds, and after
``safety.starvation_s`` the motion is stopped. In a lockstep simulation, where time stands still
between commands, observing happens in the sending thread (renderers are bound to one), and answers
take as long as they are said to: none, or ``latency_s``.

A chunk is played whole before the next query (``Synchronous``), or the policy is queried again
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

from fluxvla_core.contracts.runner import Reporter
from fluxvla_core.control.chunks import Chunk, check_beginning
from fluxvla_core.control.interrupt import Interrupts
from fluxvla_core.control.joiners import ChunkJoiner
from fluxvla_core.control.policy_client import Answer, PolicyClient, PolicyEnded
from fluxvla_core.control.safety import BadChunk, SafetySettings, Starved
from fluxvla_core.control.sender import CommandSender, SentCommand
from fluxvla_core.control.tracking import TrackingWatch
from fluxvla_core.errors import FluxError
from fluxvla_core.robot.events import CommandSent, Event, Phase
from fluxvla_core.robot.robot import Robot

Array = npt.NDArray[np.float64]
# How often a wait that may be long checks for an interrupt.
_POLL_S = 0.02


class EpisodeOver(BaseException):
    """Raised to end an episode inside a tick; no ``Exception``, so that nobody handles it."""

    def __init__(self, outcome: str) -> None:
        self.outcome = outcome
        super().__init__(outcome)


@dataclass(frozen=True)
class PendingQuery:
    """A query that the policy has not answered yet.

    Args:
        future: the future of the answer.
        last: ``(D,)`` the last command at the time of the query.
        due: in lockstep, the time before which the answer does not count as there.
    """

    future: Future[Answer]
    last: Array
    due: float


@dataclass(frozen=True)
class ControlLoop:
    """Plays a policy's chunks on a robot, for one episode.

    Args:
        robot: the connected robot; its clock counts.
        client: observes the robot and queries the policy.
        joiner: joins the chunks to one motion.
        sender: sends every command; started at the arm's pose.
        supervisor: the episode's supervisor; is notified of every accepted chunk.
        safety: ``starvation_s``, ``first_chunk_s`` and the limits of a chunk's beginning.
        interrupts: signals; checked while waiting, and by the supervisor at every tick.
        action_rate_hz: actions a second in the policy's chunks.
        max_actions: how many of a chunk's actions are executed; None for all.
        latency_s: how long, in lockstep, an answer takes.
        holds: send the last command again at every tick while the first answer is awaited: the arm
            was commanded before, and some drivers stop an arm that they hear nothing for.
    """

    robot: Robot
    client: PolicyClient
    joiner: ChunkJoiner
    sender: CommandSender
    supervisor: Supervisor
    safety: SafetySettings
    interrupts: Interrupts
    action_rate_hz: float
    max_actions: int | None = None
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
            self.sender.send_targets(self._targets())
            query, since = self._ask(), self.robot.clock.now()
            while not self._arrived(query):
                self._check_starved(self.robot.clock.now() - since)
                self.sender.hold()
            # The arm may have been braking: the chunk starts where it is commanded to be now.
            self._receive(self._answer(query), self.sender.limiter.last)

    def _play_streamed(self) -> NoReturn:
        period = self.sender.rate.period
        query: PendingQuery | None = None
        starved_since: float | None = None
        ended: PolicyEnded | None = None
        while True:
            now = self.robot.clock.now()
            try:
                query = self._take(query)
                if query is None and ended is None and self.joiner.wants_chunk(now):
                    query = self._take(self._ask())
            except PolicyEnded as over:
                query, ended = None, over
            target = self.joiner.target(now + period)
            if target is not None:
                starved_since = None
                self.sender.send_targets(target[None])
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
                f"a chunk at {self.action_rate_hz:g} Hz holds no command at "
                f"{self.sender.rate.hz:g} Hz: it is too short"
            )
        return np.array(rows)

    def _ask(self) -> PendingQuery:
        last = self.sender.limiter.last
        due = self.robot.clock.now() + self.latency_s
        until = time.monotonic() + self.safety.first_chunk_s
        future = self.client.query(self.joiner.previous_chunk())
        if self.robot.lockstep and time.monotonic() > until:
            raise self._no_chunk(until)
        return PendingQuery(future, last, due)

    def _first(self) -> tuple[Answer, Array]:
        """The first answer: nothing moves, and the policy may have to warm up.

        On a robot it is queried again: by the time of a long answer, what it saw is old. If the
        second one takes long as well, a third shows whether it always does. The episode begins
        with the last.
        """
        until = time.monotonic() + self.safety.first_chunk_s
        query = self._ask()
        answer = self._wait_for(query, until)
        for _ in range(0 if self.robot.lockstep else 2):
            self.client.reset()
            began = time.monotonic()
            query = self._ask()
            answer = self._wait_for(query, until)
            if time.monotonic() - began <= self.safety.starvation_s:
                break
        return answer, query.last

    def _take(self, query: PendingQuery | None) -> PendingQuery | None:
        """Receive the answer if it is there, else return the query."""
        if query is None or not self._arrived(query):
            return query
        self._receive(self._answer(query), query.last)
        return None

    def _arrived(self, query: PendingQuery) -> bool:
        if self.robot.lockstep:
            # Half a microsecond: the clock sums its steps, and the sum is rounded.
            return self.robot.clock.now() >= query.due - 5e-7
        return query.future.done()

    def _answer(self, query: PendingQuery) -> Answer:
        # In lockstep time stands still until it is there.
        if not self.robot.lockstep:
            return query.future.result()
        return self._wait_for(query, time.monotonic() + self.safety.first_chunk_s)

    def _wait_for(self, query: PendingQuery, until: float) -> Answer:
        """The answer, waited for in real time; meanwhile the arm is held, if it was commanded."""
        while not query.future.done():
            if time.monotonic() > until:
                raise self._no_chunk(until)
            if self.holds:
                self.sender.hold()
            else:
                self.interrupts.check()
                wait((query.future,), timeout=_POLL_S)
        return query.future.result()

    def _receive(self, answer: Answer, anchor: Array) -> None:
        accepted = self._accepted(answer)
        chunk = Chunk(accepted, self.action_rate_hz, answer.observed, anchor)
        self.joiner.add(chunk, self.robot.clock.now())

    def _accepted(self, answer: Answer) -> Array:
        """The ``(T, D)`` actions of an answer that are played, as it arrives."""
        embodiment, last = self.robot.embodiment, self.sender.limiter.last
        try:
            actions = answer.checked()
            check_beginning(actions, embodiment, last, self.action_rate_hz, self.safety)
        except BadChunk:
            self.client.refused(answer)
            raise
        self.supervisor.chunk_accepted()
        self.client.accepted(answer)
        return actions[: self.max_actions]

    def _no_chunk(self, until: float) -> Starved:
        most = self.safety.first_chunk_s
        late, seconds = self.client.slowest_since(until - most)
        return Starved(
            f"there was no chunk within {most:g} s: {late.name} took {seconds:.2f} s of that",
            cause=late.cause,
            next="safety.first_chunk_s sets how long the first one may take",
        )

    def _check_starved(self, seconds: float) -> None:
        if seconds > self.safety.starvation_s:
            late, share = self.client.slowest_since(time.monotonic() - seconds)
            raise Starved(
                f"the robot waits for a chunk for {seconds:.2f} s, "
                f"safety.starvation_s is {self.safety.starvation_s:g}: "
                f"{late.name} took {share:.2f} s of that",
                cause=late.cause,
                next=late.next,
            )


class Supervisor:
    """Watches the robot at every tick: its state, its tracking error, signals, the episode's end.

    Args:
        robot: the connected robot.
        tracking: compares its state with its commands.
        interrupts: signals that ask the run to end.
        max_steps: commands of the phase ``run`` after which the episode is over.
        reporter: shows how many commands were sent.
        emit: takes the event ``CommandSent``.

    ``phase`` is the current phase of the episode.
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
        """The policy's motion begins, or continues."""
        self.phase = Phase.RUN

    def check(self, sent: SentCommand | None, sent_at: float, late_s: float) -> None:
        """The tick after each command: reported always, supervised while it may still stop.

        Args:
            sent: the command; None at a tick without one.
            sent_at: time at which it was sent.
            late_s: seconds after its deadline.

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
        if not (phase.stoppable or phase is Phase.OVER):
            return
        if problem is not None:
            raise problem
        self._interrupts.check()
        if sent is not None:
            self._tracking.sent(sent.command, sent_at)
        if measured is not None and robot.follows_commands:
            self._tracking.check(measured.state, measured.at)
        if phase is not Phase.RUN or sent is None:
            return
        self._steps += 1
        self._reporter.progress("commands", self._steps, self._max_steps)
        if robot.done():
            raise EpisodeOver("done")
        if self._steps >= self._max_steps:
            raise EpisodeOver("max_steps")
