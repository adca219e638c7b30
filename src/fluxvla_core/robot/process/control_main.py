"""The control process: commands the robot, and queries the policy through the main process.

It runs the same episodes as a run in one process; where those query the policy, look at a signal or
report something, the classes here send a message to the main process, and never wait for it while
an arm moves.
"""

from __future__ import annotations

import gc
import logging
import os
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from fluxvla_core.contracts.runner import Reporter
from fluxvla_core.control import realtime
from fluxvla_core.control.interrupt import Interrupted, stop_outcome
from fluxvla_core.control.joiners import make_joiner
from fluxvla_core.control.safety import Latch
from fluxvla_core.control.sender import ExecuteActions
from fluxvla_core.control.tracking import TrackingWatch
from fluxvla_core.errors import EXIT_FAILED, FluxError
from fluxvla_core.robot.engine import Engine, LocalEngine, RunHistory
from fluxvla_core.robot.episode import EpisodeParts
from fluxvla_core.robot.events import (
    CommandSent,
    EpisodeEnded,
    EpisodeObserver,
    Event,
    FilterSkipped,
    Phase,
    Stopped,
)
from fluxvla_core.robot.process.frames import FrameChannel
from fluxvla_core.robot.process.inbox import Inbox
from fluxvla_core.robot.process.link import Link
from fluxvla_core.robot.process.messages import Kind, Message, error_fields, event_message
from fluxvla_core.robot.process.remote_policy_client import RemotePolicyClient
from fluxvla_core.robot.process.setup import ControlSetup
from fluxvla_core.robot.process.timed_filters import timed_filters
from fluxvla_core.robot.process.undivided_robot import UndividedRobot
from fluxvla_core.robot.recording.logged import logged
from fluxvla_core.robot.robot import STOP_S, Robot
from fluxvla_core.robot.tasks import Task

# How often an idle process looks for orders, and a wait for an answer.
_POLL_S = 0.005
_NO_REAL_TIME = (
    "this user may not lock memory or have a real-time priority: commands may be late on a busy "
    "machine (docs/safety.md, Command pipeline)"
)
# Commands between two collections of young objects, which take place right after a command.
_COMMANDS_PER_COLLECTION = 64
# How long after the main process's death a call of the operator may hang: nobody else is there who
# would kill this process. A stop takes less.
_ORPHANED_S = 6 * STOP_S
# Events of half a minute: more than the main process can lose.
_EVENTS_KEPT = 4096
_IGNORED = ("SIGINT", "SIGHUP", "SIGQUIT", "SIGTSTP", "SIGPIPE")


class LinkReporter(Reporter):
    """Passes messages for people to the main process."""

    def __init__(self, link: Link) -> None:
        self._link = link

    def info(self, text: str) -> None:
        self._link.send(Kind.INFO, text=text)

    def warn(self, text: str) -> None:
        self._link.send(Kind.WARN, text=text)

    def artifact(self, kind: str, path: Path) -> None:
        self._link.send(Kind.ARTIFACT, artifact=kind, path=str(path))


class LinkLog(logging.Handler):
    """Passes warnings of libraries and drivers to the main process's log."""

    def __init__(self, link: Link) -> None:
        super().__init__(logging.WARNING)
        self._link = link

    def emit(self, record: logging.LogRecord) -> None:
        text = record.getMessage()
        self._link.send(Kind.LOG, logger=record.name, level=record.levelno, text=text)


