"""An episode on a robot: to the start pose, the control loop, to rest.

Whatever happens in it, it ends in a safe stop: the arm brakes within its limits where it still
obeys, and the operator's own ``stop`` is called where something went wrong.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.robot import ActionFilter
from fluxvla_core.contracts.runner import Reporter
from fluxvla_core.control.clock import Rate
from fluxvla_core.control.delays import MACHINE
from fluxvla_core.control.interrupt import Interrupted, Interrupts
from fluxvla_core.control.joiners import ChunkJoiner
from fluxvla_core.control.limits import CommandLimiter
from fluxvla_core.control.policy_client import PolicyClient
from fluxvla_core.control.safety import Latch, Rule, SafetySettings, rule_of
from fluxvla_core.control.sender import (
    CommandSender,
    ExecuteActions,
    SentCommand,
    come_to_rest,
    ramp,
)
from fluxvla_core.control.tracking import TrackingWatch
from fluxvla_core.errors import FluxError, RunFailed
from fluxvla_core.robot.control_loop import ControlLoop, Supervisor
from fluxvla_core.robot.events import (
    EpisodeEnded,
    EpisodeObserver,
    EpisodePrepared,
    EpisodeStarted,
    Event,
    Phase,
    Stopped,
    StoppedWhileHeld,
)
from fluxvla_core.robot.robot import Robot
from fluxvla_core.robot.tasks import Task

Array = npt.NDArray[np.float64]
# How long before its deadline a command is made ready, in seconds and as a share of the period.
_LEAD_S, _LEAD_SHARE = 0.004, 0.2
# A pause this many times ``max_age_s`` ago, or later, may have made a stream old.
_RECENT = 2.0
# After these nobody knows whether commands still arrive: the robot stops by its own means.
_NOT_BRAKED = (Rule.OPERATOR, Rule.EXECUTE)


PolicyClientFactory = Callable[[Task, int, TrackingWatch, Callable[[Event], None]], PolicyClient]
"""Makes the policy client of an episode's chunks.

