"""An operator that cannot be divided, as a whole in a real control process."""

from __future__ import annotations

import ctypes
import importlib
import json
import os
import signal
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from fluxvla_core.build import RunContext, build_runner_from_cfg
from fluxvla_core.errors import ConfigError, FluxError, NotReady, SafetyStop
from fluxvla_core.plugins.registry import OPERATORS, RUNNERS
from fluxvla_core.robot.recording.recorded import find_recordings, open_recording
from fluxvla_core.robot.runner import BaseInferenceRunner
from fluxvla_core.spec.embodiment import Camera, EmbodimentSpec, Joint

pytestmark = pytest.mark.realtime

MODULE = '''
import json
import os
import time
from pathlib import Path

import numpy as np

from fluxvla_core.contracts.frame import Frame, RobotFrame
from fluxvla_core.contracts.robot import Operator
from fluxvla_core.errors import NotReady
from fluxvla_core.robot.runner import BaseInferenceRunner
from fluxvla_core.spec.embodiment import EmbodimentSpec


class OldArm(Operator):
    """State and images in one; counts its frames in the first pixel. Its folder has the log."""

    api = "1.0"

    def __init__(self, folder, spec, fault=None):
        self.embodiment = EmbodimentSpec.from_dict(spec)
        self._folder, self._fault, self._frames = Path(folder), fault, 0

    def _log(self, name, *numbers):
        with open(self._folder / name, "a") as log:
            log.write(" ".join(map(repr, map(float, numbers))) + "\\n")

    def connect(self):
        self._log("connected", os.getpid())
        self._state = np.zeros(2)

    def get_frame(self):
        self._frames += 1
        if self._fault == "late" and self._frames < 4:
            raise NotReady("the camera warms up")
        if self._fault == "raises" and self._frames > 4:
            raise RuntimeError("cable pulled")
        if self._fault == "size" and self._frames > 4:
            return self._frame(np.zeros((48, 64, 3), np.uint8))
        if self._fault == "slow":
            time.sleep(0.15)
        image = np.zeros((24, 32, 3), np.uint8)
        image[0, 0] = self._frames % 256, 2, 3
        image[1:] = image[0, 0]
        return self._frame(image)

    def _frame(self, image):
        now = time.monotonic()
        images, stamps = {"front": image, "unused": image}, {"state": now, "front": now}
        if self._fault != "rover":
            return Frame(self._state.copy(), images, stamps)
        depth = np.full((24, 32), self._frames * 0.01, np.float32)
        depth[0, 0] = np.nan
        base = np.array([self._frames * 0.1, -0.5])
        return RobotFrame(self._state.copy(), images, {**stamps, "front_depth": now},
                          {"front": depth, "unused": depth}, base)

    def send_action(self, action):
        self._log("sent", time.monotonic(), *action)
        if self._fault != "blocked" or self._frames < 4:
            self._state = np.array(action)

    def stop(self):
        self._log("stopped", time.monotonic())

    def close(self): ...

    def task_success(self):
        return True

    def episode_facts(self):
        return {"frames": self._frames}


class SpecArm:
    """As the specification writes it: the constructor connects, the config knows the robot."""

    def __init__(self, folder):
        self._arm = OldArm(folder, json.loads((Path(folder) / "spec.json").read_text()))
        self._arm.connect()

    def get_frame(self):
        return self._arm.get_frame()

    def send_action(self, action):
        self._arm.send_action(action)

    def stop(self):
        self._arm.stop()


class SpecificationsOperator:
    """Commands of its own, frames that only its runner understands, and no stop."""

    def __init__(self, folder):
        self._arm = OldArm(folder, json.loads((Path(folder) / "spec.json").read_text()))
        self._arm.connect()

    def get_frame(self):
        frame = self._arm.get_frame()
        return {"img": frame.images["front"], "joints": list(frame.state)}

    def servoj(self, joints):
        self._arm.send_action(joints)


class SpecificationsRunner(BaseInferenceRunner):
    """The three methods of the specification's example."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.looks = 0

    def get_ros_observation(self):
        frame = self.ros_operator.get_frame()
        return frame["img"], frame["joints"]

    def update_observation_window(self):
        img, joints = self.get_ros_observation()
        self.looks += 1
        return {
            "qpos": np.array(joints, dtype=np.float32),
            "images": {"front": img},
            "looks": np.array([self.looks]),
            "said": {"in": os.getpid()},
        }

    def _execute_actions(self, actions, rate):
        for action in actions:
            self.ros_operator.servoj(action)
            rate.sleep()


class Opening(SpecificationsRunner):
    def run(self):
        self.ros_operator.servoj(np.zeros(2))
        return super().run()


class Strange(SpecificationsRunner):
    def update_observation_window(self):
        return {**super().update_observation_window(), "tool": object()}
'''
SPEC = EmbodimentSpec(
    "testarm",
    (
        Joint("shoulder", "rad", -1.0, 1.5, 2.0, 10.0),
        Joint("elbow", "rad", -2.0, 2.0, 3.0, 20.0),
    ),
    (Camera("front", 24, 32), Camera("unused", 24, 32)),
    50.0,
)


