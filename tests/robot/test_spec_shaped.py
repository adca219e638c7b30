"""An operator and a runner as the specification writes them, which know nothing of limits."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from fluxvla_core.control.clock import SimulatedClock
from fluxvla_core.errors import (
    Faulted,
    LoadFailed,
    NotReady,
    RunFailed,
    SafetyStop,
    SpecMismatch,
)
from fluxvla_core.robot.runner import BaseInferenceRunner


class Bare:
    """``get_frame`` and commands of its own; connects in its constructor."""

    def __init__(self, spec, clock=True):
        self.joints = np.zeros(2)
        self.grip = 0.5
        self.sent = []
        self.frames = 0
        self.fault = None
        self.image_after = 0
        self.state_after = 0
        self._lock = threading.Lock()
        if clock:
            self.clock = SimulatedClock()

    def get_frame(self):
        self.frames += 1
        image = np.zeros((24, 32, 3), np.uint8)
        return {
            "img_front": image if self.frames > self.image_after else None,
            "joint_state": [*self.joints, self.grip] if self.frames > self.state_after else None,
        }

    def servoj(self, joint_positions):
        if self.fault is not None and len(self.sent) >= 10:
            raise self.fault
        self.joints = np.array(joint_positions)
        if hasattr(self, "clock"):
            self.clock.advance(0.02)

    def movegrip(self, gripper_position):
        self.grip = float(gripper_position)
        self.sent.append(np.array([*self.joints, self.grip]))


class SpecRunner(BaseInferenceRunner):
    """The three methods of the specification's example."""

    def __init__(self, prepare_pose=None, *args, **kwargs):
        super().__init__(*args, prepare_pose=prepare_pose, **kwargs)

    def get_ros_observation(self):
        frame = self.ros_operator.get_frame()
        return frame["img_front"], frame["joint_state"]

    def update_observation_window(self):
        img_front, joint_state = self.get_ros_observation()
        return {
            "qpos": np.array(joint_state, dtype=np.float32),
            "images": {"front": img_front},
        }

    def _execute_actions(self, actions, rate):
        for action in actions:
            self.ros_operator.servoj(action[:2])
            self.ros_operator.movegrip(action[2])
            rate.sleep()


@pytest.fixture
def bare(bench):
    spec = bench.arm.embodiment
    bench.arm = Bare(spec)
    bench.arm.embodiment_given = spec
    return bench


def run(bare, **arguments):
    spec = arguments.pop("embodiment", bare.arm.embodiment_given)
    return bare.run(cls=SpecRunner, embodiment=spec, **arguments)


def assert_within(bare):
    spec = bare.arm.embodiment_given
    path = np.vstack([[0, 0, 0.5], [0, 0, 0.5], *bare.arm.sent])
    speed = np.diff(path, axis=0) * spec.rate_hz
    push = np.diff(speed, axis=0) * spec.rate_hz
    for index, joint in enumerate(spec.joints):
        assert joint.lower <= path[:, index].min()
        assert path[:, index].max() <= joint.upper
        assert np.abs(speed[:, index]).max() <= joint.velocity
        assert np.abs(push[:, index]).max() <= joint.acceleration


def test_its_own_commands_get_chunks_that_have_passed_the_safety(bare):
    bare.policy.goal, bare.policy.stride = 1.7, 0.4

    result = run(bare, prepare_pose=[-0.4, 0.3, 1.0], max_publish_step=120)

    assert result["outcome"] == "max_steps"
    assert bare.arm.joints[0] == 1.5
    assert_within(bare)
    commands = [row["command"] for row in bare.trace() if row["event"] == "command"]
    np.testing.assert_array_equal(commands, bare.arm.sent)
    assert bare.episode()["clamps"]["shoulder"].keys() >= {"position"}


def test_its_embodiment_may_be_a_plain_table(bare):
    table = bare.arm.embodiment_given.to_dict()

    assert run(bare, embodiment=table)["outcome"] == "max_steps"


def test_without_an_embodiment_it_is_refused(bare):
    with pytest.raises(LoadFailed, match="Bare has no embodiment: which joints it moves") as caught:
        run(bare, embodiment=None)
    assert "give the section embodiment = dict(name=" in str(caught.value)
    assert bare.arm.sent == []


def test_a_runner_that_does_not_send_needs_send_action(bare):
    with pytest.raises(LoadFailed, match=r"Bare has no send_action\(\); no command could be sent"):
        bare.run(embodiment=bare.arm.embodiment_given)


def test_an_operator_without_readings_is_refused(bench):
    class Blind:
        pass

    with pytest.raises(LoadFailed, match=r"Blind does not fulfil .*get_frame\(\) is missing"):
        bench.run(cls=SpecRunner, operator=Blind(), embodiment=bench.arm.embodiment)


def test_an_operator_that_is_sent_actions_and_cannot_be_stopped_is_refused(bench, make_arm):
    arm = type("Runaway", (make_arm,), {"stop": None})()

    with pytest.raises(LoadFailed, match=r"Runaway .*operators: stop\(\) is missing"):
        bench.runner(operator=arm)
    assert arm.calls == []


