"""A runner that sends commands by methods of its own, as a whole in a real control process."""

from __future__ import annotations

import ctypes
import json
import os

import numpy as np
import pytest

from fluxvla_core.build import RunContext, build_runner_from_cfg
from fluxvla_core.errors import ConfigError, FluxError, SafetyStop

from .whole import PATIENT, SPEC, Looking, Notes, Run, module

__all__ = ["module"]

pytestmark = pytest.mark.realtime


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
            "safety": PATIENT,
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
    run = SpecRun(tmp_path, max_publish_step=1000, safety={})

    def keep(observation, answer=run.policy.predict_action):
        if len(run.policy.seen) == 4:
            ctypes.PyDLL(None).sleep(1)
        return answer(observation)

    run.policy.thinks_s, run.policy.predict_action = 0.0, keep
    with pytest.raises(SafetyStop, match=r"the main process did not run for \d+\.\d+ s"):
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
