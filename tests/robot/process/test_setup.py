"""``ControlSetup``: what a process of its own is built from arrives there as JSON."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
import types
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from fluxvla_core.commands import SilentReporter
from fluxvla_core.contracts.robot import ActionFilter
from fluxvla_core.control.filters import LowPass, SnapGripper
from fluxvla_core.control.safety import SafetySettings
from fluxvla_core.plugins.registry import (
    ACTION_FILTERS,
    OPERATORS,
    forget_plugin_files,
    load_plugin_files,
)
from fluxvla_core.robot.episode import EpisodeSettings
from fluxvla_core.robot.process.setup import ControlSetup, import_path, registered_here
from fluxvla_core.spec import EmbodimentSpec, Joint

SPEC = EmbodimentSpec(
    "arm",
    (
        Joint("a", "rad", -1.0, 1.0, 2.0, 10.0),
        Joint("jaw", "normalized", 0.0, 1.0, 2.0, 30.0, kind="gripper", open=1.0, closed=0.0),
    ),
    (),
    50.0,
)
SETTINGS = EpisodeSettings(
    rate_hz=50.0,
    safety=SafetySettings(velocity_scale=0.5, silence_s=0.3),
    start_pose=(0.1, 0.2),
    max_actions=None,
    latency_s=0.0,
    max_steps=100,
    action_rate_hz=10.0,
)
SETUP = ControlSetup(
    config={"seed": 7, "nested": {"list": [1, None, True, "手"]}},
    section="inference",
    work_dir="/somewhere",
    operator={"type": "SetupArm", "gain": 0.5},
    embodiment=json.loads(json.dumps(SPEC.to_dict())),
    filters=[{"type": "LowPass", "share": 0.5}],
    gripper_threshold=0.05,
    joining=({"method": "overlap", "fade_s": 0.1}, 0.02),
    settings=SETTINGS,
    before=None,
)
MODULE = """
from fluxvla_core.contracts.robot import ActionFilter

class Holder:
    class Nested(ActionFilter):
        def __init__(self, amount=1.0):
            self.amount = amount
        def __call__(self, action):
            return action + self.amount

class Arm:
    def __init__(self, gain):
        self.gain = gain
    def get_frame(self): ...
    def send_action(self, action): ...
    def stop(self): ...
"""


def there_and_back(setup):
    return ControlSetup.from_json(setup.to_json())


def test_everything_arrives():
    found = there_and_back(SETUP)

    for field in fields(ControlSetup):
        wanted, got = getattr(SETUP, field.name), getattr(found, field.name)
        if field.name in ("python_path", "registered", "plugin_files"):
            wanted, got = list(wanted), list(got)
        if field.name != "settings":
            assert got == wanted, field.name
    assert isinstance(found.settings, EpisodeSettings)
    assert found.settings.safety == SETTINGS.safety
    assert replace(found.settings, start_pose=(0.1, 0.2)) == SETTINGS
    assert EmbodimentSpec.from_dict(found.embodiment) == SPEC
    # Once there, it is what it is.
    assert there_and_back(found) == found


def test_each_threshold_of_the_safety_arrives():
    values = {f.name: 0.5 + 0.01 * n for n, f in enumerate(fields(SafetySettings))}
    safety = SafetySettings(**values)

    found = there_and_back(replace(SETUP, settings=replace(SETTINGS, safety=safety)))

    assert found.settings.safety == safety


def test_arrays_tuples_and_paths_arrive_as_lists_and_text():
    config = {
        "array": np.arange(4.0).reshape(2, 2),
        "number": np.float32(0.5),
        "count": np.int64(3),
        "flag": np.bool_(True),
        "tuple": (1, (2, 3)),
        "path": Path("/a/b"),
    }

    found = there_and_back(replace(SETUP, config=config, before=np.array([0.1, np.pi])))

    assert found.config == {
        "array": [[0.0, 1.0], [2.0, 3.0]],
        "number": 0.5,
        "count": 3,
        "flag": True,
        "tuple": [1, [2, 3]],
        "path": "/a/b",
    }
    assert found.before == [0.1, np.pi]


def test_joining_is_a_pair_and_its_method_a_name_or_a_table():
    for joining in (("rtc", 0.1), ({"method": "rtc", "window": 3}, 0.0)):
        found = there_and_back(replace(SETUP, joining=joining)).joining
        assert found == joining
        assert isinstance(found, tuple)


@pytest.mark.parametrize("where", ["config", "operator", "filters"])
def test_an_object_is_refused_by_its_name(where):
    class Policy:
        def __repr__(self):
            return "<my policy>"

    table = {"type": "SetupArm", "policy": Policy()}
    with pytest.raises(TypeError, match="<my policy> is an object"):
        replace(SETUP, **{where: [table] if where == "filters" else table}).to_json()


@pytest.fixture
def module(tmp_path, monkeypatch):
    """A module of the user's, which its folder on the path makes importable."""
    (tmp_path / "setup_users_module.py").write_text(MODULE)
    monkeypatch.syspath_prepend(str(tmp_path))
    made = importlib.import_module("setup_users_module")
    yield made
    sys.modules.pop("setup_users_module")