def test_joint_states_that_come_after_the_images_are_waited_for(bare):
    """The specification's runner makes one NaN of a state that is None."""
    bare.arm.state_after = 3

    run(bare)

    assert bare.arm.frames > 3
    assert bare.arm.sent


def test_one_without_a_stop_is_held_by_its_runners_commands_and_that_is_said(bare):
    bare.policy.faults[2] = ValueError("x")

    with pytest.raises(RunFailed, match="the policy raised ValueError"):
        run(bare)

    (line,) = [line for line in bare.notes.lines if "has no stop()" in line]
    assert "Bare has no stop(): it is stopped by commands that brake" in line
    assert_within(bare)
    np.testing.assert_allclose(bare.arm.sent[-1], bare.arm.sent[-2], atol=1e-2)


def test_an_embodiment_that_is_none_is_refused(bench):
    bench.arm.embodiment = {"name": "x"}
    with pytest.raises(LoadFailed, match=r"Arm.embodiment is a dict, not an EmbodimentSpec"):
        bench.run()


def test_a_stream_that_has_not_come_yet_is_waited_for(bare):
    bare.arm.image_after = 3

    assert run(bare)["outcome"] == "max_steps"


def test_a_stream_that_never_comes_is_named(bare):
    bare.arm.image_after = 10**9

    with pytest.raises(NotReady, match="there is no image of front yet"):
        run(bare, ready_timeout=0.1)
    assert bare.arm.sent == []


def test_a_policys_fault_brakes_through_the_runners_own_commands(bare):
    bare.policy.stride = 0.2

    def broken(chunk):
        chunk[0, 0] = np.nan
        return chunk

    bare.policy.faults[2] = broken

    with pytest.raises(SafetyStop, match="not finite"):
        run(bare)
    assert_within(bare)
    assert [row["phase"] for row in bare.trace() if row["event"] == "command"][-1] == "stop"
    np.testing.assert_allclose(bare.arm.sent[-1], bare.arm.sent[-2], atol=1e-2)


def test_a_fault_of_its_own_ends_the_run(bare):
    bare.arm.fault = OSError("cable pulled")

    with pytest.raises(OSError, match="cable pulled"):
        run(bare)
    assert bare.episode()["problem"] == "OSError: cable pulled"
    assert bare.episode()["trips"][0]["rule"] == "execute"


def test_a_loop_without_a_rate_is_recorded_and_limited_all_the_same(bare):
    class Own(SpecRunner):
        def _execute_actions(self, actions, rate):
            for action in actions:
                self.ros_operator.servoj(action[:2])
                self.ros_operator.movegrip(action[2])

    result = bare.run(cls=Own, embodiment=bare.arm.embodiment_given)

    assert result["outcome"] == "max_steps"
    assert_within(bare)


def test_a_loop_that_plays_half_of_a_chunk_goes_on_from_there(bare):
    class Half(SpecRunner):
        def _execute_actions(self, actions, rate):
            super()._execute_actions(actions[: max(1, len(actions) // 2)], rate)

    bare.policy.stride = 0.2
    bare.run(cls=Half, embodiment=bare.arm.embodiment_given)

    assert_within(bare)


def test_in_real_time_the_arm_is_held_by_its_own_commands_while_the_policy_thinks(bare):
    import time

    bare.arm = Bare(bare.policy.embodiment, clock=False)
    bare.arm.embodiment_given = bare.policy.embodiment

    def slow(chunk):
        time.sleep(0.1)
        return chunk

    bare.policy.faults = dict.fromkeys(range(3, 9), slow)

    run(bare, max_publish_step=50)

    assert_within(bare)
    assert len(bare.arm.sent) >= 50


def test_a_config_may_narrow_a_robots_limits_and_not_widen_them(bench):
    from dataclasses import replace

    spec = bench.arm.embodiment
    slow = replace(spec, joints=tuple(replace(j, velocity=j.velocity / 4) for j in spec.joints))
    bench.policy.goal = 1.0
    bench.run(embodiment=slow)
    path = np.vstack(bench.arm.sent)
    assert np.abs(np.diff(path[:, 0]) * 50).max() <= 0.5

    fast = replace(spec, joints=tuple(replace(j, velocity=j.velocity * 4) for j in spec.joints))
    with pytest.raises(SpecMismatch, match="widens velocity of shoulder to 8; the robot's own"):
        bench.run(embodiment=fast)
    smooth = replace(spec, joints=tuple(replace(j, jerk=500.0) for j in spec.joints))
    bench.arm.embodiment = smooth
    with pytest.raises(SpecMismatch, match=r"widens jerk of shoulder to inf; .* limit is 500"):
        bench.run(embodiment=spec)


def test_what_an_operator_raises_on_connecting_is_named(bench):
    def connect():
        raise OSError("no route to host")

    bench.arm.connect = connect
    with pytest.raises(Faulted, match=r"Arm\.connect raised OSError: no route to host"):
        bench.run()
    assert bench.arm.calls == ["stop", "close"]
