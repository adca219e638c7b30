"""Arms that cannot be divided, and runs of one that a control process has as a whole."""

from __future__ import annotations

import importlib
import json
import sys
import time

import numpy as np
import pytest

from fluxvla_core.build import RunContext
from fluxvla_core.plugins.registry import OPERATORS, RUNNERS
from fluxvla_core.robot.runner import BaseInferenceRunner
from fluxvla_core.spec import Camera, EmbodimentSpec, Joint

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
from fluxvla_core.spec import EmbodimentSpec


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
# Machines that run tests stall for a second; where silence is not what is tested, it is forgiven.
PATIENT = {"silence_s": 5.0, "max_age_s": 5.0, "max_skew_s": 5.0}
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
            record_fps=None,
            **{"max_publish_step": 60, "async_execution": True, "safety": PATIENT, **changed},
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
