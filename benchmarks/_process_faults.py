"""What goes wrong with a robot that a process of its own commands, provoked for real.

The rows of docs/safety.md that begin with "two processes". ``fluxvla run`` is a program of its own
here, at a terminal of its own; ``play`` does something to it or to its control process once the arm
moves. What is judged is what a third process received through DDS, as in ``_robot_faults``.
"""

from __future__ import annotations

import fcntl
import os
import pty
import re
import select
import signal
import struct
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
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

ROOT = Path(__file__).resolve().parents[1]
PREFIX = "two processes: "
# Found in the environment of every process that the program starts, whatever becomes of it.
MARK = "FLUXVLA_FAULT"
PLUGIN = "import benchmarks._process_program\n"
CONFIG = """
hooks = ["BlockingHook"]
inference = dict(
    type="ProgramRunner", task_descriptions={{"1": "swing"}}, async_execution=True,
    record_fps=None, max_publish_step={steps}, control_process=True, safety={safety},
    operator=dict(type={arm!r}, folder={folder!r}),
    policy=dict(type="HarmfulSwing", folder={folder!r}, orders={orders}))
"""
START_S, END_S = 120.0, 60.0


class Program:
    """``fluxvla run``, and the terminal that it runs at.

    Args:
        stage: who else takes part.
        steps: commands of an episode.
        words: what else the command line says.
        plugin: Python that it imports.
    """

    def __init__(self, stage: Stage, steps: int, words: Sequence[str], plugin: str) -> None:
        self.stage, folder = stage, stage.folder
        folder.mkdir(parents=True, exist_ok=True)
        (folder / SENT).touch()
        (folder / "program.py").write_text(plugin)
        reads, writes = os.pipe()
        self._orders = os.fdopen(writes, "w", encoding="utf-8", buffering=1)
        self.ordered = False
        config = CONFIG.format(
            steps=steps, folder=str(folder), orders=reads, arm=stage.arm, safety=stage.safety
        )
        (folder / "cfg.py").write_text(config)
        line = ["run", "--config", folder / "cfg.py", "--plugin", folder / "program.py"]
        line += ["--work-dir", folder, *words]
        self._keyboard, screen = pty.openpty()
        # Wide, so that no message is wrapped.
        fcntl.ioctl(screen, termios.TIOCSWINSZ, struct.pack("HHHH", 50, 1000, 0, 0))
        self._mark = f"{MARK}={os.getpid()}-{time.monotonic_ns()}"
        name, _, value = self._mark.partition("=")
        self.process = subprocess.Popen(
            [sys.executable, "-m", "fluxvla_core", *map(str, line)],
            cwd=ROOT,
            env={
                **os.environ,
                "OMP_NUM_THREADS": "1",
                "TERM": "dumb",
                name: value,
            },
            pass_fds=(reads,),
            stdin=screen,
            stdout=screen,
            stderr=screen,
            start_new_session=True,
            preexec_fn=_own_terminal,
        )
        os.close(screen)
        os.close(reads)
        self._said = bytearray()
        self._gone = threading.Event()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    @cached_property
    def control(self) -> int:
        """The process id of the control process.

        Raises:
            ValueError: there is none, as after the end of the run.
        """
        (found,) = (pid for pid in self.processes() if pid != self.process.pid)
        return found

    def processes(self) -> list[int]:
        """Every process of this program that still runs."""
        return [pid for pid in _all_processes() if self._mark.encode() in _environment(pid)]

    def type(self, keys: str) -> None:
        """Somebody types."""
        os.write(self._keyboard, keys.encode())

    def order(self, harm: str) -> None:
        """The program does one of ``HARMS`` to itself."""
        self.ordered = True
        self._orders.write(f"{harm}\n")

    def close(self) -> None:
        """Give back what is open."""
        with suppress(BrokenPipeError):
            self._orders.close()

    def hang_up(self) -> None:
        """The terminal goes away, as it does with the network that a person is logged in through;
        and with it whatever is said from now on."""
        if not self._gone.is_set():
            self._gone.set()
            self._reader.join()
            os.close(self._keyboard)

    @property
    def said(self) -> str:
        """What stands on the terminal."""
        return self._said.decode(errors="replace").replace("\r", "")

    def wait_for(self, condition: Callable[[], object], what: str, seconds: float) -> None:
        """Until ``condition``, or the end of the program.

        Raises:
            AssertionError: neither came.
        """
        until = time.monotonic() + seconds
        while not condition() and self.process.poll() is None:
            assert time.monotonic() < until, f"{what} took longer than {seconds:g} s\n{self.said}"
            time.sleep(0.005)

    def at_rest(self) -> bool:
        """Whether nothing that was received in the last second moves the arm."""
        commands = self.stage.commands()
        moved = [at for (_, one), (at, other) in pairwise(commands) if one != other]
        return time.monotonic() - moved[-1] > 1.0

    def _read(self) -> None:
        while not self._gone.is_set():
            if select.select([self._keyboard], [], [], 0.05)[0]:
                try:
                    self._said += os.read(self._keyboard, 65536)
                except OSError:  # nobody has the other end any more
                    return


def _own_terminal() -> None:
    """In the new process: its input is its terminal, whose signals reach it.

    Also where this process was started by nohup or in the background of a script.
    """
    fcntl.ioctl(0, termios.TIOCSCTTY, 0)
    for number in (signal.SIGHUP, signal.SIGINT, signal.SIGQUIT, signal.SIGTSTP):
        signal.signal(number, signal.SIG_DFL)


@contextmanager
def program(
    stage: Stage,
    steps: int = 10_000,
    words: Sequence[str] = ("--task", "1"),
    plugin: str = PLUGIN,
) -> Iterator[Program]:
    """A program that drives the arm; what is left of it at the end is killed."""
    made = Program(stage, steps, words, plugin)
    try:
        yield made
    finally:
        for pid in made.processes():
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        made.process.wait()
        made.hang_up()
        made.close()


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


def _all_processes() -> list[int]:
    return [int(path.name) for path in Path("/proc").iterdir() if path.name.isdigit()]


def _environment(pid: int) -> bytes:
    """Of a process; nothing of one that ended, or is another user's."""
    try:
        return Path(f"/proc/{pid}/environ").read_bytes()
    except OSError:
        return b""


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
