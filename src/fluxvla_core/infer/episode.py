"""One episode on a robot, from the first reading to the record that it leaves behind.

Whatever happens in it, it ends in a safe stop: the arm brakes within its limits where it still
obeys, and the operator's own ``stop`` is called where something went wrong.
"""

from __future__ import annotations

import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.continuation import Continuation
from fluxvla_core.control.interrupt import Interrupted
from fluxvla_core.control.loop import EpisodeOver, Loop, Seen
from fluxvla_core.control.path import CommandPath, Sent
from fluxvla_core.control.rate import Rate
from fluxvla_core.errors import FluxError, OperatorError, RunFailed
from fluxvla_core.infer.episode_record import EpisodeRecord
from fluxvla_core.infer.plan import Answer, Plan, PolicyFailed
from fluxvla_core.infer.reading import Reader, Reading
from fluxvla_core.infer.tasks import Task
from fluxvla_core.record.held import note_trip
from fluxvla_core.record.replay_policy import ENDED, RecordingEnded
from fluxvla_core.safety.limits import Limiter
from fluxvla_core.safety.ramp import ramp
from fluxvla_core.safety.stops import BadChunk
from fluxvla_core.safety.trips import TrackingWatch, action_columns, check_beginning, check_chunk

Array = npt.NDArray[np.float64]
# How long before its deadline a command is made ready, in seconds and as a share of the period.
_LEAD_S, _LEAD_SHARE = 0.004, 0.2
_THERE = 1e-9  # from the start pose, in the joints' units
# After these the arm no longer obeys, or nobody knows whether it does: it is not commanded on.
_NOT_BRAKED = ("operator", "tracking", "execute")