class Looking:
    """Moves on, and remembers what it saw."""

    embodiment = SPEC
    action_rate_hz = 10.0
    horizon = 5
    cameras = ("front",)

    def __init__(self):
        self.seen, self.thinks_s, self.resets_s = [], 0.02, 0.0

    def reset(self, seed):
        time.sleep(self.resets_s)

    def predict_action(self, observation):
        self.seen.append(observation["images"])
        self.asked = observation
        time.sleep(self.thinks_s)
        pose = np.asarray(observation["qpos"], dtype=np.float64)
        chunk = np.repeat(pose[None], 5, axis=0)
        chunk[:, 0] = np.minimum(pose[0] + 0.1 * np.arange(1, 6), 1.4)
        return chunk


class Notes:
    def __init__(self):
        self.lines = []

    def info(self, text):
        self.lines.append(text)

    warn = info

    def progress(self, *what): ...

    def metric(self, *what): ...

    def artifact(self, *what): ...


@pytest.fixture
def module(tmp_path, monkeypatch):
    (tmp_path / "users_arms.py").write_text(MODULE)
    monkeypatch.syspath_prepend(str(tmp_path))
    made = importlib.import_module("users_arms")
    OPERATORS.register_module()(made.OldArm)
    OPERATORS.register_module()(made.SpecArm)
    OPERATORS.register_module()(made.SpecificationsOperator)
    for cls in (made.SpecificationsRunner, made.Opening, made.Strange):
        RUNNERS.register_module()(cls)
    yield made
    for name in ("OldArm", "SpecArm", "SpecificationsOperator"):
        OPERATORS.unregister(name)
    for name in ("SpecificationsRunner", "Opening", "Strange"):
        RUNNERS.unregister(name)
    del sys.modules["users_arms"]


class Run:
    """A run of an arm, and what it left behind."""

    def __init__(self, folder, kind="OldArm", **changed):
        self._folder = folder
        self.policy, self.notes = Looking(), Notes()
        table = {"type": kind, "folder": str(folder)}
        if kind == "OldArm":
            table |= {"spec": SPEC.to_dict(), "fault": changed.pop("fault", None)}
        tasks = {"task_file": changed.pop("task_file")} if "task_file" in changed else {"task": "1"}
        context = RunContext(section="inference", work_dir=folder, reporter=self.notes, **tasks)
        self.runner = BaseInferenceRunner(
            context=context, operator=table, policy=self.policy, task_descriptions={"1": "wave"},
            record_fps=None, **{"max_publish_step": 60, "async_execution": True, **changed},
        )  # fmt: skip
        self.runner.run_setup()

    @property
    def episode(self):
        folder = self._folder / "inference" / "001-1"
        return json.loads((folder / "episode.json").read_text())

    def log(self, name):
        return np.loadtxt(self._folder / name, ndmin=2)

    def assert_within_limits(self):
        path = np.vstack([np.zeros((2, 2)), self.log("sent")[:, 1:]])
        speed = np.diff(path, axis=0) * 50.0
        push = np.diff(speed, axis=0) * 50.0
        assert (np.abs(speed).max(axis=0) <= [2.0 + 1e-9, 3.0 + 1e-9]).all()
        assert (np.abs(push).max(axis=0) <= [10.0 + 1e-6, 20.0 + 1e-6]).all()
        assert np.abs(speed[-1]).max() < 1e-9


def test_an_episode_with_pictures_of_the_process_that_commands(tmp_path, module):
    run = Run(tmp_path)

    result = run.runner.run()

    assert run.runner.divided
    assert (result["outcome"], result["success"]) == ("max_steps", True)
    assert "OldArm is not divided: the control process reads its images too" in run.notes.lines
    (connected,) = run.log("connected")
    assert connected[0] != os.getpid()
    run.assert_within_limits()
    # Each image is of a look of its own, and only the camera that the policy looks at is there.
    counts = []
    for images in run.policy.seen:
        assert set(images) == {"front"}
        assert images["front"].shape == (24, 32, 3)
        np.testing.assert_array_equal(images["front"][-1, -1], images["front"][0, 0])
        counts.append(int(images["front"][0, 0, 0]))
    assert counts == sorted(set(counts))
    assert run.runner.episode_facts()["frames"] == counts[-1]
    assert len(run.log("sent")) >= 60


