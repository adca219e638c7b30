"""``RemoteEngine``: the main process's side of a robot that is commanded by another process."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from fluxvla_core.contracts.runner import Reporter
from fluxvla_core.control import realtime
from fluxvla_core.control.interrupt import Interrupted, Interrupts
from fluxvla_core.control.policy_client import PolicyClient
from fluxvla_core.control.safety import Latch, Rule
from fluxvla_core.control.tracking import TrackingWatch
from fluxvla_core.errors import FluxError, RunFailed
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
from fluxvla_core.robot.process.control_process import (
    END_S,
    HUNG_S,
    ControlProcess,
    ControlProcessGone,
    stop_through_new_connection,
)
from fluxvla_core.robot.process.messages import Kind, Message, error_fields, error_of, event_of
from fluxvla_core.robot.process.remote_operator import RemoteOperator
from fluxvla_core.robot.process.setup import ControlSetup
from fluxvla_core.robot.robot import STOP_S, Robot
from fluxvla_core.robot.tasks import Task

_START_S = 30.0
_WATCH_S = 0.02


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
        remote_operator: the stand-in for an operator that runs as a whole in the other process.
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
        remote_operator: RemoteOperator | None = None,
    ) -> None:
        self._setup, self._robot, self._settings = setup, robot, setup.settings
        self._remote_operator = remote_operator
        self._make_client = make_client
        self._latch, self._interrupts, self._reporter = latch, interrupts, reporter
        self._history = history
        self._started: ControlProcess | None = None
        self._observers: Sequence[EpisodeObserver] = ()
        self._ended_at: float | None = None
        self._steps = 0
        self._facts: Mapping[str, Any] = {}

    def connect(self) -> None:
        realtime.yield_to_control_process()
        self._start()
        self._robot.connect()

    def commanding(self) -> AbstractContextManager[object]:
        # So that a policy's threads release the GIL for the one that shows that this process runs.
        return realtime.short_gil_slices()

    def run_episode(
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
        if not self._runs:
            # It was lost, and a person says that the robot may move again.
            self._start()
        self._emit(EpisodePrepared(now(), task, seed, settings.rate_hz))
        self._interrupts.deferred = True
        try:
            self._emit(EpisodeStarted(now(), task))
            # Compared with commands in the control process.
            tracking = TrackingWatch(self._robot.embodiment, settings.safety)
            self._process.server.begin(self._make_client(task, seed, tracking, self._emit))
            self._await_episode(task, number, seed, folder)
        except ControlProcessGone as gone:
            self._note_gone(gone)
            raise
        finally:
            self._process.server.end()
            self._interrupts.deferred = False
        self._interrupts.resume()

    @property
    def holding(self) -> bool:
        return self._started is not None and self._started.holding

    def hold(self) -> None:
        try:
            self._dispatch(_WATCH_S)
        except ControlProcessGone as gone:
            failure = stop_through_new_connection(self._setup, self._reporter, END_S)
            self._latch.trip(gone.rule, gone)
            now = self._robot.clock.now()
            self._emit(StoppedWhileHeld(now, self._latch.trips[-1], failure))
            raise

    def release(self) -> None:
        self._let_go()
        if self._runs:
            self._order(Kind.RELEASE, STOP_S)

    def rearm(self) -> None:
        self._latch.rearm()
        if self._runs:
            self._order(Kind.REARM, STOP_S)

    def episode_facts(self) -> Mapping[str, Any]:
        return self._facts

    def stop(self) -> str | None:
        self._let_go()
        return self._ordered_stop(Kind.STOP) if self._runs else None

    def close(self) -> str | None:
        failure = self._process.end(END_S) if self._runs else None
        return self._robot.close() or failure

    def _start(self) -> None:
        """Start the process, and let it connect to the robot.

        Raises:
            FluxError: its side of the robot cannot be built, or cannot be connected to; or this
                machine has no room for it.
        """
        interrupts = self._interrupts
        # Ctrl-C waits until the process is known here, and can be ended.
        deferred, interrupts.deferred = interrupts.deferred, True
        try:
            self._started = ControlProcess(
                self._setup, self._robot, interrupts, self._remote_operator
            )
        finally:
            interrupts.deferred = deferred
        try:
            self._await(Kind.READY, _START_S)
            self._order(Kind.CONNECT, None)
        except BaseException:
            # Nothing was commanded yet.
            if self._runs:
                self._process.end(HUNG_S)
            raise

    @property
    def _process(self) -> ControlProcess:
        """The control process that was started last; it may be dead."""
        assert self._started is not None, "the control process was started"
        return self._started

    @property
    def _runs(self) -> bool:
        """Whether there is a control process, as far as is known."""
        return self._started is not None and not self._started.ended

    def _let_go(self) -> None:
        """The arm is not held any more."""
        if self._started is not None:
            self._started.holding = False

    def _await_episode(self, task: Task, number: int, seed: int, folder: Path) -> None:
        """Order an episode, and handle what the control process sends until it is over."""
        problem: BaseException | None = None
        self._process.link.send(
            Kind.RUN_EPISODE,
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
                self._process.link.send(Kind.SIGNAL, number=interrupted.number)
                continue
            except ControlProcessGone:
                raise
            except BaseException as error:  # noqa: BLE001 - raised once the robot is stopped
                # An observer's, or the policy's before anything moved: the robot is to be stopped.
                if problem is None:
                    problem = error
                    self._interrupts.stopping = True
                    self._process.link.send(Kind.FAULT, **_fault(error))
                continue
            if done is not None and done["order"] == Kind.RUN_EPISODE:
                break
        self.stop_failure, self._process.holding = done["stop_failure"], done["holding"]
        self._facts = done["facts"]
        lost = self._process.newly_lost()
        if lost:
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
        known = [(e, error_fields(e)["what"]) for e in self._process.server.raised]
        return next((e for e, what in known if error.what.startswith(what)), None)

    def _dispatch(self, timeout_s: float) -> Message | None:
        """Handle what the control process sent; returns at its ``done``, or after a while.

        Raises:
            ControlProcessGone: it is dead, or hangs.
            Exception: what an observer raised, or what ended the hold between two episodes.
        """
        until = time.monotonic() + timeout_s
        while True:
            message = self._process.receive(max(until - time.monotonic(), 0.0))
            if message is None or message.kind == Kind.DONE:
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
                self._episode_client.accepted(self._process.server.answers.pop(fields["number"]))
            case Kind.REFUSED:
                self._episode_client.refused(self._process.server.answers.pop(fields["number"]))
            case Kind.INFO:
                self._reporter.info(fields["text"])
            case Kind.WARN:
                self._reporter.warn(fields["text"])
            case Kind.ARTIFACT:
                self._reporter.artifact(fields["artifact"], Path(fields["path"]))
            case Kind.LOG:
                logging.getLogger(fields["logger"]).log(fields["level"], "%s", fields["text"])
            case Kind.RELEASED if self.holding:
                self._let_go()
                raise error_of(fields)
            case Kind.FAILED:
                raise error_of(fields)

    def _happened(self, event: Event) -> None:
        match event:
            case CommandSent(sent=sent, phase=phase):
                self._process.server.phase, self._history.commanded = phase, sent.command
                if phase is Phase.RUN:
                    client = self._process.server.client
                    if client is not None:
                        client.ticked()
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
        client = self._process.server.client
        assert client is not None, "the control process sends queries in an episode only"
        return client

    def _reply(self, to: str, answer: Callable[[], Any]) -> None:
        """Answer a request of the control process, which waits for it while nothing moves."""
        try:
            found = answer()
        except Interrupted:
            raise
        except Exception as error:  # noqa: BLE001 - raised in the control process
            self._process.server.raised.append(error)
            self._process.link.send(Kind.REPLY, to=to, **error_fields(error))
            return
        self._process.link.send(Kind.REPLY, () if found is None else (found,), to=to)

    def _order(self, order: Kind, timeout_s: float | None) -> Message:
        """Have an order carried out.

        Raises:
            FluxError: what went wrong with it.
        """
        self._process.link.send(order)
        done = self._await(Kind.DONE, timeout_s)
        if "error" in done.fields:
            raise error_of(done.fields)
        return done

    def _await(self, kind: Kind, timeout_s: float | None) -> Message:
        until = None if timeout_s is None else time.monotonic() + timeout_s
        while until is None or time.monotonic() < until:
            self._interrupts.check()
            message = self._process.receive(_WATCH_S)
            if message is None:
                continue
            if message.kind == kind:
                return message
            self._handle(message)
        raise RunFailed(f"the control process sent no {kind.value!r} within {timeout_s:g} s")

    def _note_gone(self, gone: ControlProcessGone) -> None:
        """Try the operator's own stop, and complete the record."""
        began = self._robot.clock.now()
        self._let_go()
        self._interrupts.stopping = True
        self.stop_failure = failure = stop_through_new_connection(
            self._setup, self._reporter, END_S
        )
        if failure is not None:
            self._reporter.warn(failure)
        now = self._robot.clock.now()
        self._latch.trip(gone.rule, gone)
        self._emit(Stopped(now, gone.rule, gone.what, now - began, failure))
        self._emit(EpisodeEnded(now, "failed", None, gone.what, 0, (self._latch.trips[-1],)))

    def _ordered_stop(self, order: Kind) -> str | None:
        try:
            self._process.link.send(order)
            done = self._await(Kind.DONE, STOP_S + 1.0)
        except Exception as error:  # noqa: BLE001 - reported; the rest of the end follows
            return str(error)
        failure: str | None = done.fields.get("result")
        return failure


def _fault(error: BaseException) -> dict[str, Any]:
    fields = error_fields(error)
    return {**fields, "rule": fields["rule"] or Rule.RUN.value}
