"""Ctrl-C and SIGTERM while an arm moves, in a process of its own, through the command line."""

from __future__ import annotations

import itertools
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytestmark = pytest.mark.realtime
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

    def reset(self, seed):
        self.way = 1

    def predict_action(self, observation):
        self.way = -self.way
        return self.way * 0.1 * np.arange(1, 6)[:, None]


@RUNNERS.register_module()
class SwingRunner(BaseInferenceRunner):
    def __init__(self, **kwargs):
        super().__init__(policy=Swing(), **kwargs)
"""
CONFIG = """
inference = dict(
    type="SwingRunner", task_descriptions={{"1": "swing to and fro"}}, record_fps=None,
    operator=dict(type="LoggedArm", log={log!r}, slow_stop={slow_stop}))
"""


class Swinging:
    """The process, and what its arm noted."""

    def __init__(self, folder: Path, slow_stop: float = 0.0) -> None:
        self.log, self.work_dir = folder / "log", folder / "work"
        (folder / "arm.py").write_text(PLUGIN)
        (folder / "cfg.py").write_text(CONFIG.format(log=str(self.log), slow_stop=slow_stop))
        words = ["run", "--config", folder / "cfg.py", "--plugin", folder / "arm.py"]
        words += ["--work-dir", self.work_dir, "--task", "1"]
        self.process = subprocess.Popen(
            [sys.executable, "-m", "fluxvla_core", *map(str, words)],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
        )

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
        return self.process.returncode, output


@pytest.mark.parametrize(
    ("number", "code", "said"),
    [
        (signal.SIGINT, 130, "interrupted: stopped by Ctrl-C; the robot was stopped"),
        (signal.SIGTERM, 1, "stopped by SIGTERM; the robot was stopped"),
    ],
)
def test_a_signal_stops_the_arm_within_its_limits(tmp_path, number, code, said):
    arm = Swinging(tmp_path)
    arm.wait_for("send", 40)
    arm.process.send_signal(number)

    returned, output = arm.end()

    assert returned == code, output
    assert said in output
    assert "Traceback" not in output
    notes = arm.notes()
    assert notes[-3:] == ["stop", "stop", "close"]
    path = [0.0, 0.0, *(float(note.split()[1]) for note in notes if note.startswith("send"))]
    speeds = [(b - a) * 50 for a, b in itertools.pairwise(path)]
    pushes = [abs(b - a) * 50 for a, b in itertools.pairwise(speeds)]
    assert max(pushes) <= 10
    assert abs(speeds[-1]) <= 10 / 50
    episode = json.loads((arm.work_dir / "inference" / "001-1" / "episode.json").read_text())
    assert episode["outcome"] == "interrupted"
    assert episode["problem"] == f"stopped by {number.name}"


def test_a_second_ctrl_c_does_not_cut_the_stop_short(tmp_path):
    arm = Swinging(tmp_path, slow_stop=0.5)
    arm.wait_for("send", 40)
    arm.process.send_signal(signal.SIGINT)
    arm.wait_for("stop", 1)
    arm.process.send_signal(signal.SIGINT)
    arm.process.send_signal(signal.SIGTERM)

    returned, output = arm.end()

    assert returned == 130, output
    assert arm.notes()[-3:] == ["stop", "stop", "close"]
    assert (arm.work_dir / "inference" / "001-1" / "episode.json").exists()


def test_a_typing_error_in_the_task_ends_with_2_and_moves_nothing(tmp_path):
    (tmp_path / "arm.py").write_text(PLUGIN)
    config = tmp_path / "cfg.py"
    config.write_text(CONFIG.format(log=str(tmp_path / "log"), slow_stop=0))
    words = ["run", "--config", str(config), "--plugin", str(tmp_path / "arm.py"), "--task", "3"]

    done = subprocess.run(
        [sys.executable, "-m", "fluxvla_core", *words, "--work-dir", str(tmp_path / "work")],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )

    assert done.returncode == 2
    assert "unknown task '3'; nothing was moved" in done.stderr
    assert "1: swing to and fro" in done.stderr
    assert not (tmp_path / "log").exists()
