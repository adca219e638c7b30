"""What does not fit is refused before anything moves, and before the robot is connected."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest

from fluxvla_core.errors import CheckpointError, ConfigError, LoadFailed, SpecMismatch, UsageError
from fluxvla_core.spec import Camera, Joint


def refused(bench, kind, match, **arguments):
    with pytest.raises(kind, match=match) as caught:
        bench.run(**arguments)
    assert bench.arm.calls == []
    assert bench.arm.sent == []
    return caught.value


def test_an_unknown_task_is_refused_with_the_known_ones(bench):
    error = refused(bench, UsageError, "unknown task '99'; nothing was moved", task="99")

    assert error.exit_code == 2
    assert "1: wave at the camera\n  2: lift the red cube" in str(error)


def test_no_task_and_no_terminal_is_an_error(bench, monkeypatch):
    monkeypatch.setattr("sys.stdin.isatty", lambda: False)

    with pytest.raises(UsageError, match="no task was given, and there is no terminal") as caught:
        bench.run(task=None)
    assert "--task with one of 1, 2" in str(caught.value)
    assert caught.value.exit_code == 2
    assert bench.arm.sent == []


def test_a_policy_that_knows_nothing_of_a_robot(bench):
    match = "RandomPolicy cannot drive a robot: it has no embodiment, action_rate_hz"
    error = refused(bench, LoadFailed, match, policy={"type": "RandomPolicy"})

    assert error.exit_code == 2


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("action_rate_hz", -1, "action_rate_hz is -1; it must be positive and finite"),
        ("action_rate_hz", 0, "action_rate_hz is 0;"),
        ("action_rate_hz", float("inf"), "action_rate_hz is inf;"),
        ("action_rate_hz", None, "action_rate_hz is None;"),
        ("horizon", 0, "horizon is 0; it must be a whole number of at least 1"),
        ("horizon", "5", "horizon is '5';"),
        ("embodiment", {"name": "x"}, "embodiment is a dict, no EmbodimentSpec"),
        ("cameras", "front", "cameras is 'front', and no tuple of names"),
    ],
)
def test_a_policy_that_says_nonsense_of_itself(bench, name, value, message):
    setattr(bench.policy, name, value)

    refused(bench, LoadFailed, f"Waver cannot drive a robot: {re.escape(message)}")


def test_a_policy_for_another_robot(bench):
    joints = bench.policy.embodiment.joints
    swapped = (joints[1], joints[0], joints[2])
    bench.policy.embodiment = replace(bench.policy.embodiment, joints=swapped, name="other")

    error = refused(bench, SpecMismatch, r"the policy \(other\) and the robot \(testarm\) do not")
    assert "joints and their order: ['elbow', 'shoulder', 'jaw']" in str(error)
    assert error.exit_code == 2


def test_a_base_among_the_joints(bench, make_arm):
    """It would roll on while a person is asked for the next task."""
    arm = bench.arm.embodiment
    wheels = tuple(Joint(f"base_{way}", "m", -0.5, 0.5, 1, 1) for way in ("linear", "angular"))
    bench.arm = make_arm(embodiment=replace(arm, joints=(*arm.joints, *wheels)))

    error = refused(bench, SpecMismatch, "speeds by their names: base_linear, base_angular; a mob")
    assert "Joint.base(name, unit, speed, acceleration)" in str(error)
    assert error.exit_code == 2


def test_a_base_among_the_joints_that_a_config_gives(bench):
    table = bench.arm.embodiment.to_dict()
    table["joints"][0]["unit"] = "m/s"

    refused(bench, SpecMismatch, "joint shoulder: unit 'm/s' is a speed's", embodiment=table)


def test_a_camera_that_the_robot_does_not_have(bench):
    cameras = (*bench.policy.embodiment.cameras, Camera("wrist", 24, 32))
    bench.policy.embodiment = replace(bench.policy.embodiment, cameras=cameras)

    refused(bench, SpecMismatch, "cameras: wrist missing; there are")


def test_a_camera_with_another_view_than_in_training(bench):
    trained = replace(bench.policy.embodiment, cameras=(Camera("front", 32, 32),))
    bench.policy.embodiment = trained

    refused(
        bench,
        SpecMismatch,
        "camera front gives 24 x 32 images; the policy was trained on 32 x 32: another view",
    )


def test_a_camera_with_more_pixels_than_in_training_is_said(bench):
    trained = replace(bench.policy.embodiment, cameras=(Camera("front", 12, 16),))
    bench.policy.embodiment = trained

    bench.run(max_publish_step=5)

    (line,) = [line for line in bench.notes.lines if line.startswith("warning")]
    assert line.endswith("24 x 32 images; the policy was trained on 12 x 16; they are scaled")


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["front", "back"], "camera_names 'back' is unknown; choose one of front"),
        (["side"], "camera_names 'side' is unknown; choose one of front"),
    ],
)
def test_camera_names_must_be_the_robots(bench, names, message):
    refused(bench, ConfigError, message, camera_names=names)


def test_the_cameras_that_the_policy_looks_at_must_be_observed(bench):
    spec = replace(bench.arm.embodiment, cameras=(Camera("front", 24, 32), Camera("side", 8, 8)))
    bench.arm.embodiment = spec

    refused(
        bench, ConfigError, "camera_names the policy looks at 'front' too", camera_names=["side"]
    )


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        ([0.0, 0.0], "prepare_pose has 2 values, testarm has 3 joints: shoulder, elbow, jaw"),
        ([9.0, 0.0, 0.0], r"prepare_pose puts shoulder at 9, outside its limits \[-1, 1.5\] rad"),
        ([0.0, float("nan"), 0.0], "prepare_pose puts elbow at nan"),
    ],
)
def test_a_start_pose_that_cannot_be(bench, pose, message):
    refused(bench, ConfigError, message, prepare_pose=pose)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"state_dim": 7}, "state_dim is 7; testarm has 3 state values"),
        ({"publish_rate": 100}, "publish_rate is 100 Hz; testarm takes up to 50 commands"),
        ({"publish_rate": 25}, "each command to this simulation lasts 1/50 s"),
        ({"chunk_joining": "overlapp"}, "method 'overlapp'; did you mean 'overlap'?"),
        (
            {"chunk_joining": "synchronous", "async_execution": True},
            "chunk_joining is 'synchronous', and async_execution is set",
        ),
        (
            {"chunk_joining": "rtc"},
            "chunk_joining is 'rtc', and Waver cannot continue a chunk",
        ),
        ({"simulated_latency": -1}, "simulated_latency must be 0 or more, got -1"),
        ({"simulated_latency": float("nan")}, "simulated_latency must be 0 or more, got nan"),
        ({"execute_horizon": 0}, "execute_horizon must be at least 1, got 0"),
        ({"action_chunk": 0}, "action_chunk must be at least 1, got 0"),
        ({"max_publish_step": 0}, "max_publish_step must be at least 1, got 0"),
        ({"operator": None}, "BaseInferenceRunner has no operator"),
        ({"safety": {"velocity_scale": 2}}, "safety.velocity_scale must be above 0 and at most 1"),
        ({"safety": {"max_age": 1}}, "safety has no setting 'max_age'; did you mean max_age_s"),
    ],
)
def test_values_that_make_no_sense(bench, arguments, message):
    refused(bench, ConfigError, message, **arguments)


def test_messages_name_the_place_in_the_config(bench):
    from fluxvla_core.build import RunContext
    from fluxvla_core.robot.runner import BaseInferenceRunner

    context = RunContext(section="inference", origins={"inference.state_dim": "arm.py:12"})
    with pytest.raises(ConfigError) as caught:
        BaseInferenceRunner(context=context, operator=bench.arm, state_dim=7)
    assert str(caught.value).startswith("arm.py:12: inference.state_dim: state_dim is 7")


@pytest.mark.realtime
def test_a_robot_has_a_latency_of_its_own(bench, make_arm):
    bench.arm = make_arm(realtime=True)

    refused(
        bench,
        ConfigError,
        "simulated_latency is for simulations; this robot has its own",
        simulated_latency=0.1,
    )


@pytest.mark.realtime
def test_a_slower_rate_is_allowed_on_a_robot(bench, make_arm):
    bench.arm = make_arm(realtime=True)

    assert bench.runner(publish_rate=25).publish_rate == 25.0


def test_without_a_checkpoint_there_is_no_policy(bench, tmp_path, monkeypatch):
    trained = tmp_path / "demo_out" / "default" / "work"
    for folder in (trained, trained / "checkpoints" / "step-000000003", tmp_path / "other"):
        folder.mkdir(parents=True)
        (folder / "config.resolved.json").write_text("{}")
    (trained / "checkpoints" / "step-000000003" / "manifest.json").write_text("{}")
    monkeypatch.chdir(tmp_path)
    error = refused(bench, CheckpointError, "there is no undamaged checkpoint in", policy=None)

    assert error.next == (
        "train first (--section runner), or name the work dir of a training, such as "
        "demo_out/default/work: --work-dir demo_out/default/work"
    )


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"a b": "wave now"}, "an id is one word, got 'a b'"),
        ({"1": " "}, "task '1' has no instruction"),
    ],
)
def test_task_descriptions_must_make_sense(bench, table, message):
    refused(bench, UsageError, message, task_descriptions=table)


def test_an_unknown_keyword_is_no_silent_default(bench):
    with pytest.raises(ConfigError, match="max_publish_steps"):
        bench.runner(max_publish_steps=3)