def test_depth_and_base_speed_are_recorded(tmp_path, module):
    run = Run(tmp_path, fault="rover", record=str(tmp_path / "records"))
    assert run.runner.divided

    run.runner.run()

    (place,) = find_recordings(tmp_path / "records")
    recorded = open_recording(place)
    seen = [event for event in recorded.events if event["event"] == "observation"]
    assert set(recorded.depths) == {"front"}
    assert len(seen) >= len(run.policy.seen) > 2
    for event in seen:
        stamps, images, depths = (
            event["stamps"],
            recorded.pictures["front"],
            recorded.depths["front"],
        )
        count = int(images.read(images.newest(stamps["front"]))[0, 0, 0])
        assert event["base"] == [count * 0.1, -0.5]
        metres = depths.read(depths.newest(stamps["front_depth"]))
        assert np.isnan(metres[0, 0])
        np.testing.assert_allclose(metres[1:], count * 0.01, atol=1e-6)


def test_a_constructor_that_connects_is_called_in_the_control_process_alone(tmp_path, module):
    (tmp_path / "spec.json").write_text(json.dumps(SPEC.to_dict()))
    run = Run(tmp_path, "SpecArm", embodiment=SPEC)

    assert run.runner.robot.name == "SpecArm"
    assert not (tmp_path / "connected").exists()
    run.runner.run()

    (connected,) = run.log("connected")
    assert connected[0] != os.getpid()
    run.assert_within_limits()


def test_one_that_nobody_describes_is_built_here(tmp_path, module):
    (tmp_path / "spec.json").write_text(json.dumps(SPEC.to_dict()))

    with pytest.raises(FluxError, match="SpecArm has no embodiment"):
        Run(tmp_path, "SpecArm")


def test_a_camera_that_warms_up_is_waited_for(tmp_path, module):
    run = Run(tmp_path, fault="late")

    assert run.runner.run()["outcome"] == "max_steps"
    assert run.policy.seen[0]["front"][0, 0, 0] == 5


def test_a_slow_get_frame_makes_no_command_late(tmp_path, module):
    run = Run(tmp_path, fault="slow", max_publish_step=100)

    run.runner.run()

    gaps = np.diff(run.log("sent")[:, 0])
    assert len(run.policy.seen) >= 5
    # Several looks of 0.15 s: a thread that waited for one would miss seven commands.
    assert np.quantile(gaps, 0.95) < 0.03
    run.assert_within_limits()


def test_a_held_arm_hears_commands_while_the_next_episode_begins(tmp_path, module):
    """Some drivers stop an arm that hears nothing."""
    (tmp_path / "tasks.txt").write_text("1\n1\n")
    run = Run(tmp_path, task_file=str(tmp_path / "tasks.txt"), max_publish_step=25)
    run.policy.resets_s = 1.0

    assert run.runner.run()["episodes"] == 2

    sent = run.log("sent")
    assert np.diff(sent[:, 0]).max() < 0.5
    # Three resets of a second, of the second episode, in which the arm is held.
    rests = np.abs(np.diff(sent[:, 1:], axis=0)).max(axis=1) == 0.0
    assert rests.sum() > 100
    run.assert_within_limits()


@pytest.mark.parametrize(
    ("fault", "rule", "said"),
    [
        ("raises", "frame", r"OldArm\.get_frame\(\) raised RuntimeError: cable pulled"),
        ("size", "frame", r"camera front gives \(48, 64, 3\) uint8, the embodiment says"),
        # There is no get_state: what frames say of the arm is compared with its commands.
        ("blocked", "tracking", "shoulder is .* away from its command"),
    ],
)
def test_what_goes_wrong_stops_the_arm_and_is_named(tmp_path, module, fault, rule, said):
    run = Run(tmp_path, fault=fault, max_publish_step=500)
    # A policy that sees at once that an arm is blocked would not go on.
    run.policy.thinks_s = 0.4 if fault == "blocked" else 0.02

    with pytest.raises(SafetyStop, match=said):
        run.runner.run()

    assert [trip["rule"] for trip in run.episode["trips"]] == [rule]
    assert run.log("stopped")[0, 0] > run.log("sent")[-1, 0]
    if fault != "blocked":
        run.assert_within_limits()