class LinkObserver(EpisodeObserver):
    """Passes an episode's events to the main process, and keeps the newest for a record."""

    def __init__(self, link: Link, inbox: Inbox) -> None:
        self._link, self._inbox = link, inbox
        self._commands = 0
        self._newest: deque[CommandSent | FilterSkipped | Stopped | EpisodeEnded] = deque(
            maxlen=_EVENTS_KEPT
        )
        self._folder: Path | None = None
        self._in_episode = False

    def begin(self, folder: Path) -> None:
        """An episode begins; ``folder`` has its record."""
        self._newest.clear()
        self._folder, self._in_episode = folder, True

    def end(self) -> None:
        """The episode is over; whatever was sent of it may not have been read yet."""
        self._in_episode = self._inbox.orphaned

    def unread(self) -> tuple[bool, str | None]:
        """Whether the main process has not taken all that it was sent of the last episode, and what
        ended that early; None of an episode that only its death ended."""
        if self._in_episode:
            return True, None
        ended = (e.problem for e in reversed(self._newest) if isinstance(e, EpisodeEnded))
        return (False, None) if self._link.read_by_other else (True, next(ended, None))

    def on_event(self, event: Event) -> None:
        if isinstance(event, CommandSent):
            self._inbox.phase = event.phase
            self._commands += 1
            if self._commands % _COMMANDS_PER_COLLECTION == 0:
                gc.collect(1)
        if isinstance(event, (CommandSent, FilterSkipped, Stopped, EpisodeEnded)):
            self._newest.append(event)
        message = event_message(event)
        if message is not None:
            # Of commands there are many: those that find no room are counted.
            send = self._link.try_send if isinstance(event, CommandSent) else self._link.send
            send(message.kind, message.arrays, **message.fields)

    def write_rest(self) -> None:
        """Write what the main process, which is dead, did not; the robot was stopped.

        Raises:
            OSError: it cannot be written.
        """
        from fluxvla_core.robot.recording.trace import REST_FILE, JsonLines  # rarely needed

        if self._folder is None:
            return
        file = JsonLines(self._folder, REST_FILE)
        for event in self._newest:
            file.add(logged(event))
        file.close()


def serve(link: Link, setup: ControlSetup, frame_channel: FrameChannel | None = None) -> None:
    """Carry out the main process's orders until it says ``close``, or is dead.

    Args:
        link: this process's end.
        setup: what it is built from.
        frame_channel: this process's end, for an operator that runs here as a whole.

    Raises:
        ConfigError, PluginError: the operator or a filter cannot be built.
    """
    reporter = LinkReporter(link)
    inbox = Inbox(link, setup.settings.safety, setup.main, setup.settings.rate_hz)
    _take_signals(inbox)
    threading.Thread(target=_outlive_main, args=(inbox,), daemon=True).start()
    logging.getLogger().addHandler(LinkLog(link))
    robot, execute_actions = setup.build_control_side(reporter)
    if isinstance(robot, UndividedRobot):
        assert frame_channel is not None, "the main process shares memory for its images"
        robot.serve(frame_channel, setup.cameras or (), setup.settings.safety.max_age_s)
        inbox.watch = robot.check_frame_time
    observer = LinkObserver(link, inbox)
    parts = _parts(link, setup, robot, execute_actions, inbox, reporter, observer)
    history = RunHistory(commanded=None if setup.before is None else np.asarray(setup.before))
    engine = LocalEngine(parts, setup.settings, history)
    link.send(Kind.READY)
    try:
        with (
            robot.delays.watched(reporter.warn, setup.settings.safety.starvation_s),
            engine.commanding() as preferred,
        ):
            if not (realtime.lock_memory() and preferred):
                reporter.info(_NO_REAL_TIME)
            gc.disable()
            while not inbox.orphaned:
                order = inbox.order()
                if order is None:
                    _wait(link, inbox, engine)
                elif order.kind == Kind.CLOSE:
                    return
                else:
                    _carry_out(link, inbox, engine, observer, order)
    finally:
        unread, problem = observer.unread()
        failures = [engine.stop(), engine.close()]
        link.send(Kind.CLOSED, failures=failures)
        if inbox.orphaned:
            lost = _complete_record(observer) if unread else None
            _report_orphaned(engine, failures, problem, lost)


def _outlive_main(inbox: Inbox) -> None:
    """Let this process stop the robot after the main process's death, and no longer."""
    while not inbox.orphaned:
        time.sleep(1.0)
    time.sleep(_ORPHANED_S)
    os._exit(EXIT_FAILED)


def _complete_record(observer: LinkObserver) -> OSError | None:
    try:
        observer.write_rest()
    except OSError as error:
        return error
    return None


