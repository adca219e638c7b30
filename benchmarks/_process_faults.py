"""What goes wrong with a robot that a process of its own commands, provoked for real.

The rows of docs/safety.md that begin with "two processes". ``fluxvla run`` is a program of its own
here, at a terminal of its own; ``play`` does something to it or to its control process once the arm
moves. What is judged is what a third process received through DDS, as in ``_robot_faults``.
"""

from __future__ import annotations

import os
import re
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks._cyclone import FAST_DDS, CycloneCamera
from benchmarks._process_program import (
    BLOCKED_S,
    COMPETING_S,
    FROZEN_S,
    PATIENCE_S,
    PROVOKED,
    SENT,
    FullSizeArm,
    PatientArm,
)
from benchmarks._robot_faults import (
    ARM,
    CAMERAS,
    GOES_ON,
    GOING_ON,
    MOVING,
    NAMES,
    STOP,
    Fault,
    Result,
    Stage,
    check_limits,
    record_of,
    resting,
    settled,
    with_overtaken,
)
from benchmarks._terminal_program import END_S, START_S, Program, program

PREFIX = "two processes: "


def play(stage: Stage, fault: Fault) -> Result:
    """Run, provoke, and see what came of it.

    Raises:
        AssertionError: a command that was received is outside a limit, or moves the arm after
            the run was over; or a process is left.
    """
    stage.folder.mkdir(parents=True, exist_ok=True)
    going_on = MOVING + GOING_ON + int(BLOCKED_S * ARM.rate_hz)
    steps = going_on if fault.outcome == GOES_ON else 10_000
    start = time.monotonic()
    with fault.around(stage), program(stage, steps) as running:
        running.wait_for(lambda: len(stage.commands()) >= MOVING, "the first command", START_S)
        with suppress(ValueError):
            # Found before the fault begins: to look at every process takes a moment.
            _ = running.control
        provoked = running.process.poll() is None
        began = time.monotonic()
        if provoked:
            provoked = _provoke(running, fault)
        running.wait_for(lambda: False, "the end", END_S)
        ended = time.monotonic()
        until = ended + END_S
        while left := running.processes():
            assert time.monotonic() < until, f"left behind: {left}\n{running.said}"
            time.sleep(0.01)
    record = record_of(stage.folder)
    commands = settled(stage)
    positions = np.array([c for _, c in commands]).reshape(-1, len(NAMES))
    sent = np.fromfile(stage.folder / SENT).reshape(-1, len(NAMES)).tolist()
    check_limits(with_overtaken(positions.tolist(), sent), halts=not fault.braked)
    note = stage.folder / PROVOKED
    if note.exists():
        began = float(note.read_text())
    elif running.ordered:
        # It ended before it did what it was told to.
        provoked = False
    trips = (record or {}).get("trips", [])
    if trips and trips[0]["at"] < began:
        # A machine that stalls stopped the arm before the fault began, rightly.
        provoked = False
    hold, late = None, None
    if fault.outcome == STOP and provoked:
        hold = max(commands[-resting(positions)][0] - began, 0.0)
        moving = commands[: len(commands) - resting(positions) + 1]
        late = sum(at > began for at, _ in moving)
    code = running.process.returncode
    as_ever = fault.outcome == GOES_ON and code == 0
    said = "" if as_ever else _cause(fault, running.said, record)
    return Result(hold, said, ended - start, code, record, positions, provoked, late)


def _provoke(running: Program, fault: Fault) -> bool:
    """Whether the fault came about: a program that has ended meanwhile suffers none.

    Raises:
        AssertionError: it could not be provoked, although the program goes on.
    """
    try:
        return fault.provoke(running) is not False
    except (OSError, ValueError) as error:
        running.wait_for(lambda: False, f"the end, after {error!r},", END_S)
        return False


def _cause(fault: Fault, said: str, record: Mapping[str, Any] | None) -> str:
    """The line that names it, of the terminal or, where that is gone, of the record; else all that
    was said, but for the task."""
    lines = [line.strip() for line in [*said.splitlines(), str((record or {}).get("problem", ""))]]
    named = [line for line in lines if fault.says and fault.matches(line)]
    rest = [line for line in lines if line and not line.startswith("task: ")]
    return named[0] if named else "\n".join(rest)


def order(harm: str) -> Callable[[Program], None]:
    """The program does one of ``HARMS`` to itself."""
    return lambda running: running.order(harm)


def send(*numbers: signal.Signals) -> Callable[[Program], None]:
    """Somebody sends signals to the main process."""

    def provoke(running: Program) -> None:
        for number in numbers:
            running.process.send_signal(number)

    return provoke


def to_control(number: signal.Signals) -> Callable[[Program], None]:
    """Somebody sends a signal to the control process."""
    return lambda running: os.kill(running.control, number)


def typed(*keys: str) -> Callable[[Program], None]:
    """Somebody types, at the speed of a person."""

    def provoke(running: Program) -> None:
        for key in keys:
            running.type(key)
            time.sleep(0.03)

    return provoke


def ctrl_c_in_a_hook(running: Program) -> bool:
    note = running.stage.folder / PROVOKED
    running.order("hook blocks")
    running.wait_for(note.exists, "the hook", END_S)
    if not note.exists():
        return False
    note.write_text(str(time.monotonic()))
    running.type("\x03")
    return True


def pause(running: Program) -> None:
    running.process.send_signal(signal.SIGSTOP)
    running.wait_for(running.at_rest, "coming to rest", END_S)
    running.process.send_signal(signal.SIGCONT)