@pytest.fixture
def registered(module):
    """Its classes, registered by this process."""
    ACTION_FILTERS.register_module("SetupNested")(module.Holder.Nested)
    OPERATORS.register_module("SetupArm")(module.Arm)
    yield
    ACTION_FILTERS.unregister("SetupNested")
    OPERATORS.unregister("SetupArm")


TABLES = (
    {"type": "SetupArm", "gain": 0.5},
    [
        {"type": "LowPass", "share": 0.5},
        {"type": "SetupNested", "amount": 2.0},
    ],
)


def test_what_this_process_registered_is_named_by_where_it_is(registered):
    assert registered_here(*TABLES) == [
        ("operators", "SetupArm", "setup_users_module:Arm"),
        ("action_filters", "SetupNested", "setup_users_module:Holder.Nested"),
    ]


IN_ANOTHER_PROCESS = """
import sys
import numpy as np
from fluxvla_core.commands import SilentReporter
from fluxvla_core.robot.process.setup import ControlSetup

setup = ControlSetup.from_json(sys.stdin.read())
assert "setup_users_module" not in sys.modules
robot = setup.make_robot(SilentReporter())
filters = setup.make_filters(SilentReporter())
print(robot.name, *(type(each).__name__ for each in filters))
print(filters[1](np.array([0.5, 0.5])))
"""


def in_another_process(text):
    command = [sys.executable, "-c", IN_ANOTHER_PROCESS]
    return subprocess.run(command, input=text, capture_output=True, text=True, timeout=120)


def test_another_process_imports_and_builds_it(registered, tmp_path):
    operator, filters = TABLES
    setup = replace(
        SETUP,
        operator=operator,
        filters=filters,
        python_path=[str(tmp_path)],
        registered=registered_here(operator, filters),
    )

    ended = in_another_process(setup.to_json())

    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.splitlines() == ["Arm LowPass Nested SnapGripper", "[2.5 2.5]"]


def test_filters_are_built_in_their_order_and_bound():
    low, snap = SETUP.make_filters(SilentReporter())

    assert isinstance(low, LowPass)
    assert isinstance(snap, SnapGripper)
    assert snap._ends, "bound to the robot"
    assert len(replace(SETUP, gripper_threshold=None).make_filters(SilentReporter())) == 1


class AtTheTop(ActionFilter):
    def __call__(self, action):
        return action


def test_classes_that_no_other_process_finds(module, monkeypatch):
    class Local(ActionFilter):
        def __call__(self, action):
            return action

    class OfTheProgram(AtTheTop):
        pass

    OfTheProgram.__qualname__ = "OfTheProgram"
    assert import_path(OfTheProgram) == import_path(AtTheTop).replace("AtTheTop", "OfTheProgram")
    OfTheProgram.__module__ = "__main__"

    assert import_path(Local) is None
    assert import_path(OfTheProgram) is None
    assert import_path(module.Holder.Nested) == "setup_users_module:Holder.Nested"


@pytest.mark.parametrize("name", ["gone", "gone.further", "json.gone", "made_by_hand"])
def test_a_class_whose_module_is_in_no_file_is_not_found(name, monkeypatch):
    if name == "made_by_hand":
        monkeypatch.setitem(sys.modules, name, types.ModuleType(name))
    cls = type("Filter", (AtTheTop,), {"__module__": name})

    assert import_path(cls) is None


def test_a_module_that_was_imported_from_a_place_that_no_other_process_looks_in(tmp_path):
    file = tmp_path / "setup_hidden.py"
    file.write_text("class Filter: ...")
    spec = importlib.util.spec_from_file_location("setup_hidden", file)
    sys.modules["setup_hidden"] = hidden = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(hidden)
    try:
        assert import_path(hidden.Filter) is None
    finally:
        del sys.modules["setup_hidden"]


PLUGIN_FILE = """
from fluxvla_core.plugins.registry import ACTION_FILTERS, OPERATORS
""" + MODULE.replace("class Arm:", '@OPERATORS.register_module("SetupArm")\nclass Arm:').replace(
    "    class Nested", '    @ACTION_FILTERS.register_module("SetupNested")\n    class Nested'
)


def test_classes_of_a_plugin_file_are_there_as_well(tmp_path):
    # ``fluxvla run --plugin FILE``: the file is not on the path.
    file = tmp_path / "my-robot.py"
    file.write_text(PLUGIN_FILE)
    operator, filters = TABLES
    load_plugin_files([file])
    try:
        registered = registered_here(operator, filters)
        assert [name for _, name, _ in registered] == ["SetupArm", "SetupNested"]
        given = {**vars(SETUP), "operator": operator, "filters": filters, "registered": registered}
        del given["plugin_files"]  # those of this process, if nobody says anything else
        setup = ControlSetup(**given)
        assert setup.plugin_files == (str(file),)
        text = setup.to_json()
    finally:
        forget_plugin_files()

    ended = in_another_process(text)

    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.splitlines() == ["Arm LowPass Nested SnapGripper", "[2.5 2.5]"]


def test_json_has_nothing_but_json():
    assert isinstance(json.loads(SETUP.to_json()), dict)
