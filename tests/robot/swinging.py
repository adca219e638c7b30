"""An arm that swings to and fro in a process of its own, started by ``fluxvla run``."""

from __future__ import annotations

import fcntl
import os
import pty
import subprocess
import sys
import termios
import time
from pathlib import Path

PLUGIN = """
import time
from pathlib import Path

import numpy as np

from fluxvla_core import (
    OPERATORS, RUNNERS, BaseInferenceRunner, Camera, EmbodimentSpec, Frame, Joint,
)

ARM = EmbodimentSpec("arm", (Joint("j", "rad", -1, 1, 2, 10),), (Camera("front", 8, 8),), 50)


@OPERATORS.register_module()
class LoggedArm:
    api = "1.0"
    embodiment = ARM

    def __init__(self, log: str, slow_stop: float = 0.0):
        self.log, self.slow_stop, self.pose = Path(log), slow_stop, np.zeros(1)

    def note(self, text):
        with self.log.open("a") as file:
            file.write(text + "\\n")

    def connect(self):
        self.note("connect")

    def get_frame(self):
        now = time.monotonic()
        return Frame(self.pose.copy(), {"front": np.zeros((8, 8, 3), np.uint8)},
                     {"state": now, "front": now})

    def send_action(self, action):
        self.pose = np.array(action)
        self.note(f"send {action[0]:.12f}")

    def stop(self):
        self.note("stop")
        time.sleep(self.slow_stop)

    def close(self):
        self.note("close")


class Swing:
    embodiment, action_rate_hz, horizon = ARM, 10.0, 5

    def __init__(self, fault):
        self.fault, self.asked = fault, 0

    def reset(self, seed):
        self.way = 1

    def predict_action(self, observation):
        self.asked += 1
        if self.asked > 5:
            exec(self.fault)
        self.way = -self.way
        return self.way * 0.1 * np.arange(1, 6)[:, None]


@RUNNERS.register_module()
class SwingRunner(BaseInferenceRunner):
    def __init__(self, fault: str = "", **kwargs):
        super().__init__(policy=Swing(fault), **kwargs)
"""
# Machines that run tests stall for a second; silence is not what is tested with this arm.
CONFIG = """
inference = dict(
    type="SwingRunner", task_descriptions={{"1": "swing to and fro"}}, record_fps=None,
    max_publish_step={steps}, fault={fault!r}, control_process={control},
    safety=dict(silence_s=5, max_age_s=5, max_skew_s=5),
    operator=dict(type="LoggedArm", log={log!r}, slow_stop={slow_stop}))
"""


class Swinging:
    """The process, and what its arm noted.

    Args:
        folder: where its files are.
        words: what else the command line says.
        slow_stop: seconds that the arm's ``stop`` takes.
        steps: commands of an episode.
        fault: what the policy does in its sixth answer and every later one, in Python.
        control: the runner's ``control_process``.
        terminal: give it a terminal of its own, with a person (``type``) at it.
    """

    def __init__(
        self,
        folder: Path,
        words: tuple[str, ...] = ("--task", "1"),
        slow_stop: float = 0.0,
        steps: int = 10000,
        terminal: bool = False,
        fault: str = "",
        control: bool | None = None,
    ) -> None:
        self.log, self.work_dir = folder / "log", folder / "work"
        (folder / "arm.py").write_text(PLUGIN)
        (folder / "cfg.py").write_text(
            CONFIG.format(
                log=str(self.log), slow_stop=slow_stop, steps=steps, fault=fault, control=control
            )
        )
        line = ["run", "--config", folder / "cfg.py", "--plugin", folder / "arm.py"]
        line += ["--work-dir", self.work_dir, *words]
        self.keyboard: int | None = None
        streams: dict[str, object] = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
        if terminal:
            self.keyboard, screen = pty.openpty()
            streams |= {"stdin": screen, "preexec_fn": lambda: _take(screen)}
        self.process = subprocess.Popen(
            [sys.executable, "-m", "fluxvla_core", *map(str, line)],
            text=True,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
            **streams,
        )
        if terminal:
            os.close(screen)

    def type(self, keys: bytes) -> None:
        """Somebody types; Ctrl-C is ``b"\\x03"``, Ctrl-D ``b"\\x04"``."""
        os.write(self.keyboard, keys)

    def hang_up(self) -> None:
        """The terminal goes away, as it does when the network does."""
        os.close(self.keyboard)
        self.keyboard = None

    def hears(self, text: str) -> str:
        """What is said up to and with the line that contains ``text``."""
        said = []
        for line in self.process.stdout:
            said.append(line)
            if text in line:
                return "".join(said)
        raise AssertionError(f"never said {text!r}, but:\n{''.join(said)}")

    def notes(self) -> list[str]:
        return self.log.read_text().splitlines() if self.log.exists() else []

    def wait_for(self, what: str, count: int) -> None:
        until = time.monotonic() + 60
        while sum(note.startswith(what) for note in self.notes()) < count:
            assert self.process.poll() is None, self.process.communicate()[0]
            assert time.monotonic() < until, "the arm never moved"
            time.sleep(0.01)

    def end(self) -> tuple[int, str]:
        output, _ = self.process.communicate(timeout=60)
        if self.keyboard is not None:
            os.close(self.keyboard)
        return self.process.returncode, output


def _take(screen: int) -> None:
    """Make ``screen`` the terminal that Ctrl-C and a hang-up come from."""
    os.setsid()
    fcntl.ioctl(screen, termios.TIOCSCTTY, 0)
