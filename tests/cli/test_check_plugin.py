"""``fluxvla plugins check``: the kit of one class, without pytest to be seen."""

from __future__ import annotations

import importlib.util
import os
import pty
import subprocess
import sys
import time
from pathlib import Path

import pytest

from fluxvla_core.cli.check_plugin import EVALUATES, KITS, TRAINS
from fluxvla_core.registries import REGISTRIES

from .conftest import Fluxvla

ARM = """
import time
import numpy as np
from fluxvla_core import OPERATORS, RUNNERS, EmbodimentSpec, Frame, Joint, Operator
from fluxvla_core.errors import NotReady, Rejected
from fluxvla_core.testing import OperatorConformance

SPEC = EmbodimentSpec("arm", tuple(Joint(n, "rad", -1, 1, 2, 8) for n in "ab"), (), rate_hz=50)

@OPERATORS.register_module()
class CheckedOperator(Operator):
    api = "1.0"
    def __init__(self, factor: float = 1.0):
        self.factor, self.place = factor, None
    @property
    def embodiment(self):
        return SPEC
    def connect(self):
        self.place = np.zeros(2)
    def get_frame(self):
        if self.place is None:
            raise NotReady("not connected")
        return Frame(self.factor * self.place, {}, {"state": time.monotonic()})
    def send_action(self, action):
        if self.place is None:
            raise NotReady("not connected")
        if np.shape(action) != (2,) or not np.isfinite(action).all() or (abs(action) > 1).any():
            raise Rejected("out of spec")
        self.place = np.array(action)
    def stop(self):
        pass
    def close(self):
        self.place = None

@RUNNERS.register_module()
class CheckedTrainRunner:
    def run_setup(self, n_train_examples): ...
    def run(self, dataset): ...

class TestOther(OperatorConformance):
    entry_point = "Another"

class TestChecked(OperatorConformance):
    entry_point = "CheckedOperator"
    ready_within_s = 1.0
    arguments = {"factor": 57.3}
"""


DRIVER = """
from fluxvla_core import RUNNERS, BaseInferenceRunner

@RUNNERS.register_module()
class CheckedInferenceRunner(BaseInferenceRunner):
    api = "1.0"
"""
KITS_BEGIN = "class TestOther"


@pytest.fixture
def arm(tmp_path: Path) -> str:
    path = tmp_path / "arm.py"
    path.write_text(ARM)
    return str(path)


def kit_of(arm: str) -> str:
    """A file with the kits alone, as a plugin's own tests are."""
    path = Path(arm).with_name("kit.py")
    kits = KITS_BEGIN + ARM.partition(KITS_BEGIN)[2]
    path.write_text(f"from fluxvla_core.testing import OperatorConformance\n\n{kits}")
    return str(path)


def test_a_right_class_of_a_file_passes(fluxvla: Fluxvla, arm: str) -> None:
    ended = fluxvla("plugins", "check", "CheckedOperator", "--simulated", "--plugin", arm)
    assert ended.code == 0, ended.out
    lines = ended.out.splitlines()
    assert "  ok       a command moves its own joint" in lines
    place = lines.index("  skipped  a later stop sends the arm nothing")
    assert "override commands_heard" in lines[place + 1]
    assert lines[-1].startswith("CheckedOperator: 2")
    assert "FAILED" not in ended.out


def test_what_is_wrong_is_said_in_words(fluxvla: Fluxvla, arm: str) -> None:
    """With the kit of a file: only the one for this class is run, with its own settings."""
    words = ["--simulated", "--plugin", arm, "--kit", kit_of(arm)]
    ended = fluxvla("plugins", "check", "CheckedOperator", *words)
    assert ended.code == 1, ended.out
    said = " ".join(ended.out.split())
    assert "FAILED a command moves its own joint send_action() moves a by 0.03" in said
    assert "degrees for radians?" in said
    assert "assert " not in said  # pytest's own lines
    assert ended.out.splitlines()[-1].endswith("1 FAILED")


def test_arguments_reach_the_constructor(fluxvla: Fluxvla) -> None:
    ended = fluxvla("plugins", "check", "LowPass", "--set", "share=0.5")
    assert (ended.code, ended.out.splitlines()[-1]) == (0, "LowPass: 9 ok")
    ended = fluxvla("plugins", "check", "LowPass", "--set", "share=7.0")
    assert ended.code == 1
    assert "LowPass: share must be above 0" in " ".join(ended.out.split())


def test_a_runner_that_drives_a_robot_has_a_kit(fluxvla: Fluxvla, tmp_path: Path) -> None:
    path = tmp_path / "drive.py"
    path.write_text(DRIVER)
    ended = fluxvla("plugins", "check", "CheckedInferenceRunner", "--plugin", str(path))
    assert (ended.code, ended.out.splitlines()[-1]) == (0, "CheckedInferenceRunner: 15 ok")
    ended = fluxvla("plugins", "check", "CheckedInferenceRunner", "--set", "free_tasks=true")
    assert ended.code == 1
    assert "--task '7 no such task' gave None" in " ".join(ended.out.split())


