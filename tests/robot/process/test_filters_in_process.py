"""Filters of a config in a real control process: late ones are left out, counted, and stop."""

from __future__ import annotations

import importlib
import json
import sys

import numpy as np
import pytest

from fluxvla_core.build import RunContext
from fluxvla_core.errors import SafetyStop
from fluxvla_core.plugins.registry import ACTION_FILTERS, OPERATORS
from fluxvla_core.robot.process.timed_filters import MOST_LATE
from fluxvla_core.robot.runner import BaseInferenceRunner
from fluxvla_core.spec import Camera, EmbodimentSpec, Joint

pytestmark = pytest.mark.realtime

MODULE = '''
import time

import numpy as np

from fluxvla_core.contracts.frame import Frame
from fluxvla_core.contracts.robot import ActionFilter, Operator
from fluxvla_core.spec import EmbodimentSpec


class FileArm(Operator):
    """Follows at once; where it is is in a file that both processes have."""

    api = "1.0"

    def __init__(self, file, spec):
        self.embodiment = EmbodimentSpec.from_dict(spec)
        self._file = file

    def without_cameras(self):
        return self

    def without_commands(self):
        return self

    def connect(self):
        self._state = np.memmap(self._file, np.float64, "r+")

    def get_frame(self):
        now = time.monotonic()
        images = {"front": np.zeros((24, 32, 3), np.uint8)}
        return Frame(np.array(self._state), images, {"state": now, "front": now})

    def get_state(self):
        return np.array(self._state)

    def state_stamp(self):
        return time.monotonic()

    def send_action(self, action):
        self._state[:] = action
        with open(self._file + ".sent", "a") as log:
            log.write(" ".join(map(repr, map(float, action))) + "\\n")

    def stop(self): ...

    def close(self): ...


class Sometimes(ActionFilter):
    """Takes too long once in ten commands; otherwise lifts the elbow."""

    def __init__(self):
        self.calls = 0

    def __call__(self, action):
        self.calls += 1
        if self.calls % 10 == 0:
            time.sleep(0.015)
        return action + [0.0, 0.1]


class Hangs(Sometimes):
    def __call__(self, action):
        self.calls += 1
        if self.calls > 10:
            time.sleep(3600)
        return action
'''
SPEC = EmbodimentSpec(
    "testarm",
    (
        Joint("shoulder", "rad", -1.0, 1.5, 2.0, 10.0),
        Joint("elbow", "rad", -2.0, 2.0, 3.0, 20.0),
    ),
    (Camera("front", 24, 32),),
    50.0,
)


class Waver:
    embodiment = SPEC
    action_rate_hz = 10.0
    horizon = 5

    def reset(self, seed): ...

    def predict_action(self, observation):
        pose = np.asarray(observation["qpos"], dtype=np.float64)
        chunk = np.repeat(pose[None], 5, axis=0)
        chunk[:, 0] = np.minimum(pose[0] + 0.05 * np.arange(1, 6), 1.0)
        chunk[:, 1] = 0.0
        return chunk


class Notes:
    def __init__(self):
        self.warnings = []

    def info(self, text): ...

    def warn(self, text):
        self.warnings.append(text)

    def progress(self, *what): ...

    def metric(self, *what): ...

    def artifact(self, *what): ...


@pytest.fixture
def module(tmp_path, monkeypatch):
    (tmp_path / "users_filters.py").write_text(MODULE)
    monkeypatch.syspath_prepend(str(tmp_path))
    made = importlib.import_module("users_filters")
    OPERATORS.register_module()(made.FileArm)
    ACTION_FILTERS.register_module()(made.Sometimes)
    ACTION_FILTERS.register_module()(made.Hangs)
    yield made
    OPERATORS.unregister("FileArm")
    for name in ("Sometimes", "Hangs"):
        ACTION_FILTERS.unregister(name)
    del sys.modules["users_filters"]


class Run:
    """A run of the arm with one filter, and what it left behind."""

    def __init__(self, folder, filters):
        self._folder = folder
        np.zeros(2).tofile(folder / "state")
        table = {"type": "FileArm", "file": str(folder / "state"), "spec": SPEC.to_dict()}
        self.notes = Notes()
        context = RunContext(section="inference", work_dir=folder, task="1", reporter=self.notes)
        self.runner = BaseInferenceRunner(
            context=context, operator=table, policy=Waver(), task_descriptions={"1": "wave"},
            action_filters=[{"type": name} for name in filters], max_publish_step=60,
            record_fps=None, control_process=True,
            # Machines that run tests stall for a second; here that is forgiven.
            safety={"silence_s": 5.0, "max_age_s": 5.0, "max_skew_s": 5.0},
        )  # fmt: skip
        self.runner.run_setup()

    @property
    def episode(self):
        folder = self._folder / "inference" / "001-1"
        return json.loads((folder / "episode.json").read_text())

    @property
    def trace(self):
        lines = (self._folder / "inference" / "001-1" / "trace.jsonl").read_text().splitlines()
        return [json.loads(line) for line in lines]

    def assert_within_limits(self):
        path = np.vstack([np.zeros((2, 2)), np.loadtxt(self._folder / "state.sent")])
        speed = np.diff(path, axis=0) * 50.0
        push = np.diff(speed, axis=0) * 50.0
        assert (np.abs(speed).max(axis=0) <= [2.0 + 1e-9, 3.0 + 1e-9]).all()
        assert (np.abs(push).max(axis=0) <= [10.0 + 1e-6, 20.0 + 1e-6]).all()
        assert np.abs(speed[-1]).max() < 1e-9


def test_a_filter_that_is_late_now_and_then(tmp_path, module):
    run = Run(tmp_path, ["Sometimes"])

    run.runner.run()

    summary = run.episode
    assert summary["outcome"] == "max_steps"
    late = summary["late_filters"]
    assert set(late) == {"Sometimes"}
    assert late["Sometimes"] >= 5
    left_out = [event for event in run.trace if event["event"] == "filter"]
    assert [event["filter"] for event in left_out] == ["Sometimes"] * late["Sometimes"]
    said = [text for text in run.notes.warnings if "Sometimes" in text]
    assert said == [
        "action filter Sometimes did not return within 10 ms and was left out of a command"
    ]
    run.assert_within_limits()


def test_a_filter_that_hangs_stops_the_arm_and_is_named(tmp_path, module):
    run = Run(tmp_path, ["Sometimes", "Hangs"])

    with pytest.raises(SafetyStop, match="action filter Hangs did not return"):
        run.runner.run()

    (trip,) = run.episode["trips"]
    assert trip["rule"] == "filter"
    assert run.episode["outcome"] == "failed"
    assert run.episode["late_filters"]["Hangs"] == MOST_LATE
    assert run.runner.latch.tripped is not None
    run.assert_within_limits()
