"""The kit passes a right operator, and each wrong one fails its own check and says why."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys

import pytest

from fluxvla_core.testing import OperatorConformance

GOOD = """
import time
import numpy as np
from fluxvla_core.contracts.frame import Frame
from fluxvla_core.errors import NotReady, Rejected
from fluxvla_core.spec import Camera, EmbodimentSpec, Joint
from fluxvla_core.plugins.registry import OPERATORS
from fluxvla_core.testing import OperatorConformance

SPEC = EmbodimentSpec("arm", (Joint("a", "rad", -1, 1, 2, 8), Joint("b", "rad", -1, 1, 2, 8)),
                      (Camera("front", 4, 6),), rate_hz=50)

class SmallOperator:
    api = "1.0"
    def __init__(self, speed: float = 1.0):
        self._state = None
        self.heard = 0
    @property
    def embodiment(self):
        return SPEC
    def connect(self):
        self._state = np.zeros(2)
    def get_frame(self):
        if self._state is None:
            raise NotReady("not connected")
        now = time.monotonic()
        return Frame(self._state.copy(), {"front": np.zeros((4, 6, 3), np.uint8)},
                     {"state": now, "front": now})
    def send_action(self, action):
        if self._state is None:
            raise NotReady("not connected")
        if np.shape(action) != (2,) or not np.isfinite(action).all() or (abs(action) > 1).any():
            raise Rejected("out of spec")
        self._state = np.array(action)
        self.heard += 1
    def stop(self):
        pass
    def close(self):
        self._state = None

OPERATORS.register_module()(SmallOperator)

class TestSmall(OperatorConformance):
    entry_point = "SmallOperator"
    def commands_heard(self, operator):
        return operator.heard
"""

# One of the specification's shape, whose readings are a dict, and how its runner understands them.
SHAPED = (
    GOOD.replace(
        "    def get_frame(self):\n",
        "    def get_frame(self):\n        return vars(self._read())\n    def _read(self):\n",
    ).replace("SmallOperator", "ShapedOperator")
    + """
    def frame(self, operator):
        return Frame(**operator.get_frame())
"""
)

# One that has more streams than the embodiment: a depth image comes with its own stamp.
DEEP = GOOD.replace('"front": now}', '"front": now, "front depth": now}').replace(
    "SmallOperator", "DeepOperator"
)

# One that can be divided: its operators share one arm, as two processes share a robot.
DIVIDED = (
    GOOD.replace("class TestSmall(", "class Small(").replace("SmallOperator", "BaseOperator")
    + """
class DividedOperator(BaseOperator):
    arm, count = np.zeros(2), 0
    part = "whole"
    def without_cameras(self):
        self.part = "control"
        return self
    def without_commands(self):
        self.part = "cameras"
        return self
    def get_state(self):
        if self._state is None:
            raise NotReady("not connected")
        return type(self).arm.copy()
    def get_frame(self):
        if self.part == "control":
            raise NotReady("no cameras")
        if self._state is not None:
            self._state = type(self).arm + 0.0
        return super().get_frame()
    def send_action(self, action):
        if self.part == "cameras":
            raise Rejected("no commands")
        super().send_action(action)
        type(self).arm = np.array(action)
        type(self).count += 1
    def close(self):
        super().close()

OPERATORS.register_module()(DividedOperator)

class TestSmall(OperatorConformance):
    entry_point = "DividedOperator"
    ready_within_s = 2.0
    def commands_heard(self, operator):
        return OPERATORS.get("DividedOperator").count
