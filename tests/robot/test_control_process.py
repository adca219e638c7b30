"""When a process of its own commands a robot, and what is said where it cannot."""

from __future__ import annotations

import json
from collections.abc import Mapping

import numpy as np
import pytest

from fluxvla_core import OPERATORS, BaseInferenceRunner, RunContext
from fluxvla_core.control.clock import SimulatedClock
from fluxvla_core.errors import ConfigError, FluxError
from fluxvla_core.operators import Camera, EmbodimentSpec, Frame, Joint, Operator
from fluxvla_core.robot.process.remote_operator import RemoteOperator
from fluxvla_core.robot.recording.recorded import open_recording

ARM = EmbodimentSpec("arm", (Joint("j", "rad", -1, 1, 2, 10),), (Camera("front", 8, 8),), 50)


class Arm(Operator):
    """An arm of the old shape, which cannot be divided."""

    api = "1.0"
    embodiment = ARM

    def connect(self):
        """Nothing to connect to."""

    def get_frame(self):
        return Frame(np.zeros(1), {"front": np.zeros((8, 8, 3), np.uint8)}, {})

    def send_action(self, action):
        """Goes nowhere."""

    def stop(self):
        """Is at rest."""

    def close(self):
        """Nothing to close."""


class DividedArm(Arm):
    def without_cameras(self):
        return self

    def without_commands(self):
        return self


class RecordedEpisode(Arm):
    follows_commands = False


class OwnClock(Arm):
    class clock:
        lockstep = False
        now = sleep_until = None


class Placed(Arm):
    def begin_episode(self, instruction, episode):
        """Puts its objects in place."""


class Connecting:
    """As the specification has it, with an embodiment that it knows once it is connected."""

    def __init__(self):
        self.embodiment = ARM

    def get_frame(self):
        """Nothing."""

    def send_action(self, action):
        """Goes nowhere."""

    def stop(self):
        """Is at rest."""


class Simulated(DividedArm):
    def __init__(self):
        self.clock = SimulatedClock()


@pytest.fixture(autouse=True)
def registered():
    classes = [Arm, DividedArm, Simulated, RecordedEpisode, OwnClock, Placed, Connecting]
    for cls in classes:
        OPERATORS.register_module()(cls)
    yield
    for cls in classes:
        OPERATORS.unregister(cls.__name__)


def runner(tmp_path, operator, cls=BaseInferenceRunner, **arguments):
    origins = {"inference.control_process": "here.py:3"}
    context = RunContext(section="inference", work_dir=tmp_path, origins=origins)
    return cls(context=context, operator=operator, **arguments)


class OwnSending(BaseInferenceRunner):
    def _execute_actions(self, actions, rate):
        """As the specification's runners do."""


class OwnObservation(BaseInferenceRunner):
    def get_ros_observation(self):
        return super().get_ros_observation()


def test_an_operator_that_can_be_divided_is_divided(tmp_path):
    assert runner(tmp_path, {"type": "DividedArm"}).divided
    assert not runner(tmp_path, {"type": "DividedArm"}, control_process=False).divided


def test_one_that_cannot_be_divided_runs_there_as_a_whole(tmp_path):
    made = runner(tmp_path, {"type": "Arm"})

    assert made.divided
    assert isinstance(made.ros_operator, RemoteOperator)
    assert (made.robot.name, made.embodiment) == ("Arm", ARM)
    alone = runner(tmp_path, {"type": "Arm"}, control_process=False)
    assert not alone.divided
    assert isinstance(alone.ros_operator, Arm)


@pytest.mark.parametrize("table", [{}, {"type": "Nobody"}, {"type": 3}])
def test_an_operator_that_is_none_is_an_error_as_ever(tmp_path, table):
    with pytest.raises(FluxError) as caught:
        runner(tmp_path, table)
    with pytest.raises(type(caught.value)) as alone:
        runner(tmp_path, table, control_process=False)
    assert str(caught.value) == str(alone.value)


def test_one_that_cannot_be_divided_may_be_a_simulation(tmp_path):
    assert runner(tmp_path, {"type": "Placed"}).robot.simulated
    assert not runner(tmp_path, {"type": "Arm"}).robot.simulated


