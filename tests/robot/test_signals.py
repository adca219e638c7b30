"""Ctrl-C and SIGTERM while an arm moves, in a process of its own, through the command line."""

from __future__ import annotations

import itertools
import json
import re
import signal
import subprocess
import sys
import time
from collections import Counter

import pytest

from tests.robot.swinging import CONFIG, PLUGIN, Swinging

pytestmark = pytest.mark.realtime


def assert_stopped_within_limits(notes):
    path = [0.0, 0.0, *(float(note.split()[1]) for note in notes if note.startswith("send"))]
    speeds = [(b - a) * 50 for a, b in itertools.pairwise(path)]
    pushes = [abs(b - a) * 50 for a, b in itertools.pairwise(speeds)]
    assert max(pushes) <= 10
    assert abs(speeds[-1]) <= 10 / 50


@pytest.mark.parametrize("control", [True, False], ids=["two processes", "one process"])
@pytest.mark.parametrize(
    ("number", "code", "said"),
    [
        (signal.SIGINT, 130, "interrupted: stopped by Ctrl-C; the robot was stopped"),
        (signal.SIGTERM, 1, "stopped by SIGTERM; the robot was stopped"),
        (signal.SIGQUIT, 1, "stopped by SIGQUIT; the robot was stopped"),
        (signal.SIGTSTP, 1, "stopped by SIGTSTP; the robot was stopped"),
    ],
)
def test_a_signal_stops_the_arm_within_its_limits(tmp_path, number, code, said, control):
    arm = Swinging(tmp_path, control=control)
    arm.wait_for("send", 40)
    arm.process.send_signal(number)

    returned, output = arm.end()

    assert returned == code, output
    assert said in output
    assert "Traceback" not in output
    notes = arm.notes()
    assert notes[-3:] == ["stop", "stop", "close"]
    assert_stopped_within_limits(notes)
    episode = json.loads((arm.work_dir / "inference" / "001-1" / "episode.json").read_text())
    assert episode["outcome"] == "interrupted"
    assert episode["problem"] == f"stopped by {number.name}"


def test_a_policy_that_ends_the_program_is_held_and_told(tmp_path):
    arm = Swinging(tmp_path, fault="raise SystemExit(0)")

    returned, output = arm.end()

    assert returned == 1, output
    assert "the policy raised SystemExit: 0" in output
    assert "Traceback" not in output
    notes = arm.notes()
    assert notes[-3:] == ["stop", "stop", "close"]
    assert_stopped_within_limits(notes)


@pytest.mark.parametrize(
    ("fault", "code"),
    [
        ("", 0),
        ("raise SystemExit(0)", 1),
        ("raise ValueError('lost')", 1),
        ("self.way = float('nan')", 1),
    ],
)
def test_no_line_is_said_twice(tmp_path, fault, code):
    """By the run, which reports what it does, and by the command line, which reports errors."""
    returned, output = Swinging(tmp_path, steps=250, fault=fault).end()
    assert returned == code, output
    assert (code == 0) == ("max_steps" in output)
    said = [re.sub(r"^\[ *[\d.]+s\] ", "", line) for line in output.splitlines()]
    said = [line for line in said if not re.match(r"(task 1: |… )?(commands \d|working)", line)]
    assert len(said) > 1
    assert [line for line, count in Counter(said).items() if count > 1] == []


def test_a_second_ctrl_c_does_not_cut_the_stop_short(tmp_path):
    arm = Swinging(tmp_path, slow_stop=3.0)
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
    config.write_text(
        CONFIG.format(log=str(tmp_path / "log"), slow_stop=0, steps=100, fault="", control=None)
    )
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


def test_a_process_that_was_paused_does_not_blame_its_policy(tmp_path):
    think = tmp_path / "thinks"
    # A sleep in which the process is paused may be over when it goes on; the second is not.
    fault = f"open({str(think)!r}, 'w').close(); time.sleep(0.9); time.sleep(0.9)"
    arm = Swinging(tmp_path, fault=fault, control=False)
    arm.wait_for("send", 40)
    think.unlink(missing_ok=True)
    until = time.monotonic() + 60
    while not think.exists():
        assert time.monotonic() < until, "the policy is not asked any more"
        time.sleep(0.01)
    arm.process.send_signal(signal.SIGSTOP)
    time.sleep(2.5)
    arm.process.send_signal(signal.SIGCONT)

    returned, output = arm.end()

    assert returned == 1, output
    assert re.search(r"safety.starvation_s is 2: this machine took \d+\.\d+ s of that", output)
    assert arm.notes()[-3:] == ["stop", "stop", "close"]
