"""``ControlProcess``: the control process as the main process has it: started, watched, ended.

``stop_through_new_connection`` stops a robot whose control process is lost.
"""

from __future__ import annotations

import os
import queue
import subprocess
import sys
import threading

from fluxvla_core.contracts.runner import Reporter
from fluxvla_core.control.interrupt import Interrupts
from fluxvla_core.control.safety import Rule
from fluxvla_core.errors import RunFailed, SafetyStop
from fluxvla_core.robot.events import Phase
from fluxvla_core.robot.process.frames import FrameMemory
from fluxvla_core.robot.process.link import Link, SilenceWatch, make_memory
from fluxvla_core.robot.process.link_server import LinkServer
from fluxvla_core.robot.process.messages import Kind, Message
from fluxvla_core.robot.process.remote_operator import RemoteOperator
from fluxvla_core.robot.process.setup import ControlSetup
from fluxvla_core.robot.robot import STOP_S, Robot
from fluxvla_core.signals import signal_name

_POOLS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
# Without the folder that it is started in: modules are found where this process finds them.
_COMMAND = (sys.executable, *(("-P",) if sys.version_info >= (3, 11) else ()), "-m", __package__)

HUNG_S = 1.0
"""For how long the control process may not run before it is given up."""
# Two looks this far apart: this process did not run either.
_PAUSED_S = 0.25
END_S = 2 * STOP_S + 1.0
"""For how long a connection that is only made to stop the robot, or an orderly end, may take."""


class ControlProcessGone(SafetyStop):
    """The control process is dead, or hangs."""

    rule = Rule.CONTROL_PROCESS