class Episode:
    """Runs once. ``run`` returns the summary that ``episode.json`` holds.

    Args:
        plan: what to run with.
        task: what to do.
        number: how many episodes the run had before.
        folder: where the record goes.
        before: ``(D,)`` the last command of the run, None before any.
        held: whether the arm was held by it since, without a stop.

    Raises:
        RunFailed: the folder cannot be written to.
        BadFrame: the state does not tell where a commanded joint is.
    """

    def __init__(
        self,
        plan: Plan,
        task: Task,
        number: int,
        folder: Path,
        before: Array | None = None,
        held: bool = False,
    ) -> None:
        self._plan = plan
        self._task = task
        self._number = number
        self._seed = plan.seed + number
        self._folder = folder
        self._before = before
        self._held = held
        embodiment, settings = plan.robot.embodiment, plan.settings
        lead_s = min(_LEAD_S, _LEAD_SHARE / plan.rate_hz)
        self._rate = Rate(plan.rate_hz, plan.robot.clock, lead_s=lead_s)
        self._limiter = Limiter(
            embodiment,
            self._rate.period,
            settings.velocity_scale,
            settings.acceleration_scale,
        )
        self._path = CommandPath(
            self._execute,
            self._rate,
            self._limiter,
            plan.latch,
            plan.filters,
            self._on_sent,
            plan.robot.speed,
        )
        self._tracking = TrackingWatch(embodiment, settings)
        self._columns = action_columns(embodiment)
        self._grippers = np.array([joint.kind == "gripper" for joint in embodiment.joints])
        self._phase = "start"
        self._executing = False
        self._record = EpisodeRecord(plan, task, self._seed, folder, self._rate)
        self._reader = Reader(plan, self._record)

    def run(self) -> dict[str, Any]:
        """The whole episode.

        Raises:
            Exception: what ended it before its time; the robot is stopped by then.
            Interrupted: a signal ended it, and the robot is stopped by then; or one came while
                its record was finished.
        """
        plan = self._plan
        outcome, problem = "failed", None
        plan.interrupts.deferred = True
        try:
            plan.latch.check()
            plan.hooks.call("episode_started", task=self._task.instruction)
            self._begin()
            outcome = self._loop().run()
            self._phase = "hold"
            self._path.brake(self._most_braking())
            # Signals that come now wait until the record is complete, however many.
            plan.interrupts.stopping = True
        except Interrupted as error:
            outcome, problem = "interrupted", f"stopped by {error.name}"
            self._stop("interrupt", problem)
            raise
        except BaseException as error:
            outcome, problem = "failed", _what(error)
            self._stop(self._rule(error), problem)
            raise
        finally:
            summary = self._close(outcome, problem)
            plan.hooks.call("episode_finished", reason=problem or outcome)
            self._phase = "over"
            plan.interrupts.deferred = False
        plan.interrupts.resume()
        return summary

    def hold(self) -> None:
        """Send the last command once more, at the next beat: after an episode that ended well.

        What goes wrong meanwhile trips the latch, and the robot is stopped; it is noted beside the
        record, which is complete.

        Raises:
            SafetyStop: the latch was tripped, or the arm does not stay.
            OperatorError: the robot does not take it, or a stream fell silent.
        """
        beats = self._rate.beats
        try:
            self._path.hold()
        except FluxError as error:
            self._stop_held(error)
            raise
        if self._rate.beats == beats:
            # A runner's own sending that has no beat of the rate's.
            time.sleep(self._rate.period)

    @property
    def commanded(self) -> Array | None:
        """``(D,)`` the last command of the run, None before any."""
        return self._limiter.last if self._limiter.started else self._before

    def _begin(self) -> None:
        """Read where the arm is, and bring it to the start pose."""
        plan = self._plan
        plan.robot.begin(self._task.instruction, self._number)
        reading = self._reader.first()
        self._note(reading)
        self._limiter.start(self._where(reading.state))
        plan.policy.reset(self._seed)
        if plan.start_pose is not None:
            self._go(np.asarray(plan.start_pose, dtype=np.float64))
        for each in plan.filters:
            reset = getattr(each, "reset", None)
            if reset is not None:
                reset(self._limiter.last)
        self._rate.reset()
        self._tracking.reset()
        self._phase = "ready"

    def _go(self, pose: Array) -> None:
        """Move to the ``(D,)`` start pose, never faster than ``safety.ramp_scale``."""
        plan = self._plan
        self._phase, most = "ramp", plan.settings.ramp_scale
        targets = ramp(self._limiter, pose, most)
        seconds = len(targets) / plan.rate_hz
        plan.context.reporter.info(f"moving to the start pose, {seconds:.1f} s")
        self._path.play(targets, filtered=False, most=most)
        # An arm that a person slowed down is not there yet; let go, it does not make up for it.
        while np.abs(self._limiter.last - pose).max() > _THERE:
            self._path.play([pose], filtered=False, most=most)

    def _loop(self) -> Loop:
        plan = self._plan
        return Loop(
            path=self._path,
            joiner=plan.joiner,
            observe=self._observe,
            think=self._think,
            admit=self._admit,
            keyframe_hz=plan.policy.action_rate_hz,
            horizon=plan.policy.horizon,
            clock=plan.robot.clock,
            lockstep=plan.robot.lockstep,
            settings=plan.settings,
            worker=plan.worker,
            interrupts=plan.interrupts,
            latency_s=plan.latency_s,
            holds=(plan.start_pose is not None or self._held) and not plan.robot.lockstep,
            begin_anew=lambda: plan.policy.reset(self._seed),
        )

    def _where(self, state: Array) -> Array:
        """``(D,)`` the command to go on from: the one that holds the arm, else where it is.

        An arm droops; to begin where it droops to would be a jump of its command. A joint that is
        far from its command was moved, or nobody knows what its stop commanded: that one begins
        where it is. A gripper is always far, because of what it holds.
        """
        measured = self._plan.robot.state()
        if measured is not None:
            state = measured.state
        commanded = self._plan.robot.commanded(self._before)
        if commanded is None:
            return state[self._columns]
        kept = self._grippers
        if self._held:
            kept = kept | self._tracking.follows(commanded, state)
        elif self._plan.robot.tells_hold:
            kept = kept | self._tracking.stayed(commanded, state)
        return np.where(kept, commanded, state[self._columns])

    def _observe(self) -> Seen:
        reading = self._reader.read()
        if self._plan.robot.follows:
            self._tracking.check(reading.state, reading.measured)
        self._note(reading)
        observation = {**reading.window, "task_description": self._task.instruction}
        return Seen(observation, reading.at)

    def _note(self, reading: Reading) -> None:
        images = reading.window["images"]
        self._record.seen(reading.state, images, reading.frame, reading.seconds)

    def _think(self, seen: Seen, rest: Continuation | None) -> Answer:
        policy: Any = self._plan.policy
        began = time.perf_counter()
        try:
            if rest is None:
                chunk = policy.predict_action(seen.observation)
            else:
                chunk = policy.continue_action(seen.observation, rest)
        except RecordingEnded as error:
            raise EpisodeOver(ENDED) from error
        except FluxError:
            raise
        except Exception as error:
            raise PolicyFailed(f"the policy raised {type(error).__name__}: {error}") from error
        seconds = time.perf_counter() - began
        # Checked here: for arrays of a chunk's size numpy gives the interpreter up, and the thread
        # that sends would have to get it again.
        try:
            return Answer(chunk, seconds, self._keyframes(chunk))
        except BadChunk as problem:
            return Answer(chunk, seconds, problem)

    def _keyframes(self, chunk: Any) -> Array:
        plan, policy = self._plan, self._plan.policy
        keyframes = check_chunk(
            chunk, plan.robot.embodiment, policy.action_rate_hz, plan.settings
        ).copy()
        if len(keyframes) != policy.horizon:
            raise BadChunk(
                f"the policy's chunk has {len(keyframes)} keyframes; it said {policy.horizon}"
            )
        keyframes.flags.writeable = False
        return keyframes

    def _admit(self, seen: Seen, answer: Answer) -> Array:
        plan, policy, keyframes = self._plan, self._plan.policy, answer.keyframes
        try:
            if isinstance(keyframes, BadChunk):
                raise keyframes
            check_beginning(
                keyframes,
                plan.robot.embodiment,
                self._limiter.last,
                policy.action_rate_hz,
                plan.settings,
            )
        except BadChunk:
            self._record.refused("chunk", answer=answer.chunk)
            raise
        self._phase = "run"
        if plan.hooks:
            plan.hooks.call("observed", observation=_frozen(seen.observation))
            plan.hooks.call("inferred", chunk=keyframes, latency_s=answer.seconds)
        stages = {"policy": answer.seconds, **getattr(policy, "stages", {})}
        self._record.chunk(keyframes, seen.at, stages)
        return keyframes[: plan.keyframes]

    def _execute(self, actions: Array, rate: Rate) -> None:
        self._executing = True
        self._plan.execute(actions, rate)
        self._executing = False

    def _on_sent(self, sent: Sent | None) -> None:
        """The beat after each command: recorded always, supervised while it may still stop."""
        plan, record = self._plan, self._record
        # Between two episodes, too: an arm that is held may be switched off, or moved.
        supervised = self._phase in ("ramp", "ready", "run", "over")
        try:
            measured, problem = plan.robot.state(), None
        except OperatorError as error:
            # What was sent is recorded all the same; and a stream that fell silent stops an arm,
            # it does not keep it from braking.
            measured, problem = None, error
        if sent is not None and self._phase != "over":
            record.command(sent, self._phase, None if measured is None else measured.state)
            if plan.hooks:
                action = sent.command.copy()
                action.flags.writeable = False
                plan.hooks.call("action_sent", action=action, stamp=plan.robot.clock.now())
        if not supervised:
            return
        if problem is not None:
            raise problem
        plan.interrupts.check()
        if sent is not None:
            self._tracking.sent(sent.command, self._path.sent_at)
        if measured is not None and plan.robot.follows:
            self._tracking.check(measured.state, measured.at)
        if self._phase != "run" or sent is None:
            return
        record.steps += 1
        plan.context.reporter.progress("commands", record.steps, plan.most_steps)
        if plan.robot.done():
            raise EpisodeOver("done")
        if record.steps >= plan.most_steps:
            raise EpisodeOver("max_steps")

    def _rule(self, error: BaseException) -> str:
        rule = getattr(error, "rule", None)
        if rule is not None:
            return str(rule)
        if isinstance(error, OperatorError):
            return "operator"
        return "execute" if self._executing else "run"

    def _stop(self, rule: str, problem: str) -> None:
        """The safe stop: brake where the arm still obeys, then the operator's own stop."""
        plan = self._plan
        plan.interrupts.stopping = True
        began = plan.robot.clock.now()
        self._phase = "stop"
        if rule != "interrupt":
            plan.latch.trip(rule, problem)
        if self._limiter.started and (rule not in _NOT_BRAKED or not plan.robot.can_stop):
            try:
                self._path.brake(self._most_braking())
            except Exception as error:  # noqa: BLE001 - the operator's own stop comes next
                plan.context.reporter.warn(f"braking failed: {_what(error)}")
        failure = self._stop_robot()
        seconds = plan.robot.clock.now() - began
        self._record.event("stop", rule=rule, problem=problem, seconds=seconds, failure=failure)

    def _stop_robot(self) -> str | None:
        """The operator's own stop; what went wrong with it."""
        failure = self._plan.robot.stop()
        if failure:
            self._plan.context.reporter.warn(failure)
        return failure

    def _stop_held(self, error: FluxError) -> None:
        plan = self._plan
        if plan.latch.tripped is None:
            plan.latch.trip(self._rule(error), error)
        failure = self._stop_robot()
        try:
            note_trip(self._folder, **asdict(plan.latch.trips[-1]), failure=failure)
        except RunFailed as problem:
            plan.context.reporter.warn(str(problem))

    def _most_braking(self) -> int:
        limiter = self._limiter
        return int(np.max(limiter.velocity / limiter.acceleration) / limiter.period) + 3

    def _close(self, outcome: str, problem: str | None) -> dict[str, Any]:
        plan = self._plan
        success: bool | None
        try:
            success = plan.robot.success()
        except Exception as error:  # noqa: BLE001 - why the episode ended matters more
            plan.context.reporter.warn(f"task_success failed: {_what(error)}")
            success = None
        try:
            summary = self._record.close(outcome, success, problem)
        except RunFailed as error:
            if problem is None:
                raise
            # A lost record must not hide why an episode ended.
            plan.context.reporter.warn(str(error))
            summary = {}
        plan.context.reporter.artifact("episode", self._folder)
        return summary


def _what(error: BaseException) -> str:
    return error.what if isinstance(error, FluxError) else f"{type(error).__name__}: {error}"


def _frozen(observation: dict[str, Any]) -> dict[str, Any]:
    """The observation with its arrays read-only: hooks look, they do not touch."""
    images = {name: image.view() for name, image in observation["images"].items()}
    shown = {**observation, "qpos": np.asarray(observation["qpos"]).view(), "images": images}
    for array in (shown["qpos"], *images.values()):
        array.flags.writeable = False
    return shown
