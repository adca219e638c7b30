"""``fluxvla plugins check``: the kit of one class, without pytest to be seen."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

from fluxvla_core.cli.check_plugin import KITS
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
    ended = fluxvla("plugins", "check", "CheckedOperator", "--plugin", arm)
    assert ended.code == 0, ended.out
    lines = ended.out.splitlines()
    assert "  ok       a command moves its own joint" in lines
    place = lines.index("  skipped  a later stop sends the arm nothing")
    assert "override commands_heard" in lines[place + 1]
    assert lines[-1].startswith("CheckedOperator: 2")
    assert "FAILED" not in ended.out


def test_what_is_wrong_is_said_in_words(fluxvla: Fluxvla, arm: str) -> None:
    """With the kit of a file: only the one for this class is run, with its own settings."""
    words = ["--plugin", arm, "--kit", kit_of(arm)]
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


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["LowPas"], "did you mean 'LowPass'?"),
        (["CheckedOperater"], "did you mean 'CheckedOperator'?"),
        (["AdamW"], "for which there is no kit; there are kits for action_filters"),
        (["EvalRunner"], "is a runner that does not train"),
        (["CheckedTrainRunner"], "tested in processes of their own"),
        (["LowPass", "--set", "share"], "expected KEY=VALUE"),
        (["LowPass", "--set", "=1"], "expected KEY=VALUE"),
        (["LowPass", "--kit", "nowhere.py"], "there is no such file"),
        (["LowPass", "--kit", "{kit}"], "no kit whose entry_point is 'LowPass'"),
        (["LowPass", "--kit", "{kit}", "--set", "share=1"], "has arguments of its own"),
        (["LowPass", "--plugin", "nowhere.py"], "there is no such file"),
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
    assert set(KITS.values()) == {n for n in testing.__all__ if n.endswith("Conformance")}
