"""``RemoteEngine``: the main process's side of a robot that is commanded by another process."""

from __future__ import annotations

import logging
import queue
import signal
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from fluxvla_core.contracts.reporter import Reporter
from fluxvla_core.errors import FluxError, RunFailed
from fluxvla_core.robot.control import realtime
from fluxvla_core.robot.control.interrupt import Interrupted, Interrupts
from fluxvla_core.robot.control.policy_client import PolicyClient
from fluxvla_core.robot.control.safety import Latch, Rule
from fluxvla_core.robot.control.tracking import TrackingWatch
from fluxvla_core.robot.engine import Engine, RunHistory
from fluxvla_core.robot.episode import PolicyClientFactory
from fluxvla_core.robot.events import (
    CommandSent,
    EpisodeEnded,
    EpisodeObserver,
    EpisodePrepared,
    EpisodeStarted,
    Event,
    Phase,
    Stopped,
    StoppedWhileHeld,
)
from fluxvla_core.robot.process import launch
from fluxvla_core.robot.process.event_messages import event_of
from fluxvla_core.robot.process.launch import ControlProcessGone
from fluxvla_core.robot.process.link import Link
from fluxvla_core.robot.process.messages import Kind, Message, error_fields, error_of
from fluxvla_core.robot.process.remote_operator import RemoteOperator
from fluxvla_core.robot.process.server import LinkServer
from fluxvla_core.robot.process.setup import ControlSetup
from fluxvla_core.robot.robot import STOP_S, Robot
from fluxvla_core.robot.tasks import Task

_START_S = 30.0
_WATCH_S = 0.02
# For how long the control process may not run before it is given up.
_HUNG_S = 1.0
# For how long a connection that is only made to stop the robot, or an orderly end, may take.
_END_S = 2 * STOP_S + 1.0


