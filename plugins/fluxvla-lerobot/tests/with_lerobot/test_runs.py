"""The README's configuration: an evaluation and a robot, both in the simulated ALOHA."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import pytest

pytest.importorskip(
    "lerobot", reason="needs LeRobot: test_in_lerobots_environment.py runs this in its environment"
)

import numpy as np

from fluxvla_core import build_operator_from_cfg
from fluxvla_core.cli.main import main

from .tiny import save

README = Path(__file__).parents[2] / "README.md"
OPERATOR = {"type": "AlohaSimOperator", "camera_names": ("top",), "height": 96, "width": 128}
RUN = re.compile(r"^    (fluxvla run --config .*)$", re.MULTILINE)


@pytest.fixture
def place(tmp_path, monkeypatch):
    """The README's config, its robot, and two policies that hardly leave the home pose."""
    operator = build_operator_from_cfg(OPERATOR)
    operator.connect()
    home = operator.get_frame().state
    robot = operator.embodiment
    operator.close()
    (tmp_path / "data" / "meta").mkdir(parents=True)
    described = tmp_path / "data" / "meta" / "fluxvla_embodiment.json"
    described.write_text(json.dumps(robot.to_dict()))
    view = {"cameras": ("cam_high",), "joints": 14, "size": (96, 128)}
    near = {"mean": np.float32(home), "spread": 0.01}
    save(tmp_path / "act", "act", chunk_size=20, n_action_steps=10, **view, **near)
    save(tmp_path / "diffusion", "diffusion", n_obs_steps=2, **view, **near)
    text = README.read_text()
    (tmp_path / "acting.py").write_text(text.partition("```python\n")[2].partition("```")[0])
    monkeypatch.chdir(tmp_path)
    return tmp_path


def readmes(section):
    """The command of the README that runs a section, without the program's name."""
    (line,) = [line for line in RUN.findall(README.read_text()) if f"--section {section}" in line]
    return shlex.split(line)[1:]


def test_an_evaluation(place, capfd):
    assert main(readmes("eval")) == 0
    found = json.loads((place / "work" / "eval" / "results.json").read_text())
    task = found["groups"]["policy"]["tasks"]["transfer_cube"]
    assert (task["episodes"], task["errors"]) == (1, 0)
    assert "Loading weights" not in capfd.readouterr().out  # LeRobot's; what is printed is ours


def test_a_robot(place, capfd):
    assert main(readmes("inference")) == 0
    said = capfd.readouterr()
    text = said.out + said.err
    assert "LeRobot executes 10 of 20 actions: execute_horizon = 10 does so" in text
    assert re.search(r"outcome: +max_steps", text), text
    assert re.search(r"steps: +30", text), text


def test_a_robot_by_a_policy_that_looks_at_two_observations(place, capfd):
    """It is asked at each step, and the arm waits for it."""
    options = ["--set", "inference.policy.path=diffusion", "--set", "inference.execute_horizon=1"]
    assert main([*readmes("inference"), *options]) == 0
    said = capfd.readouterr()
    assert re.search(r"steps: +30", said.out + said.err), said.out + said.err


def test_a_robot_needs_to_know_robot_and_rate(place, capfd):
    for key, words in (("embodiment", "no EmbodimentSpec"), ("rate_hz", "must be positive")):
        text = (place / "acting.py").read_text()
        lines = [line for line in text.splitlines() if not line.strip().startswith(f"{key}=")]
        (place / "less.py").write_text("\n".join(lines))
        options = ["run", "--config", "less.py", "--section", "inference", "--task", "1"]
        assert main([*options, "--work-dir", "work"]) == 2
        assert words in capfd.readouterr().err


def test_another_robot_is_refused_before_the_episode(place, capfd):
    robot = json.loads((place / "data" / "meta" / "fluxvla_embodiment.json").read_text())
    robot["joints"][0]["name"] = "torso"
    (place / "other.json").write_text(json.dumps(robot))
    options = ["--set", "eval.policy.embodiment=other.json"]
    assert main([*readmes("eval"), *options]) == 2
    err = capfd.readouterr().err
    assert "do not fit together" in err
    assert "torso" in err
