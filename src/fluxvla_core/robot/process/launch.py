"""Starting the control process, and stopping a robot whose control process is lost."""

from __future__ import annotations

import os
import subprocess
import sys
import threading

from fluxvla_core.contracts.reporter import Reporter
from fluxvla_core.errors import SafetyStop
from fluxvla_core.robot.control.safety import Rule
from fluxvla_core.robot.process.frames import FrameMemory
from fluxvla_core.robot.process.link import Link, make_memory
from fluxvla_core.robot.process.setup import ControlSetup

# Without the folder that it is started in: modules are found where this process finds them.
_COMMAND = (sys.executable, *(("-P",) if sys.version_info >= (3, 11) else ()), "-m", __package__)


class ControlProcessGone(SafetyStop):
    """The control process is dead, or hangs."""

    rule = Rule.CONTROL_PROCESS


def launch(
    setup: ControlSetup, frames: FrameMemory | None = None
) -> tuple[subprocess.Popen[bytes], Link]:
    """Start a control process; it, and this process's end of the memory that both share.

    Args:
        setup: what it is built from.
        frames: for the images of an operator that runs there as a whole; remains open.

    Raises:
        OSError: the system has no room for it.
    """
    memory = make_memory()
    reads, writes = os.pipe()
    try:
        link = Link(memory, control=False)
        process = subprocess.Popen(
            [*_COMMAND, *map(str, (memory, reads, *(frames or ())))],
            pass_fds=(memory, reads, *(frames or ())),
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