class RemoteEngine(Engine):
    """A robot that is commanded by a process of its own.

    Args:
        setup: what the control process is built from.
        robot: reads the cameras in this process; not connected.
        make_client: makes the policy client of an episode's chunks.
        latch: follows the control process's.
        interrupts: signals; passed on.
        reporter: shows progress and warnings.
        history: of the runner's earlier runs.
        frames: shows this process the images of an operator that runs as a whole in the other.
    """

    def __init__(
        self,
        setup: ControlSetup,
        robot: Robot,
        make_client: PolicyClientFactory,
        latch: Latch,
        interrupts: Interrupts,
        reporter: Reporter,
        history: RunHistory,
        frames: RemoteOperator | None = None,
    ) -> None:
        self._setup, self._robot, self._settings = setup, robot, setup.settings
        self._frames = frames
        self._make_client = make_client
        self._latch, self._interrupts, self._reporter = latch, interrupts, reporter
        self._history = history
        self._link: Link
        self._process: subprocess.Popen[bytes] | None = None
        self._server: LinkServer
        self._observers: Sequence[EpisodeObserver] = ()
        self._ended_at: float | None = None
        self._lost = 0
        self._steps = 0
        self._holding = False
        self._facts: Mapping[str, Any] = {}

    # The contract.

    def connect(self) -> None:
        self._start()
        self._robot.connect()

    def commanding(self) -> AbstractContextManager[object]:
        # So that a policy's threads release the GIL for the one that shows that this process runs.
        return realtime.short_gil_slices()

    def play(
        self,
        task: Task,
        number: int,
        seed: int,
        observers: Sequence[EpisodeObserver],
        folder: Path,
    ) -> None:
        self._observers, self._steps, self._ended_at = observers, 0, None
        settings, now = self._settings, self._robot.clock.now
        self._latch.check()
        if self._process is None:
            # It was lost, and a person says that the robot may move again.
            self._start()
        self._emit(EpisodePrepared(now(), task, seed, settings.rate_hz))
        self._interrupts.deferred = True
        try:
            self._emit(EpisodeStarted(now(), task))
            # Compared with commands in the control process.
            tracking = TrackingWatch(self._robot.embodiment, settings.safety)
            self._server.begin(self._make_client(task, seed, tracking, self._emit))
            self._play(task, number, seed, folder)
        except ControlProcessGone as gone:
            self._note_gone(gone)
            raise
        finally:
            self._server.end()
            self._interrupts.deferred = False
        self._interrupts.resume()

    @property
    def holding(self) -> bool:
        return self._holding

    def hold(self) -> None:
        try:
            self._dispatch(_WATCH_S)
        except ControlProcessGone as gone:
            failure = launch.stop_through_new_connection(self._setup, self._reporter, _END_S)
            self._latch.trip(gone.rule, gone)
            now = self._robot.clock.now()
            self._emit(StoppedWhileHeld(now, self._latch.trips[-1], failure))
            raise

    def release(self) -> None:
        self._holding = False
        if self._process is not None:
            self._order(Kind.RELEASE, STOP_S)

    def rearm(self) -> None:
        self._latch.rearm()
        if self._process is not None:
            self._order(Kind.REARM, STOP_S)

    def episode_facts(self) -> Mapping[str, Any]:
        return self._facts

    def stop(self) -> str | None:
        self._holding = False
        return None if self._process is None else self._ordered_stop(Kind.STOP)

    def close(self) -> str | None:
        failure = self._end(_END_S) if self._process is not None else None
        return self._robot.close() or failure

    # Parts.

    def _start(self) -> None:
        """Start the process, and let it connect to the robot.

        Raises:
            FluxError: its side of the robot cannot be built, or cannot be connected to; or this
                machine has no room for it.
        """
        try:
            cameras, frames = self._setup.cameras or (), self._frames
            memory = None if frames is None else frames.open(cameras)
            self._process, self._link = launch.launch(self._setup, memory)
        except OSError as error:
            raise RunFailed(
                f"the control process could not be started: {error}",
                cause="this machine has no memory or no process to spare",
            ) from error
        self._lost = 0
        self._server = LinkServer(self._link, self._robot, self._interrupts)
        try:
            self._await(Kind.READY, _START_S)
            self._order(Kind.CONNECT, None)
        except BaseException:
            # Nothing was commanded yet.
            if self._process is not None:
                self._end(_HUNG_S)
            raise

    def _play(self, task: Task, number: int, seed: int, folder: Path) -> None:
        problem: BaseException | None = None
        self._link.send(
            Kind.PLAY,
            task=task.name,
            instruction=task.instruction,
            free=task.free,
            number=number,
            seed=seed,
            folder=str(folder.resolve()),
        )
        while True:
            try:
                self._interrupts.check()
                done = self._dispatch(_WATCH_S)
            except Interrupted as interrupted:
                problem = problem or interrupted
                self._interrupts.stopping = True
                self._link.send(Kind.SIGNAL, number=interrupted.number)
                continue
            except ControlProcessGone:
                raise
            except BaseException as error:  # noqa: BLE001 - raised once the robot is stopped
                # An observer's, or the policy's before anything moved: the robot is to be stopped.
                if problem is None:
                    problem = error
                    self._interrupts.stopping = True
                    self._link.send(Kind.FAULT, **_fault(error))
                continue
            if done is not None and done["order"] == Kind.PLAY:
                break
        self.stop_failure, self._holding = done["stop_failure"], done["holding"]
        self._facts = done["facts"]
        if self._link.lost > self._lost:
            lost, self._lost = self._link.lost - self._lost, self._link.lost
            self._reporter.warn(f"{lost} commands were not recorded: this process did not keep up")
        if problem is not None:
            raise problem
        if "signal" in done.fields:
            raise Interrupted(done["signal"])
        if "error" in done.fields:
            ending = error_of(done.fields)
            if self._ended_at is None:
                # The episode did not even begin there.
                now = self._robot.clock.now()
                self._emit(EpisodeEnded(now, "failed", None, ending.what, 0, ()))
            raise ending from self._original(ending)

    def _original(self, error: FluxError) -> BaseException | None:
        """The exception that was raised in this process and came back as ``error``, if any."""
        known = [(e, error_fields(e)["what"]) for e in self._server.raised]
        return next((e for e, what in known if error.what.startswith(what)), None)

    def _dispatch(self, timeout_s: float) -> Message | None:
        """Handle what the control process sent; returns at its ``done``, or after a while.

        Raises:
            ControlProcessGone: it is dead, or hangs.
            Exception: what an observer raised, or what ended the hold between two episodes.
        """
        until = time.monotonic() + timeout_s
        while True:
            self._check_alive()
            try:
                message = self._server.messages.get(timeout=max(until - time.monotonic(), 0.0))
            except queue.Empty:
                return None
            if message.kind == Kind.DONE:
                return message
            self._handle(message)

    def _handle(self, message: Message) -> None:
        event = event_of(message)
        if event is not None:
            self._happened(event)
            return
        fields = message.fields
        match message.kind:
            case Kind.FIRST_STATE:
                self._reply(message.kind, lambda: self._episode_client.first_state())
            case Kind.RESET:
                self._reply(message.kind, lambda: self._episode_client.reset())
            case Kind.ACCEPTED:
                self._episode_client.accepted(self._server.answers.pop(fields["number"]))
            case Kind.REFUSED:
                self._episode_client.refused(self._server.answers.pop(fields["number"]))
            case Kind.INFO:
                self._reporter.info(fields["text"])
            case Kind.WARN:
                self._reporter.warn(fields["text"])
            case Kind.ARTIFACT:
                self._reporter.artifact(fields["artifact"], Path(fields["path"]))
            case Kind.LOG:
                logging.getLogger(fields["logger"]).log(fields["level"], "%s", fields["text"])
            case Kind.RELEASED:
                self._holding = False
                raise error_of(fields)
            case Kind.FAILED:
                raise error_of(fields)

    def _happened(self, event: Event) -> None:
        match event:
            case CommandSent(sent=sent, phase=phase):
                self._server.phase, self._history.commanded = phase, sent.command
                if phase is Phase.RUN:
                    self._steps += 1
                    most = self._settings.max_steps
                    self._reporter.progress("commands", self._steps, most)
            case Stopped(rule=rule, problem=problem) if rule != Rule.INTERRUPT:
                self._latch.trip(rule, problem)
            case StoppedWhileHeld(trip=trip):
                self._latch.trip(trip.rule, trip.what)
            case EpisodeEnded(at=at):
                self._ended_at = at
                # Signals that come now wait until the record is complete.
                self._interrupts.stopping = True
        self._emit(event)

    def _emit(self, event: Event) -> None:
        for observer in self._observers:
            observer.on_event(event)

    @property
    def _episode_client(self) -> PolicyClient:
        client = self._server.client
        assert client is not None, "the control process asks in an episode only"
        return client

    def _reply(self, to: str, answer: Callable[[], Any]) -> None:
        """Answer a request of the control process, which waits for it while nothing moves."""
        try:
            found = answer()
        except Interrupted:
            raise
        except Exception as error:  # noqa: BLE001 - raised in the control process
            self._server.raised.append(error)
            self._link.send(Kind.REPLY, to=to, **error_fields(error))
            return
        self._link.send(Kind.REPLY, () if found is None else (found,), to=to)

    def _order(self, order: Kind, timeout_s: float | None) -> Message:
        """Have an order carried out.

        Raises:
            FluxError: what went wrong with it.
        """
        self._link.send(order)
        done = self._await(Kind.DONE, timeout_s)
        if "error" in done.fields:
            raise error_of(done.fields)
        return done

    def _await(self, kind: Kind, timeout_s: float | None) -> Message:
        until = None if timeout_s is None else time.monotonic() + timeout_s
        while until is None or time.monotonic() < until:
            self._interrupts.check()
            self._check_alive()
            try:
                message = self._server.messages.get(timeout=_WATCH_S)
            except queue.Empty:
                continue
            if message.kind == kind:
                return message
            self._handle(message)
        raise RunFailed(f"the control process sent no {kind.value!r} within {timeout_s:g} s")

    # Its end.

    def _check_alive(self) -> None:
        """See that the control process runs.

        Raises:
            ControlProcessGone: it does not; it is dead by now.
        """
        process = self._process
        assert process is not None, "the control process was started"
        code = process.poll()
        if code is not None and self._server.messages.empty():
            ended = f"ended with exit code {code}"
            raise self._gone(ended if code >= 0 else f"was killed by {signal.Signals(-code).name}")
        if code is None and not self._server.alive:
            self._link.send(Kind.CLOSE)
            try:
                process.wait(_END_S)
            except subprocess.TimeoutExpired:
                process.kill()
            raise self._gone("stopped responding to this process and was ended")
        patience_s, silent_s = self._patience_s(), self._link.silent_s()
        if code is None and patience_s is not None and silent_s > patience_s:
            process.kill()
            raise self._gone(f"did not run for {silent_s:.1f} s and was killed")

    def _patience_s(self) -> float | None:
        """How long the control process may not run; None while it waits for the operator."""
        if self._server.client is None:
            return _HUNG_S if self._holding else None
        phase = self._server.phase
        if phase.stoppable:
            return _HUNG_S
        if phase in (Phase.HOLD, Phase.STOP):
            # It may be in the operator's own stop.
            return _HUNG_S + STOP_S
        # The robot is being prepared, perhaps by a simulation that puts its objects in place.
        return _HUNG_S + STOP_S if self._interrupts.stopping else None

    def _gone(self, how: str) -> ControlProcessGone:
        self._clean_up()
        return ControlProcessGone(
            f"the control process {how}: nothing commands the robot any more",
            cause="somebody, or the system, ended it, or the robot's driver crashed it",
            next="look at the robot; docs/control.md says what each robot does by itself then",
        )

    def _note_gone(self, gone: ControlProcessGone) -> None:
        """Try the operator's own stop, and complete the record."""
        began = self._robot.clock.now()
        self._holding = False
        self._interrupts.stopping = True
        self.stop_failure = failure = launch.stop_through_new_connection(
            self._setup, self._reporter, _END_S
        )
        if failure is not None:
            self._reporter.warn(failure)
        now = self._robot.clock.now()
        self._latch.trip(gone.rule, gone)
        self._emit(Stopped(now, gone.rule, gone.what, now - began, failure))
        self._emit(EpisodeEnded(now, "failed", None, gone.what, 0, (self._latch.trips[-1],)))

    def _ordered_stop(self, order: Kind) -> str | None:
        try:
            self._link.send(order)
            done = self._await(Kind.DONE, STOP_S + 1.0)
        except Exception as error:  # noqa: BLE001 - reported; the rest of the end follows
            return str(error)
        failure: str | None = done.fields.get("result")
        return failure

    def _end(self, patience_s: float) -> str | None:
        """Have the process stop the robot, disconnect and end; what went wrong."""
        assert self._process is not None, "the control process was started"
        self._link.send(Kind.CLOSE)
        failures: list[str] = []
        try:
            self._process.wait(patience_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            failures = ["the control process did not end: use the robot's emergency stop"]
        self._clean_up()
        while not self._server.messages.empty():
            message = self._server.messages.get()
            if message.kind == Kind.CLOSED:
                failures += [failure for failure in message["failures"] if failure]
        return "; ".join(failures) or None

    def _clean_up(self) -> None:
        """End the thread of the link, after what the process sent last."""
        assert self._process is not None, "the control process was started"
        self._process.wait()
        self._process = None
        self._server.close()
        if self._frames is not None:
            self._frames.close()


def _fault(error: BaseException) -> dict[str, Any]:
    fields = error_fields(error)
    return {**fields, "rule": fields["rule"] or Rule.RUN.value}