class ControlProcess:
    """A control process: started by the constructor, watched whenever a message is received.

    Args:
        setup: what it is built from.
        robot: reads the cameras in this process.
        interrupts: signals; passed on.
        remote_operator: the stand-in for an operator that runs as a whole in the other process.

    Attributes:
        link: to it.
        server: this process's thread that answers it.
        holding: whether it holds the arm between two episodes.
        ended: whether it is dead; ``link`` and ``server`` are closed then.

    Raises:
        RunFailed: this machine has no room for it.
    """

    def __init__(
        self,
        setup: ControlSetup,
        robot: Robot,
        interrupts: Interrupts,
        remote_operator: RemoteOperator | None,
    ) -> None:
        self._interrupts, self._remote_operator = interrupts, remote_operator
        try:
            frame_memory = None
            if remote_operator is not None:
                frame_memory = remote_operator.open(setup.cameras or ())
            self._process, self.link = launch(setup, frame_memory)
        except OSError as error:
            raise RunFailed(
                f"the control process could not be started: {error}",
                cause="this machine has no memory or no process to spare",
            ) from error
        self.server = LinkServer(self.link, robot, interrupts)
        self.holding = self.ended = False
        self._lost = 0
        self._silence = SilenceWatch(self.link, _PAUSED_S)

    @property
    def pid(self) -> int:
        """Its number in the system."""
        return self._process.pid

    def receive(self, timeout_s: float) -> Message | None:
        """The next message; None if none comes in time.

        Raises:
            ControlProcessGone: it does not run; it is dead by now.
        """
        self._check_alive()
        try:
            return self.server.messages.get(timeout=timeout_s)
        except queue.Empty:
            return None

    def newly_lost(self) -> int:
        """How many messages, since this was called last, did not fit into the link."""
        lost, self._lost = self.link.lost - self._lost, self.link.lost
        return lost

    def end(self, patience_s: float) -> str | None:
        """Have it stop the robot, disconnect and end; what went wrong."""
        self.link.send(Kind.CLOSE)
        failures: list[str] = []
        try:
            self._process.wait(patience_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            failures = ["the control process did not end: use the robot's emergency stop"]
        self._clean_up()
        while not self.server.messages.empty():
            message = self.server.messages.get()
            if message.kind == Kind.CLOSED:
                failures += [failure for failure in message["failures"] if failure]
        return "; ".join(failures) or None

    def _check_alive(self) -> None:
        code = self._process.poll()
        if code is not None and self.server.messages.empty():
            ended = f"ended with exit code {code}"
            raise self._gone(ended if code >= 0 else f"was killed by {signal_name(-code)}")
        if code is None and not self.server.alive:
            self.link.send(Kind.CLOSE)
            try:
                self._process.wait(END_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
            raise self._gone("stopped responding to this process and was ended")
        patience_s, silent_s = self._patience_s(), self._silence.silent_s()
        if code is None and patience_s is not None and silent_s > patience_s:
            self._process.kill()
            raise self._gone(f"did not run for {silent_s:.1f} s and was killed")

    def _patience_s(self) -> float | None:
        """How long it may not run; None while it waits for the operator."""
        if self.server.client is None:
            return HUNG_S if self.holding else None
        phase = self.server.phase
        if phase.stoppable:
            return HUNG_S
        if phase in (Phase.HOLD, Phase.STOP):
            # It may be in the operator's own stop.
            return HUNG_S + STOP_S
        # The robot is being prepared, perhaps by a simulation that puts its objects in place.
        return HUNG_S + STOP_S if self._interrupts.stopping else None

    def _gone(self, how: str) -> ControlProcessGone:
        self._clean_up()
        return ControlProcessGone(
            f"the control process {how}: nothing commands the robot any more",
            cause="somebody, or the system, ended it, or the robot's driver crashed it",
            next="look at the robot; docs/control.md says what each robot does by itself then",
        )

    def _clean_up(self) -> None:
        """End the thread of the link, after what the process sent last."""
        self._process.wait()
        self.ended = True
        self.server.close()
        if self._remote_operator is not None:
            self._remote_operator.close()


def launch(
    setup: ControlSetup, frame_memory: FrameMemory | None = None
) -> tuple[subprocess.Popen[bytes], Link]:
    """Start a control process; it, and this process's end of the memory that both share.

    Args:
        setup: what it is built from.
        frame_memory: for the images of an operator that runs there as a whole; remains open.

    Raises:
        OSError: the system has no room for it.
    """
    memory = make_memory()
    reads, writes = os.pipe()
    try:
        link = Link(memory, control=False)
        process = subprocess.Popen(
            [*_COMMAND, *map(str, (memory, reads, *(frame_memory or ())))],
            pass_fds=(memory, reads, *(frame_memory or ())),
            # A thread with a real-time priority must not wait for others of a pool.
            env={**dict.fromkeys(_POOLS, "1"), **os.environ},
            stdin=subprocess.DEVNULL,
            # Ctrl-C, and a terminal that closes, are for this process alone.
            start_new_session=True,
        )
    finally:
        os.close(memory)
        os.close(reads)
    with os.fdopen(writes, "w", encoding="utf-8") as pipe:
        pipe.write(setup.to_json())
    return process, link


def stop_through_new_connection(
    setup: ControlSetup, reporter: Reporter, patience_s: float
) -> str | None:
    """The operator's own stop, through a fresh connection; what went wrong with it.

    Args:
        setup: of the control process that is lost.
        reporter: of the run.
        patience_s: how long it may take.
    """
    found = ["no connection to the robot was made in time: use its emergency stop"]

    def stop() -> None:
        try:
            robot = setup.make_robot(reporter)
            robot.connect()
            failures = [robot.stop(), robot.close()]
            if not robot.can_stop:
                failures = [f"{robot.name} has no stop(): use the robot's emergency stop"]
            found[:] = [text for text in failures if text]
        except (Exception, SystemExit) as error:  # noqa: BLE001 - reported by the caller
            found[:] = [f"the robot could not be stopped through a fresh connection: {error}"]

    thread = threading.Thread(target=stop, name="fluxvla-stop-again", daemon=True)
    thread.start()
    thread.join(patience_s)
    return "; ".join(found) or None