"""
)
RIGHT = {
    "specimen_right.py": GOOD,
    "specimen_shaped.py": SHAPED,
    "specimen_deep.py": DEEP,
    "specimen_divided.py": DIVIDED,
}

HEARD, SHORT = "    def commands_heard", "    ready_within_s = 2.0\n"
BROKEN = {
    "test_is_complete": ('    api = "1.0"\n', ""),
    "test_import_is_light": ("import time\n", "import time, torch\n"),
    "test_constructor_names_every_parameter": ("speed: float = 1.0", "**options"),
    "test_constructor_does_no_io": (
        "        self.heard = 0\n    @property",
        "        self.heard = 0\n"
        "        import socket\n"
        "        socket.socket().bind(('127.0.0.1', 0))\n"
        "    @property",
    ),
    "test_embodiment_is_valid_before_connect": ("return SPEC", "return SPEC.to_dict()"),
    "test_nothing_works_before_connect": (
        "def __init__(self, speed: float = 1.0):\n        self._state = None",
        "def __init__(self, speed: float = 1.0):\n        self._state = np.zeros(2)",
    ),
    "test_frame_matches_the_embodiment": (
        "np.zeros((4, 6, 3), np.uint8)",
        "np.zeros((6, 4, 3), np.uint8)",
    ),
    "test_frames_are_fresh_arrays": ("Frame(self._state.copy()", "Frame(self._state"),
    "test_stamps_go_on": ("now = time.monotonic()", "now = 5.0"),
    "test_frames_come_at_once": (
        "        now = time.monotonic()\n",
        "        time.sleep(1.1)\n        now = time.monotonic()\n",
    ),
    "test_stamps_are_of_its_clock": ("now = time.monotonic()", "now = time.time()"),
    "test_a_command_moves_its_own_joint": (
        "Frame(self._state.copy()",
        "Frame(self._state[::-1].copy()",
    ),
    "test_bad_actions_are_refused[nan]": ("not np.isfinite(action).all()", "False"),
    "test_bad_actions_are_refused[above]": ("(abs(action) > 1).any()", "False"),
    "test_the_action_belongs_to_the_caller": (
        "self._state = np.array(action)",
        "self._state = np.array(action); action += 1",
    ),
    "test_stop_works_in_any_state": (
        "def stop(self):\n        pass",
        "def stop(self):\n        self._state[0]",
    ),
    "test_a_later_stop_sends_the_arm_nothing": (
        "def stop(self):\n        pass",
        "def stop(self):\n        if self._state is not None: self.send_action(self._state)",
    ),
    "test_close_gives_everything_back": (
        "def close(self):\n        self._state = None",
        "def close(self):\n        pass",
    ),
}

# What got past the kit once: a change of ``GOOD``, the check that finds it, and part of its words.
GOT_THROUGH = {
    "degrees": (
        "Frame(self._state.copy()", "Frame(np.degrees(self._state)",
        "test_a_command_moves_its_own_joint", "57.3 times that (degrees for radians?)",
    ),
    "columns swapped": (
        "Frame(self._state.copy()", "Frame(self._state[::-1].copy()",
        "test_a_command_moves_its_own_joint", "are the columns in the order of the joint names",
    ),
    "a sign": (
        "Frame(self._state.copy()", "Frame(-self._state.copy()",
        "test_a_command_moves_its_own_joint", "-1 times that",
    ),
    "never changes": (
        "Frame(self._state.copy()", "Frame(0.0 * self._state",
        "test_a_command_moves_its_own_joint", "the state did not change",
    ),
    "wall clock": (
        "now = time.monotonic()", "now = time.time()",
        "test_stamps_are_of_its_clock", "it is that of time.time()",
    ),
    "blocks": (
        "        now = time.monotonic()\n", "        time.sleep(1.1); now = time.monotonic()\n",
        "test_frames_come_at_once", "waits for none",
    ),
    "sends first": (
        "        if np.shape(action) != (2,)",
        "        self.heard += 1\n        if np.shape(action) != (2,)",
        "test_bad_actions_are_refused[above]", "it was sent before it was refused",
    ),
    "refuses late": (
        "        if np.shape(action) != (2,)",
        "        late, self.late = getattr(self, 'late', None), action\n"
        "        if late is not None and (abs(late) > 1).any(): raise Rejected('late')\n"
        "        if (abs(action) > 1).any(): return\n"
        "        if np.shape(action) != (2,)",
        "test_bad_actions_are_refused[above]", "the call that sends it is the one that can be told",
    ),
}  # fmt: skip

READ, SEEN, SILENT = (
    "test_both_parts_read_the_robot_at_the_same_time",
    "test_a_command_of_one_part_is_seen_by_the_other",
    "test_the_part_without_commands_sends_nothing",
)
# What is wrong -> the check that finds it, and the change of ``DIVIDED`` that makes it wrong.
BADLY_DIVIDED = {
    "half": (READ, 'self.part = "cameras"\n        return self', "return None"),
    "frames without cameras": (READ, 'if self.part == "control"', "if False"),
    "no state": (READ, "return type(self).arm.copy()", "return None"),
    "another state": (
        READ,
        "return type(self).arm.copy()",
        'return type(self).arm + 0.1 * (self.part == "cameras")',
    ),
    "another robot": (SEEN, "type(self).arm = np.array(action)", "pass"),
    "commands": (SILENT, 'if self.part == "cameras"', "if False"),
    "a last command": (
        SILENT,
        "super().close()",
        'type(self).count += self.part == "cameras"; super().close()',
    ),
}


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """``specimen::check`` -> outcome: all checks of the right one, its own of each wrong one."""
    folder = tmp_path_factory.mktemp("specimens")
    wanted = list(RIGHT)
    for name, source in RIGHT.items():
        (folder / name).write_text(source)
    for number, (check, (old, new)) in enumerate(BROKEN.items()):
        assert old in GOOD
        name = f"specimen_{number}.py"
        source = GOOD.replace(old, new, 1).replace("SmallOperator", f"Small{number}Operator")
        source = source.replace(HEARD, SHORT + HEARD)
        (folder / name).write_text(source)
        wanted.append(f"{name}::TestSmall::{check}")
    for number, (check, old, new) in enumerate(BADLY_DIVIDED.values()):
        assert old in DIVIDED
        name = f"divided_{number}.py"
        source = DIVIDED.replace(old, new, 1)
        for operator in ("BaseOperator", "DividedOperator"):
            source = source.replace(operator, f"{operator[:-8]}{number}PartsOperator")
        (folder / name).write_text(source)
        wanted.append(f"{name}::TestSmall::{check}")
    for number, (old, new, check, _) in enumerate(GOT_THROUGH.values()):
        assert GOOD.count(old) == 1
        name = f"through_{number}.py"
        source = GOOD.replace(old, new).replace("SmallOperator", f"Through{number}Operator")
        source = source.replace(HEARD, SHORT + HEARD)
        (folder / name).write_text(source)
        wanted.append(f"{name}::TestSmall::{check}")
    options = ["-q", "-rA", "-p", "no:cacheprovider", "--tb=no"]
    run = [sys.executable, "-m", "pytest", *options, *wanted]
    env = {**os.environ, "COLUMNS": "2000"}
    text = subprocess.run(run, capture_output=True, text=True, cwd=folder, env=env).stdout
    found = {}
    for line in text.splitlines():
        outcome, _, rest = line.partition(" ")
        if outcome in ("PASSED", "FAILED", "ERROR"):
            file, _, check = rest.partition(" - ")[0].partition("::TestSmall::")
            found[f"{file}::{check}"] = outcome
            found[f"{file}::{check} said"] = rest.partition(" - ")[2]
    return found


@pytest.mark.early
@pytest.mark.parametrize("specimen", RIGHT)
def test_a_right_operator_passes_every_check(outcomes, specimen):
    right = {k: v for k, v in outcomes.items() if k.startswith(f"{specimen}::")}
    right = {k: v for k, v in right.items() if not k.endswith(" said")}
    assert len(right) >= 20
    assert set(right.values()) == {"PASSED"}


@pytest.mark.parametrize("check", BROKEN)
def test_a_wrong_operator_fails_its_own_check(outcomes, check):
    number = list(BROKEN).index(check)
    assert outcomes[f"specimen_{number}.py::{check}"] == "FAILED"
    said = outcomes[f"specimen_{number}.py::{check} said"]
    assert len(said.split()) > 8, said  # in words: what was called, what came, what was expected


@pytest.mark.parametrize("fault", GOT_THROUGH)
def test_what_got_through_is_found_in_words(outcomes, fault):
    number, (_, _, check, words) = list(GOT_THROUGH).index(fault), GOT_THROUGH[fault]
    assert outcomes[f"through_{number}.py::{check}"] == "FAILED"
    assert words in outcomes[f"through_{number}.py::{check} said"]


@pytest.mark.parametrize("fault", BADLY_DIVIDED)
def test_a_wrong_division_fails_its_own_check(outcomes, fault):
    number, check = list(BADLY_DIVIDED).index(fault), BADLY_DIVIDED[fault][0]
    # Half a division fails before the check, in the fixture that divides.
    expected = "ERROR" if fault == "half" else "FAILED"
    assert outcomes[f"divided_{number}.py::{check}"] == expected


def test_commands_that_never_end_are_reported():
    class Endless(OperatorConformance):
        ready_within_s = 0.5
        count = itertools.count()

        def commands_heard(self, operator):
            return next(self.count)

    with pytest.raises(AssertionError, match=r"commands still arrive after 0\.5 s"):
        Endless().settled(None)