def test_what_is_wrong_with_one_is_found_before_there_is_another_process(tmp_path):
    wider = EmbodimentSpec("arm", (Joint("j", "rad", -1, 1, 9, 10),), ARM.cameras, 50)

    with pytest.raises(FluxError, match="the config's embodiment widens velocity"):
        runner(tmp_path, {"type": "Arm"}, embodiment=wider)


def test_a_runner_that_only_observes_in_its_own_way_is_divided(tmp_path):
    assert runner(tmp_path, {"type": "DividedArm"}, OwnObservation).divided


def local_arm():
    class Local(DividedArm):
        pass

    OPERATORS.register_module("Local", force=True)(Local)
    return {"type": "Local"}


@pytest.mark.parametrize(
    ("operator", "cls", "why"),
    [
        ({"type": "Arm"}, OwnObservation, "OwnObservation reads the robot by a method of its own"),
        (
            {"type": "RecordedEpisode"},
            BaseInferenceRunner,
            "RecordedEpisode is a recording, which",
        ),
        ({"type": "OwnClock"}, BaseInferenceRunner, "OwnClock .* has a clock of its own"),
        ({"type": "Connecting"}, BaseInferenceRunner, "Connecting connects in its constructor"),
        (DividedArm(), BaseInferenceRunner, "DividedArm is an object, not a table"),
        ({"type": "Simulated"}, BaseInferenceRunner, "stands still between commands"),
        ({"type": "DividedArm"}, OwnSending, "OwnSending sends commands by a method of its own"),
        (local_arm, BaseInferenceRunner, "Local is defined where no other process can import it"),
    ],
)
def test_why_a_robot_cannot_be_divided(tmp_path, operator, cls, why):
    given: Mapping | Arm = operator() if operator is local_arm else operator

    assert not runner(tmp_path, given, cls).divided
    with pytest.raises(ConfigError, match=why) as caught:
        runner(tmp_path, given, cls, control_process=True)
    assert caught.value.where == "here.py:3: inference.control_process"


@pytest.mark.parametrize(
    ("more", "why"),
    [
        ({"limits": {1: 2.0}}, "operator.limits has a key that is not text: 1"),
        ({"gains": [1.0, {"of": object()}]}, "operator.gains.1.of is an object"),
    ],
)
def test_what_cannot_be_sent_to_another_process_is_named(tmp_path, more, why):
    class Taking(DividedArm):
        def __init__(self, **more):
            """Takes anything."""

    Taking.__qualname__ = "DividedArm"
    OPERATORS.register_module("DividedArm", force=True)(Taking)

    with pytest.raises(ConfigError, match=why):
        runner(tmp_path, {"type": "DividedArm", **more}, control_process=True)


def lines(path, events):
    path.write_text("".join(json.dumps(event) + "\n" for event in events))


def test_what_only_the_control_process_knew_completes_a_record(tmp_path):
    start = {"event": "start", "t": 0.0, "format": "fluxvla-episode-1", "embodiment": ARM.to_dict()}
    command = {"event": "command", "phase": "run", "wanted": [0.0]}
    lines(tmp_path / "trace.jsonl", [start, {**command, "t": 0.1, "command": [0.1]}])
    known = [{**command, "t": t / 10, "command": [t / 10]} for t in (1, 2, 3)]
    end = {"event": "end", "t": 0.4, "outcome": "failed", "problem": "killed", "trips": []}
    lines(tmp_path / "rest.jsonl", [*known, end])

    recorded = open_recording(tmp_path)

    assert recorded.finished
    np.testing.assert_array_equal(recorded.commands()[0], [0.1, 0.2, 0.3])
    assert recorded.summary()["problem"] == "killed"


def test_a_record_that_is_whole_ignores_the_rest(tmp_path):
    start = {"event": "start", "t": 0.0, "format": "fluxvla-episode-1", "embodiment": ARM.to_dict()}
    end = {"event": "end", "t": 0.4, "outcome": "done", "problem": None, "trips": []}
    lines(tmp_path / "trace.jsonl", [start, end])
    lines(tmp_path / "rest.jsonl", [{**end, "t": 0.5, "outcome": "failed"}])

    assert open_recording(tmp_path).summary()["outcome"] == "done"