def test_after_a_rearm_a_new_control_process_shows_its_frames(tmp_path, module):
    run = Run(tmp_path)

    def kill(observation, answer=run.policy.predict_action):
        if len(run.policy.seen) == 4:
            os.kill(run.runner._engine._process.pid, signal.SIGKILL)
        return answer(observation)

    run.policy.predict_action = kill
    with pytest.raises(SafetyStop, match="the control process was killed by SIGKILL"):
        run.runner.run()
    # The operator's own stop through a new connection was this process's.
    assert run.log("connected")[:, 0].tolist()[1:] == [os.getpid()]
    run.runner.latch.rearm()

    assert run.runner.run()["outcome"] == "max_steps"
    assert len(run.policy.seen) > 5
    assert len(set(run.log("connected")[:, 0])) == 3


def test_a_robot_whose_first_frame_never_comes(tmp_path, module):
    spec = SPEC.to_dict()
    Path(tmp_path / "users_arms.py").write_text(MODULE.replace("self._frames < 4", "True"))
    context = RunContext(section="inference", work_dir=tmp_path, task="1")
    runner = BaseInferenceRunner(
        context=context, policy=Looking(), task_descriptions={"1": "wave"}, ready_timeout=0.5,
        operator={"type": "OldArm", "folder": str(tmp_path), "spec": spec, "fault": "late"},
    )  # fmt: skip
    runner.run_setup()

    with pytest.raises(NotReady, match=r"no complete reading within 0\.5 s: the camera warms up"):
        runner.run()
    assert not (tmp_path / "sent").exists()


class SpecRun(Run):
    """Of the specification's operator and runner, from a config."""

    def __init__(self, folder, kind="SpecificationsRunner", **changed):
        self._folder, self.policy, self.notes = folder, Looking(), Notes()
        (folder / "spec.json").write_text(json.dumps(SPEC.to_dict()))
        table = {
            "type": kind,
            "operator": {"type": "SpecificationsOperator", "folder": str(folder)},
            "embodiment": SPEC.to_dict(),
            "task_descriptions": {"1": "wave"},
            "camera_names": ["front"],
            "record_fps": None,
            "max_publish_step": 60,
            **changed,
        }
        context = RunContext(
            config={"inference": table}, section="inference", work_dir=folder, task="1",
            reporter=self.notes,
        )  # fmt: skip
        self.runner = build_runner_from_cfg({**table, "policy": self.policy}, context)
        self.runner.run_setup()


def test_a_runner_with_commands_of_its_own_has_them_in_the_control_process(tmp_path, module):
    run = SpecRun(tmp_path, async_execution=True)

    assert not (tmp_path / "connected").exists()
    assert run.runner.run()["outcome"] == "max_steps"

    assert run.runner.divided
    (connected,) = run.log("connected")
    assert connected[0] != os.getpid()
    run.assert_within_limits()
    asked = run.policy.asked
    assert set(asked) == {"qpos", "images", "looks", "said", "task_description"}
    assert asked["qpos"].dtype == np.float32
    assert asked["images"]["front"].shape == (24, 32, 3)
    assert asked["looks"].tolist() == [len(run.policy.seen) + 1], "one look came before any answer"
    assert asked["said"] == {"in": connected[0]}
    assert run.runner.looks == 0, "this process's runner was not asked"
    (line,) = [line for line in run.notes.lines if "has no stop()" in line]
    assert "SpecificationsOperator has no stop(): it is stopped by commands that brake" in line


def test_such_an_arm_is_held_when_the_policy_keeps_the_interpreter(tmp_path, module):
    run = SpecRun(tmp_path, max_publish_step=1000)

    def keep(observation, answer=run.policy.predict_action):
        if len(run.policy.seen) == 4:
            ctypes.PyDLL(None).sleep(1)
        return answer(observation)

    run.policy.thinks_s, run.policy.predict_action = 0.0, keep
    with pytest.raises(SafetyStop, match=r"the main process did not run for 0\.\d+ s"):
        run.runner.run()

    assert [trip["rule"] for trip in run.episode["trips"]] == ["main process"]
    run.assert_within_limits()


def test_what_else_such_a_runner_does_keeps_it_in_one_process(tmp_path, module):
    with pytest.raises(ConfigError, match="by a method of its own, and Opening also has a run of"):
        SpecRun(tmp_path, "Opening", control_process=True)

    run = SpecRun(tmp_path, "Opening")
    assert not run.runner.divided
    run.runner.ros_operator.servoj(np.zeros(2))


def test_something_that_no_other_process_can_be_given_is_named(tmp_path, module):
    with pytest.raises(
        FluxError, match=r"update_observation_window\(\) has something that no other"
    ):
        SpecRun(tmp_path, "Strange").runner.run()

    assert not (tmp_path / "sent").exists()


def test_methods_of_the_operator_that_are_elsewhere_are_named(tmp_path, module):
    run = SpecRun(tmp_path)

    with pytest.raises(AttributeError, match="SpecificationsOperator runs in the control process"):
        run.runner.ros_operator.servoj(np.zeros(2))
