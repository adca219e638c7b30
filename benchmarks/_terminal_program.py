"""``fluxvla run`` as a program of its own, at a terminal of its own, which commands an arm."""

from __future__ import annotations

import fcntl
import os
import pty
import select
import signal
import struct
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cached_property
from itertools import pairwise
from pathlib import Path

from benchmarks._process_program import SENT
from benchmarks._robot_faults import Stage

ROOT = Path(__file__).resolve().parents[1]
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


def _all_processes() -> list[int]:
    return [int(path.name) for path in Path("/proc").iterdir() if path.name.isdigit()]


def _environment(pid: int) -> bytes:
    """Of a process; nothing of one that ended, or is another user's."""
    try:
        return Path(f"/proc/{pid}/environ").read_bytes()
    except OSError:
        return b""