Arguments: the task, the seed of the policy, the episode's watch, and what takes its events.
"""


@dataclass(frozen=True)
class EpisodeSettings:
    """Settings of an episode.

    Args:
        rate_hz: commands a second.
        safety: thresholds of the safety rules.
        start_pose: ``(D,)``, where the arm goes first; None stays.
        max_actions: how many of a chunk's actions are executed; None for all.
        latency_s: how long, in a simulation whose time stands still, an answer takes.
        max_steps: commands after which the episode ends.
        action_rate_hz: actions a second in the policy's chunks.
    """

    rate_hz: float
    safety: SafetySettings
    start_pose: Sequence[float] | None
    max_actions: int | None
    latency_s: float
    max_steps: int
    action_rate_hz: float


@dataclass(frozen=True)
class EpisodeParts:
    """The objects that all episodes of a run share.

    Args:
        robot: connected.
        make_client: makes the policy client of an episode's chunks.
        filters: the config's ``action_filters``.
        joiner: joins the chunks to one motion.
        execute_actions: sends commands.
        latch: an episode does not begin while it is tripped.
        interrupts: signals that ask the run to end.
        reporter: shows progress and warnings.
        one_by_one: as ``CommandSender`` has it.
    """

    robot: Robot
    make_client: PolicyClientFactory
    filters: Sequence[ActionFilter]
    joiner: ChunkJoiner
    execute_actions: ExecuteActions
    latch: Latch
    interrupts: Interrupts
    reporter: Reporter
    one_by_one: bool = False


class Episode:
    """Runs once; its observers see what happens.

    Args:
        parts: the robot and what else the run's episodes share.
        settings: how the episode is driven.
        observers: receive every event.
        task: the task to do.
        number: how many episodes the run had before.
        seed: the seed of the policy.
        before: ``(D,)`` the last command of the run, None before any.
        held: the episode that has held the arm by it since, without a stop; None after a stop.

    Raises:
        RunFailed: an observer cannot take anything, for example write to its folder.
        BadFrame: the state does not say where a commanded joint is.
    """

    def __init__(
        self,
        parts: EpisodeParts,
        settings: EpisodeSettings,
        observers: Sequence[EpisodeObserver],
        task: Task,
        number: int,
        seed: int,
        before: Array | None = None,
        held: Episode | None = None,
    ) -> None:
        robot, safety = parts.robot, settings.safety
        self._parts, self._settings, self._observers = parts, settings, observers
        self._robot, self._latch, self._interrupts = robot, parts.latch, parts.interrupts
        self._task, self._number = task, number
        self._before, self._held = before, held
        lead_s = min(_LEAD_S, _LEAD_SHARE / settings.rate_hz)
        self._limiter = CommandLimiter(
            robot.embodiment,
            1.0 / settings.rate_hz,
            safety.velocity_scale,
            safety.acceleration_scale,
        )
        self._tracking = TrackingWatch(robot.embodiment, safety)
        self._supervisor = Supervisor(
            robot, self._tracking, parts.interrupts, settings.max_steps, parts.reporter,
            self._emit,
        )  # fmt: skip
        self._sender = CommandSender(
            self._execute_actions, settings.rate_hz, robot.clock, self._limiter, parts.latch,
            parts.filters, self._on_sent, robot.speed, parts.one_by_one, lead_s,
        )  # fmt: skip
        self._rate = self._sender.rate
        self._client = parts.make_client(task, seed, self._tracking, self._emit)
        self._grippers = np.array([joint.kind == "gripper" for joint in robot.embodiment.joints])
        self._trips = len(parts.latch.trips)
        self._executing = False
        self.stop_failure: str | None = None
        self._emit(EpisodePrepared(robot.clock.now(), task, seed, settings.rate_hz))

    def run(self) -> None:
        """The whole episode.

        Raises:
            Exception: what ended it before its time; the robot is stopped by then.
            Interrupted: a signal ended it, and the robot is stopped by then; or one came while
                its record was finished.
        """
        interrupts = self._interrupts
        outcome, problem = "failed", None
        interrupts.deferred = True
        try:
            self._latch.check()
            self._emit(EpisodeStarted(self._robot.clock.now(), self._task))
            self._begin()
            outcome = self._control_loop().run()
            self._supervisor.phase = Phase.HOLD
            self._sender.brake()
            # Signals that come now wait until the record is complete, however many.
            interrupts.stopping = True
        except Interrupted as error:
            outcome, problem = "interrupted", f"stopped by {error.name}"
            self._stop(Rule.INTERRUPT, problem)
            raise
        except BaseException as error:
            self._note_stall(error)
            outcome, problem = "failed", _what(error)
            self._stop(self._rule(error), problem)
            if isinstance(error, SystemExit):
                # A hook, a filter or the runner itself: the command would end without a word.
                raise RunFailed(
                    f"something in the episode ended the program ({problem}); the robot was stopped"
                ) from error
            raise
        finally:
            self._end(outcome, problem)
            self._supervisor.phase = Phase.OVER
            # Or every episode would keep all before it.
            self._held = self._client.meanwhile = None
            interrupts.deferred = False
        interrupts.resume()

    def hold(self) -> None:
        """Send the last command once more, at the next tick: after an episode that ended well.

        What goes wrong meanwhile trips the latch, and the robot is stopped; it is noted beside the
        record, which is complete.

        Raises:
            SafetyStop: the latch was tripped, or the arm does not stay.
            OperatorError: the robot does not take it, or a stream fell silent.
        """
        try:
            self.resend()
        except FluxError as error:
            self._note_stall(error)
            self.stop_held(error)
            raise

    def stop_held(self, error: FluxError) -> None:
        """Trip the latch because of ``error``, and stop the arm that is held."""
        latch = self._latch
        if latch.tripped is None:
            latch.trip(self._rule(error), error)
        failure = self._stop_robot()
        self._emit(StoppedWhileHeld(self._robot.clock.now(), latch.trips[-1], failure))

    def resend(self) -> None:
        """As ``hold``, but on an error the caller has to stop the robot."""
        ticks = self._rate.ticks
        self._sender.hold()
        if self._rate.ticks == ticks:
            # A runner's own sending that has no tick of the rate's.
            time.sleep(self._rate.period)

    @property
    def commanded(self) -> Array | None:
        """``(D,)`` the last command of the run, None before any."""
        return self._limiter.last if self._limiter.started else self._before

    def _begin(self) -> None:
        """Read where the arm is, and bring it to the start pose."""
        settings = self._settings
        self._robot.begin(self._task.instruction, self._number)
        self._client.meanwhile = None if self._held is None else self._held.resend
        self._limiter.start(self._where(self._client.first_state()))
        self._client.reset()
        if settings.start_pose is not None:
            self._supervisor.phase = Phase.RAMP
            most = settings.safety.ramp_scale
            way = ramp(self._limiter, settings.start_pose, most)
            seconds = len(way) / settings.rate_hz
            self._parts.reporter.info(f"moving to the start pose, {seconds:.1f} s")
            self._sender.move_along(way, most)
        for each in self._parts.filters:
            each.reset(self._limiter.last)
        self._rate.reset()
        self._tracking.reset()
        self._supervisor.phase = Phase.READY

    def _control_loop(self) -> ControlLoop:
        parts, settings = self._parts, self._settings
        commanded = settings.start_pose is not None or self._held is not None
        holds = commanded and not self._robot.lockstep
        self._client.meanwhile = self.resend if holds else None
        return ControlLoop(
            robot=self._robot,
            client=self._client,
            joiner=parts.joiner,
            sender=self._sender,
            supervisor=self._supervisor,
            safety=settings.safety,
            interrupts=self._interrupts,
            action_rate_hz=settings.action_rate_hz,
            max_actions=settings.max_actions,
            latency_s=settings.latency_s,
            holds=holds,
        )

    def _where(self, state: Array) -> Array:
        """``(D,)`` the command to continue from: the one that holds the arm, else where it is.

        An arm droops; to begin where it droops to would be a jump of its command. A joint that is
        far from its command was moved, or nobody knows what its stop commanded: that one begins
        where it is. A gripper is always far, because of what it holds.
        """
        measured = self._robot.state()
        if measured is not None:
            state = measured.state
        commanded = self._robot.commanded(self._before)
        if commanded is None:
            return self._tracking.positions(state)
        kept = self._grippers
        if self._held is not None:
            kept = kept | self._tracking.follows(commanded, state)
        elif self._robot.reports_last_action:
            kept = kept | self._tracking.settled(commanded, state)
        return np.where(kept, commanded, self._tracking.positions(state))

    def _execute_actions(self, actions: Array, rate: Rate) -> None:
        self._executing = True
        self._parts.execute_actions(actions, rate)
        self._executing = False

    def _on_sent(self, sent: SentCommand | None, sent_at: float, late_s: float) -> None:
        self._supervisor.check(sent, sent_at, late_s)
        if self._supervisor.phase is Phase.RUN:
            self._client.ticked()

    def _emit(self, event: Event) -> None:
        for observer in self._observers:
            observer.on_event(event)

    def _note_stall(self, error: BaseException) -> None:
        """If this process was paused, name the pause as the cause of stale streams."""
        if not isinstance(error, FluxError) or self._rule(error) != Rule.FRESHNESS:
            return
        recent = time.monotonic() - _RECENT * self._settings.safety.max_age_s
        seconds = self._robot.delays.stood_still(recent)
        if seconds > 0.0:
            error.what += f"; {MACHINE.name} did not run this process for {seconds:.2f} s"
            error.cause, error.next = MACHINE.cause, MACHINE.next

    def _rule(self, error: BaseException) -> str:
        return rule_of(error, Rule.EXECUTE if self._executing else Rule.RUN)

    def _stop(self, rule: str, problem: str) -> None:
        """The safe stop: brake where the arm still obeys, then the operator's own stop."""
        robot = self._robot
        self._interrupts.stopping = True
        began = robot.clock.now()
        self._supervisor.phase = Phase.STOP
        if rule != Rule.INTERRUPT:
            self._latch.trip(rule, problem)
        if self._limiter.started and (rule not in _NOT_BRAKED or not robot.can_stop):
            try:
                come_to_rest(
                    self._sender,
                    self._tracking,
                    self._state,
                    blocked=rule == Rule.TRACKING,
                    patience_s=self._settings.safety.tracking_time_s,
                )
            except (Exception, SystemExit) as error:  # noqa: BLE001 - the robot's own stop is next
                self._parts.reporter.warn(f"braking failed: {_what(error)}")
        failure = self._stop_robot()
        now = robot.clock.now()
        self._emit(Stopped(now, rule, problem, now - began, failure))

    def _state(self) -> Array | None:
        """The robot's current state; None if it cannot be read, or only plays a recording."""
        try:
            measured = self._robot.state() if self._robot.follows_commands else None
        except FluxError:
            # A stream that fell silent, or says nonsense, keeps no arm from coming to rest.
            return None
        return None if measured is None else measured.state

    def _stop_robot(self) -> str | None:
        """The operator's own stop; what went wrong with it."""
        self.stop_failure = failure = self._robot.stop()
        if failure:
            self._parts.reporter.warn(failure)
        return failure

    def _end(self, outcome: str, problem: str | None) -> None:
        success: bool | None
        try:
            success = self._robot.success()
        except (Exception, SystemExit) as error:  # noqa: BLE001 - why it ended matters more
            self._parts.reporter.warn(f"task_success failed: {_what(error)}")
            success = None
        trips = tuple(self._latch.trips[self._trips :])
        now, skipped = self._robot.clock.now(), self._rate.skipped
        self._emit(EpisodeEnded(now, outcome, success, problem, skipped, trips))


def _what(error: BaseException) -> str:
    return error.what if isinstance(error, FluxError) else f"{type(error).__name__}: {error}"