@contextmanager
def patient(stage: Stage) -> Iterator[None]:
    """Machines that run tests stall for a second; where the run is to go on, that is forgiven."""
    stage.arm = PatientArm.__name__
    stage.safety = dict.fromkeys(("silence_s", "max_age_s", "max_skew_s", "starvation_s"), 3.0)
    yield


def cyclone_driver(stage: Stage) -> CycloneCamera:
    """Before the run: cameras of 640x480 and a second driver of theirs, on Cyclone DDS."""
    stage.arm = FullSizeArm.__name__
    # A machine that busy lets the main process wait, too; only a freeze lasts this long.
    stage.safety = {
        "silence_s": FROZEN_S,
        **dict.fromkeys(("max_age_s", "max_skew_s", "starvation_s"), PATIENCE_S),
    }
    stage.robot.tell(change={topic: {"height": 480, "width": 640, "hz": 10} for topic in CAMERAS})
    camera = CycloneCamera(*CAMERAS, height=480, width=640, hz=30)
    stage.more.append(camera)
    return camera


def cyclone_images(running: Program) -> bool:
    """While the main process has little time, Fast DDS soon spins in ``rcl_take`` on an image of
    Cyclone's and keeps the GIL; only SIGKILL ends that process.

    Returns:
        Whether it froze.
    """
    note = running.stage.folder / PROVOKED
    running.order("compete for the processors")
    running.wait_for(lambda: note.exists() and note.stat().st_size, "competing", END_S)
    (camera,) = running.stage.more
    camera.start()
    until = time.monotonic() + COMPETING_S

    def silent() -> bool:
        return time.monotonic() - float(note.read_text()) > 2 * FROZEN_S

    running.wait_for(lambda: silent() or time.monotonic() > until, "freezing", END_S)
    running.process.kill()
    # It may have been kept waiting by the others, and was not frozen.
    until = time.monotonic() + END_S
    while MAIN_KILLED not in running.said and time.monotonic() < until:
        time.sleep(0.01)
    return re.search(FROZEN, running.said) is not None


def kill_both(running: Program) -> None:
    control = running.control
    running.process.kill()
    os.kill(control, signal.SIGKILL)


MAIN = "main process"
LOCKED = r"the main process did not run for \d+\.\d+ s"
MAIN_KILLED = "fluxvla: the main process was killed"
FROZEN = rf"{MAIN_KILLED} \(before that: the main process did not run for \d+\.\d+ s.*"
KILLED = f"{MAIN_KILLED}; the robot was stopped"
CONTROL = "control process"
# ``halts``: what is received ends in the middle of a motion, at the last command.
_FAULTS = [
    Fault(
        "policy holds the GIL for 5 s",
        order("keep the interpreter"),
        LOCKED,
        rule=MAIN,
    ),
    Fault("image callback spins for 5 s", order("image callback spins"), LOCKED, rule=MAIN),
    Fault("policy crashes (segmentation fault)", order("crash"), KILLED, exit_code=-signal.SIGSEGV),
    Fault(
        "policy uses all memory",
        order("use all memory"),
        "the policy raised MemoryError",
        rule="policy",
    ),
    Fault("main process paused (SIGSTOP)", pause, LOCKED, rule=MAIN),
    Fault(
        "main process killed (SIGKILL, or the kernel is out of memory)",
        send(signal.SIGKILL),
        KILLED,
        exit_code=-signal.SIGKILL,
    ),
    Fault(
        "control process killed (SIGKILL)",
        to_control(signal.SIGKILL),
        "the control process was killed by SIGKILL: nothing commands the robot any more",
        rule=CONTROL,
        braked=False,
    ),
    Fault(
        "control process paused (SIGSTOP)",
        to_control(signal.SIGSTOP),
        r"the control process did not run for \d+\.\d s and was killed",
        rule=CONTROL,
        braked=False,
    ),
    Fault("control process ended (SIGTERM)", to_control(signal.SIGTERM), "stopped by SIGTERM"),
    Fault("both killed (SIGKILL)", kill_both, exit_code=-signal.SIGKILL, braked=False),
    Fault(
        "shared memory full",
        order("link is not read"),
        r"waits for a chunk.*: the main process took \d",
        rule="starvation",
    ),
    Fault(
        "thread that reads shared memory ends",
        order("link's thread ends"),
        "the control process stopped responding to this process and was ended",
        rule=CONTROL,
    ),
    Fault("Ctrl-C", typed("\x03"), "stopped by Ctrl-C", exit_code=130),
    Fault("second Ctrl-C", typed("\x03", "\x03"), "stopped by Ctrl-C", exit_code=130),
    Fault("Ctrl-C while a hook blocks", ctrl_c_in_a_hook, "stopped by Ctrl-C", exit_code=130),
    Fault("Ctrl-\\ (SIGQUIT)", typed("\x1c"), "stopped by SIGQUIT"),
    Fault("SIGTERM", send(signal.SIGTERM), "stopped by SIGTERM"),
    Fault("terminal closed (SIGHUP)", Program.hang_up, "stopped by SIGHUP"),
    Fault(
        "hook blocks for 5 s",
        order("hook blocks"),
        outcome=GOES_ON,
        exit_code=0,
        around=patient,
    ),
]
PROCESS_FAULTS = tuple(replace(fault, name=PREFIX + fault.name) for fault in _FAULTS)
# Provoked every night: it takes ten busy processes, and comes about by chance.
CYCLONE_FAULT = Fault(
    f"{PREFIX}image reception frozen (reliable images from Cyclone DDS)",
    cyclone_images,
    FROZEN,
    around=cyclone_driver,
    environment=FAST_DDS,
    attempts=20,
    exit_code=-signal.SIGKILL,
)
