"""An operator that cannot be divided, as a whole in a real control process."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import numpy as np
import pytest

from fluxvla_core.build import RunContext
from fluxvla_core.errors import FluxError, NotReady, SafetyStop
from fluxvla_core.robot.process import control_process
from fluxvla_core.robot.recording.recorded import find_recordings, open_recording
from fluxvla_core.robot.runner import BaseInferenceRunner

from .whole import MODULE, SPEC, Looking, Run, module

__all__ = ["module"]

pytestmark = pytest.mark.realtime


class LookingBack(Looking):
    """Notes the frames that each question shows."""

    n_obs_steps = 3

    def __init__(self):
        super().__init__()
        self.frames = []

    def predict_action(self, observation):
        shown = [*observation["history"], observation]
        self.frames.append([int(each["images"]["front"][0, 0, 0]) for each in shown])
        return super().predict_action(observation)


def test_a_policy_of_several_observations_sees_what_was_between_two_questions(tmp_path, module):
    run = Run(tmp_path, async_execution=False)
    run.runner.policy = run.policy = LookingBack()
    run.runner.run_setup()
    run.runner.run()

    assert run.runner.divided
    asked = run.policy.frames
    assert len(set(asked[0])) == 1
    later = asked[-1]
    assert len(asked) >= 3
    assert asked[-2][-1] < later[0] < later[1] < later[2]


def test_an_episode_with_images_of_the_process_that_commands(tmp_path, module):
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
            recorded.images["front"],
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
    # Several looks of 0.15 s: a thread that waited for one would miss seven commands, at every
    # second one. A machine that is busy with others misses a few.
    assert np.quantile(gaps, 0.8) < 0.05
    run.assert_within_limits()


def test_a_held_arm_hears_commands_while_the_next_episode_begins(tmp_path, module):
    """Some drivers stop an arm that hears nothing."""
    (tmp_path / "tasks.txt").write_text("1\n1\n")
    run = Run(tmp_path, task_file=str(tmp_path / "tasks.txt"), max_publish_step=25)
    run.policy.resets_s = 2.0

    assert run.runner.run()["episodes"] == 2

    sent = run.log("sent")
    # Shorter than one reset, by more than a machine stands still.
    assert np.diff(sent[:, 0]).max() < 1.5
    # Three resets of two seconds, of the second episode, in which the arm is held.
    rests = np.abs(np.diff(sent[:, 1:], axis=0)).max(axis=1) == 0.0
    assert rests.sum() > 200
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


def test_ctrl_c_while_the_control_process_is_started_leaves_none(tmp_path, module, monkeypatch):
    run, started, launch = Run(tmp_path), [], control_process.launch

    def launch_and_interrupt(*arguments):
        process, link = launch(*arguments)
        started.append(process)
        os.kill(os.getpid(), signal.SIGINT)
        return process, link

    monkeypatch.setattr(control_process, "launch", launch_and_interrupt)
    with pytest.raises(KeyboardInterrupt):
        run.runner.run()
    assert [process.poll() is None for process in started] == [False]
    assert not (tmp_path / "sent").exists()


def test_a_robot_whose_first_frame_never_comes(tmp_path, module):
    spec = SPEC.to_dict()
    Path(tmp_path / "users_arms.py").write_text(MODULE.replace("self._frames < 4", "True"))
    context = RunContext(section="inference", work_dir=tmp_path, task="1")
    runner = BaseInferenceRunner(
        context=context, policy=Looking(), task_descriptions={"1": "wave"}, ready_timeout=0.5,
        operator={"type": "OldArm", "folder": str(tmp_path), "spec": spec, "fault": "late"},
    )  # fmt: skip
    runner.run_setup()

    with pytest.raises(NotReady, match=r"no complete frame within 0\.5 s: the camera warms up"):
        runner.run()
    assert not (tmp_path / "sent").exists()