def test_a_runner_that_evaluates_has_a_kit(fluxvla: Fluxvla) -> None:
    ended = fluxvla("plugins", "check", "EvalRunner", "--set", "max_steps=2")
    assert ended.code == 1
    said = " ".join(ended.out.split())
    assert "FAILED a policy that always succeeds does 'expert' failed in 12 of 12" in said
    assert ended.out.splitlines()[-1] == "EvalRunner: 11 ok, 1 FAILED"


PLANNER = """
import numpy as np
from fluxvla_core import POLICIES, EmbodimentSpec, Joint

@POLICIES.register_module()
class CheckedPolicy:
    api = "1.0"
    embodiment = EmbodimentSpec("arm", (Joint("a", "rad", -1, 1, 2, 8),), (), rate_hz=50)
    action_rate_hz, horizon = 10.0, 3
    def reset(self, seed): ...
    def predict_action(self, observation):
        return np.zeros((3, 4)) @ observation["qpos"]
"""


def test_a_class_of_another_shape_is_told_in_words_once(fluxvla: Fluxvla, tmp_path: Path) -> None:
    path = tmp_path / "planner.py"
    path.write_text(PLANNER)
    ended = fluxvla("plugins", "check", "CheckedPolicy", "--plugin", str(path))
    assert ended.code == 1
    said = " ".join(ended.out.split())
    assert said.count("(planner.py:12); it was given qpos (1,) float32, images {},") == 1
    assert "FAILED an episode follows from its seed as a chunk has its shape" in said


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["LowPas"], "did you mean 'LowPass'?"),
        (["CheckedOperater"], "did you mean 'CheckedOperator'?"),
        (["AdamW"], "for which there is no kit; there are kits for action_filters"),
        (["RobotEvalRunner"], "neither trains, nor takes an operator and a policy"),
        (["CheckedTrainRunner"], "tested in processes of their own"),
        (["LowPass", "--set", "share"], "expected KEY=VALUE"),
        (["LowPass", "--set", "=1"], "expected KEY=VALUE"),
        (["LowPass", "--kit", "nowhere.py"], "there is no such file"),
        (["LowPass", "--kit", "{kit}"], "no kit whose entry_point is 'LowPass'"),
        (["LowPass", "--kit", "{kit}", "--set", "share=1"], "has arguments of its own"),
        (["LowPass", "--plugin", "nowhere.py"], "there is no such file"),
        (["LowPass", "--hardware"], "are for operators; LowPass is none"),
        (["CheckedOperator"], "moves what it connects to: every joint by 0.03 of its unit"),
        (["CheckedOperator", "--hardware"], "no person is at a terminal to agree"),
        (["CheckedOperator", "--hardware", "--simulated"], "not allowed with argument"),
    ],
)
def test_bad_input_is_refused_in_words(
    fluxvla: Fluxvla, arm: str, words: list[str], said: str
) -> None:
    words = [word.replace("{kit}", kit_of(arm)) for word in words]
    ended = fluxvla("plugins", "check", *words, "--plugin", arm)
    assert ended.code == 2
    assert said in ended.err
    assert "Traceback" not in ended.err


@pytest.mark.parametrize(("typed", "code"), [("CheckedOperator", 0), ("yes", 2), ("", 2)])
def test_a_robot_moves_when_a_person_agrees(
    tmp_path: Path, arm: str, typed: str, code: int
) -> None:
    """At a terminal of its own."""
    log = tmp_path / "said"
    keyboard, screen = pty.openpty()
    words = ["plugins", "check", "CheckedOperator", "--hardware", "--plugin", arm]
    with log.open("w") as out:
        process = subprocess.Popen(
            [sys.executable, "-m", "fluxvla_core", *words], stdin=screen, stdout=out, stderr=out
        )
    try:
        until = time.monotonic() + 60
        while "to let it move" not in log.read_text():
            assert time.monotonic() < until
            assert process.poll() is None, log.read_text()
            time.sleep(0.05)
        os.write(keyboard, f"{typed}\n".encode())
        assert process.wait(60) == code, log.read_text()
    finally:
        process.kill()
        os.close(keyboard)
        os.close(screen)
    assert ("nothing was moved" in log.read_text()) == (code == 2)


def test_a_kit_that_cannot_be_loaded_is_told(fluxvla: Fluxvla, tmp_path: Path) -> None:
    path = tmp_path / "kit.py"
    path.write_text("import nothing_of_this_name\n")
    ended = fluxvla("plugins", "check", "LowPass", "--kit", str(path))
    assert ended.code == 2
    assert "No module named 'nothing_of_this_name'" in ended.err


def test_without_pytest_it_says_what_to_install(
    fluxvla: Fluxvla, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util,
        "find_spec",
        lambda name, *more: (name != "pytest" and found(name, *more)) or None,
    )
    ended = fluxvla("plugins", "check", "LowPass")
    assert ended.code == 2
    assert "pip install 'fluxvla-core[testing]'" in ended.err


def test_every_kit_is_of_a_registry() -> None:
    from fluxvla_core import testing

    assert set(KITS) <= set(REGISTRIES)
    kits = {n for n in testing.__all__ if n.endswith("Conformance")}
    # How a model is executed is a test of its author's, with observations of its own.
    assert {*KITS.values(), TRAINS, EVALUATES, "ExecutionConformance"} == kits