def _report_orphaned(
    engine: Engine,
    failures: Sequence[str | None],
    problem: str | None = None,
    lost: OSError | None = None,
) -> None:
    """Print what became of the robot: there is no other process that could.

    Args:
        problem: what had stopped the arm, if the main process was frozen by then.
        lost: why the episode's record is not complete.
    """
    before = f" (before that: {problem})" if problem else ""
    # A stop that failed at the episode's end fails again.
    trouble = "; ".join(dict.fromkeys(text for text in (engine.stop_failure, *failures) if text))
    with suppress(OSError):  # The terminal may be gone, too.
        print(
            f"fluxvla: the main process was killed{before}; {stop_outcome(trouble or None)}",
            file=sys.stderr,
        )
        if lost is not None:
            print(f"fluxvla: the record is not complete: {lost}", file=sys.stderr)


def _wait(link: Link, inbox: Inbox, engine: LocalEngine) -> None:
    """Hold the arm for a tick, or wait for an order."""
    if not engine.holding:
        time.sleep(_POLL_S)
        return
    ending: FluxError | Interrupted
    try:
        inbox.check()
    except Interrupted as signal_:
        engine.stop()
        ending = signal_
    except FluxError as error:
        engine.stop_held(error)
        ending = error
    else:
        try:
            engine.hold()
            return
        except FluxError as error:  # the arm was stopped
            ending = error
    engine.release()
    link.send(Kind.RELEASED, **error_fields(ending))


def _carry_out(
    link: Link, inbox: Inbox, engine: Engine, observer: LinkObserver, order: Message
) -> None:
    orders: Mapping[str, Callable[[], object]] = {
        Kind.CONNECT: lambda: _connect(engine),
        Kind.REARM: engine.rearm,
        Kind.RELEASE: engine.release,
        Kind.STOP: engine.stop,
        Kind.RUN_EPISODE: lambda: _run_episode(inbox, engine, observer, order),
    }
    fields: dict[str, Any]
    try:
        fields = {"result": orders[order.kind]()}
    except Interrupted as signal_:
        fields = {"signal": signal_.number}
    except BaseException as error:  # noqa: BLE001 - raised in the main process
        fields = error_fields(error)
    if order.kind == Kind.RUN_EPISODE:
        facts = dict(engine.episode_facts())
        failure, holding = engine.stop_failure, engine.holding
        fields |= {"facts": facts, "stop_failure": failure, "holding": holding}
    link.send(Kind.DONE, order=order.kind, **fields)


def _connect(engine: Engine) -> None:
    engine.connect()
    # The libraries that it imported are not to be looked through between two commands.
    gc.collect()
    gc.freeze()


def _run_episode(inbox: Inbox, engine: Engine, observer: LinkObserver, order: Message) -> None:
    inbox.phase = Phase.START
    observer.begin(Path(order["folder"]))
    try:
        task = Task(order["task"], order["instruction"], order["free"])
        engine.run_episode(task, order["number"], order["seed"], (observer,), Path(order["folder"]))
    finally:
        inbox.phase = Phase.OVER
        gc.collect()
        observer.end()


def _parts(
    link: Link,
    setup: ControlSetup,
    robot: Robot,
    execute_actions: ExecuteActions,
    inbox: Inbox,
    reporter: Reporter,
    observer: EpisodeObserver,
) -> EpisodeParts:
    patience_s = setup.settings.safety.first_chunk_s

    def make_client(
        task: Task, seed: int, tracking: TrackingWatch, emit: Callable[[Event], None]
    ) -> RemotePolicyClient:
        return RemotePolicyClient(link, inbox, robot, patience_s)

    def on_skipped(name: str) -> None:
        observer.on_event(FilterSkipped(robot.clock.now(), name))

    made = setup.make_filters(reporter)
    return EpisodeParts(
        robot=robot,
        make_client=make_client,
        filters=timed_filters(made, setup.settings.rate_hz, reporter.warn, on_skipped),
        joiner=make_joiner(*setup.joining),
        execute_actions=execute_actions,
        latch=Latch(robot.clock.now),
        interrupts=inbox,
        reporter=reporter,
        one_by_one=True,
    )


def _take_signals(inbox: Inbox) -> None:
    """Leave the terminal's signals to the main process; SIGTERM alone is for this one."""
    for name in _IGNORED:
        signal.signal(getattr(signal, name), signal.SIG_IGN)
    signal.signal(signal.SIGTERM, inbox.on_signal)
