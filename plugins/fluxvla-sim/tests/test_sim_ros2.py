"""Simulated robots over ROS 2: another process, the real robots' topics, the real operators."""

from __future__ import annotations

import signal
import time

import numpy as np
import pytest
from fluxvla_aloha.operator import AlohaOperator
from fluxvla_aloha.runner import AlohaInferenceRunner
from fluxvla_sim.aloha.arms import HOME
from fluxvla_sim.ur import HOME as UR_HOME
from fluxvla_ur.operator import UROperator

from fluxvla_core import BaseInferenceRunner, RunContext
from fluxvla_core.errors import Faulted
from fluxvla_core.ros2 import Stale
from fluxvla_core.testing.ros2 import ros_domain

from .simulated import ALOHA, PATIENT, SILENT_S, UR, connect, drive, simulate, topics, wait_for

__all__ = ["connect", "ros_domain", "simulate", "topics"]


def stamps(messages):
    """Seconds, oldest first."""
    found = [message.header.stamp for message in list(messages)]
    return [stamp.sec + stamp.nanosec * 1e-9 for stamp in found]


def says(operator, what=""):
    """What ``get_state`` says is wrong if it is ``what``; None if it is not, or nothing is."""
    try:
        operator.get_state()
    except Stale as error:
        return error.what if what in error.what else None
    return None


@pytest.mark.realtime
class TestAloha:
    def test_it_is_driven_reset_and_made_ill_through_topics(self, simulate, connect, topics):
        simulate("aloha", "--ros2", "--cameras", "top")
        operator = connect(AlohaOperator, **ALOHA)
        frame = operator.get_frame()
        np.testing.assert_allclose(frame.state, HOME, atol=0.02)
        assert frame.images["top"].std() > 10, "the image shows nothing"
        assert topics.facts()["steps"] == 0

        target = HOME.copy()
        target[[0, 6, 13]] = 0.4, 0.8, 0.9
        drive(operator, target, lambda state: np.allclose(state, target, atol=0.06))
        facts = topics.facts()
        assert facts["steps"] > 50
        assert [task["success"] for task in facts["tasks"].values()] == [False, False]

        topics.tell("/sim/reset", 3)
        wait_for(lambda: np.allclose(operator.get_state(), HOME, atol=0.02))
        wait_for(lambda: topics.facts()["steps"] == 0)

    def test_it_has_depth_and_a_base_which_a_stop_stops(
        self, simulate, connect, topics, monkeypatch
    ):
        # It would end a speed too, a quarter of a second after it was asked for.
        monkeypatch.setattr(AlohaOperator, "_tick", lambda operator: None)
        simulate("aloha", "--ros2", "--cameras", "top")
        speeds = topics.listen("/cmd_vel", "geometry_msgs.msg:Twist")
        operator = connect(AlohaOperator, use_depth_image=True, use_robot_base=True, **ALOHA)
        frame = operator.get_frame()
        assert 0.4 < np.nanmin(frame.depths["top"]) < np.nanmax(frame.depths["top"]) < 0.9
        assert frame.base.tolist() == [0.0, 0.0]

        def drives():
            operator.drive(0.2, -0.1)
            time.sleep(0.02)
            return np.allclose(operator.get_frame().base, [0.2, -0.1])

        wait_for(drives)
        wait_for(lambda: drives() and operator.newest("base").message.pose.pose.position.x > 0.05)
        operator.stop()
        wait_for(lambda: speeds and speeds[-1].linear.x == speeds[-1].angular.z == 0.0)
        wait_for(lambda: operator.get_frame().base.tolist() == [0.0, 0.0])

    def test_states_come_as_often_and_as_late_as_they_are_to(self, simulate, topics):
        simulate("aloha", "--ros2", "--cameras", "top", "--state-hz", "200",
                 "--latency", "left arm=3")  # fmt: skip
        kind = "sensor_msgs.msg:JointState"
        left, right = (topics.listen(f"/puppet/joint_{side}", kind) for side in ("left", "right"))
        wait_for(lambda: min(len(left), len(right)) == left.maxlen, 60.0)
        delayed, prompt = stamps(left), stamps(right)
        assert prompt[-1] - delayed[-1] > 2.5
        # A machine that stalls says fewer; 50 Hz would be 20 ms.
        assert 0.004 < np.mean(np.diff(prompt)) < 0.015
        assert (np.diff(delayed) > 0).all()

    def test_a_stream_that_is_made_ill_is_named_and_may_get_well(self, simulate, connect, topics):
        simulate("aloha", "--ros2", "--cameras", "top")
        operator = connect(AlohaOperator, **{**ALOHA, "max_age_s": SILENT_S})
        topics.tell("/sim/fault", "top=drop")
        wait_for(lambda: says(operator, r"top (/camera_f/color/image_raw) is silent for"))
        topics.tell("/sim/fault", "top=well")
        wait_for(lambda: says(operator) is None)

    @pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
    def test_a_signal_ends_it_in_order(self, simulate, number):
        process = simulate("aloha", "--ros2", "--cameras", "top")
        assert "simulating aloha" in process.stdout.readline()
        process.send_signal(number)
        output, errors = process.communicate(timeout=60)

        assert process.returncode == 0, errors
        assert "periods" in output

    def test_it_ends_by_itself(self, simulate):
        process = simulate("aloha", "--ros2", "--cameras", "top", "--seconds", "1")
        output, errors = process.communicate(timeout=60)

        assert process.returncode == 0, errors
        assert int(output.rpartition('"')[0].partition(" periods")[0].rpartition('"')[2]) <= 51


class Waist:
    """A policy that turns both waists; answers at 10 Hz, five actions at a time."""

    action_rate_hz = 10.0
    horizon = 5
    cameras = ("top",)

    def __init__(self, embodiment, second_time=lambda: None):
        self.embodiment = embodiment
        self.asked = 0
        self._second_time = second_time

    def reset(self, seed):
        self.asked = 0

    def predict_action(self, observation):
        assert observation["images"]["top"].shape == (48, 64, 3)
        self.asked += 1
        if self.asked == 2:
            self._second_time()
        chunk = np.tile(observation["qpos"].astype(np.float64), (self.horizon, 1))
        chunk[:, [6, 13]] = np.clip(chunk[:, [6, 13]], 0.0, 1.0)
        chunk[:, [0, 7]] += 0.05 * np.arange(1, self.horizon + 1)[:, None]
        return chunk


def runner(tmp_path, second_time=lambda: None, max_age_s=PATIENT["max_age_s"], **arguments):
    operator = AlohaOperator(rate_window_s=0.0, **{**ALOHA, "max_age_s": max_age_s})
    return AlohaInferenceRunner(
        policy=Waist(operator.embodiment, second_time),
        operator=operator,
        task_descriptions={"1": "turn"},
        safety={"max_age_s": 2 * max_age_s, "max_skew_s": max_age_s, "starvation_s": 20.0},
        context=RunContext(work_dir=tmp_path, task="1", section="inference"),
        record_fps=None,
        **arguments,
    )


@pytest.mark.realtime
@pytest.mark.parametrize("async_execution", [False, True])
def test_a_policy_drives_the_robot_through_the_loop(simulate, tmp_path, async_execution):
    simulate("aloha", "--ros2", "--cameras", "top")
    run = runner(tmp_path, max_publish_step=100, async_execution=async_execution)
    run.run_setup()
    result = run.run()

    assert result["outcome"] == "max_steps"
    assert run.policy.asked >= 4
    assert run.ros_operator.last_action[0] > 0.2


@pytest.mark.realtime
@pytest.mark.parametrize("stream", ["top", "left arm"])
def test_a_stream_that_dies_stops_the_arm_and_is_named(simulate, topics, tmp_path, stream):
    simulate("aloha", "--ros2", "--cameras", "top")
    fault = f"{stream}=drop"
    run = runner(tmp_path, lambda: topics.tell("/sim/fault", fault), max_age_s=SILENT_S)
    run.run_setup()
    with pytest.raises(Stale, match=rf"{stream} \(.*\) is silent for \d"):
        run.run()

    trip = run.latch.tripped
    assert (trip.rule, "is silent" in trip.what) == ("freshness", True)


class Staying:
    """A policy that stays at one pose."""

    action_rate_hz, horizon, cameras = 10.0, 5, ("front",)

    def __init__(self, embodiment, pose):
        self.embodiment, self.pose = embodiment, pose

    def reset(self, seed):
        return

    def predict_action(self, observation):
        return np.tile(self.pose, (self.horizon, 1))


@pytest.mark.realtime
class TestUR5e:
    @pytest.mark.parametrize(
        "controller", ["forward_position_controller", "scaled_joint_trajectory_controller"]
    )
    def test_it_is_driven(self, simulate, connect, topics, controller):
        simulate("ur5e", "--ros2", "--cameras", "front", "--controller", controller)
        operator = connect(UROperator, controller=controller, **UR)
        np.testing.assert_allclose(operator.get_frame().state, UR_HOME, atol=0.02)
        assert operator.speed_scaling == 1.0

        target = UR_HOME.copy()
        target[[0, 6]] = target[0] + 0.3, 0.5
        allowed = np.array([0.04] * 6 + [0.15])
        drive(operator, target, lambda state: (abs(state - target) < allowed).all())
        assert topics.facts()["tasks"]["lift_cube"]["success"] is False

    def test_it_follows_at_full_speed_and_ignores_what_is_too_far(
        self, simulate, connect, tmp_path
    ):
        simulation = simulate("ur5e", "--ros2", "--cameras", "front")
        operator = connect(UROperator, **UR)
        published, publish = [operator.get_state()], operator.publish_action

        def publishing(action):
            published.append(action)
            publish(action)

        operator.publish_action = publishing
        goal = UR_HOME + [1.2, 0, 0, 0, 0, 0, 0]
        run = BaseInferenceRunner(
            operator=operator,
            policy=Staying(operator.embodiment, goal),
            task_descriptions={"1": "stay"},
            prepare_pose=goal,
            safety={"ramp_scale": 1.0, "max_age_s": 40.0, "max_skew_s": 20.0},
            context=RunContext(work_dir=tmp_path, task="1", section="inference"),
            record_fps=None,
            max_publish_step=25,
        )
        run.run_setup()
        assert run.run()["outcome"] == "max_steps"
        steps = np.abs(np.diff(np.array(published)[:, :6], axis=0)).max(axis=1)
        # At 30 Hz each of these would be beyond what the robot takes.
        assert steps.max() * 125 > 0.04 * 30
        assert steps.max() <= 0.04

        operator = connect(UROperator, **UR)
        wait_for(lambda: np.allclose(operator.get_state()[:6], goal[:6], atol=0.04))
        operator.publish_action(goal + [0.2, 0, 0, 0, 0, 0, 0])
        time.sleep(1.0)
        np.testing.assert_allclose(operator.get_state()[:6], goal[:6], atol=0.04)
        simulation.send_signal(signal.SIGINT)
        told = "".join(simulation.communicate(timeout=60))
        assert (
            told.count("positions more than 0.04 rad from the last one and from the arm are") == 1
        )

    def test_its_speed_slider_is_moved_and_its_cameras_have_depth(self, simulate, connect, topics):
        simulate("ur5e", "--ros2", "--cameras", "front", "--speed-scaling", "40")
        operator = connect(UROperator, use_depth_image=True, **UR)
        frame = operator.get_frame()
        assert 0.3 < np.nanmin(frame.depths["front"]) < np.nanmax(frame.depths["front"]) < 2.0
        assert operator.speed_scaling == 0.4
        operator.send_action(UR_HOME)
        topics.tell("/sim/speed_scaling", 0.0)
        wait_for(lambda: operator.speed_scaling == 0.0)
        with pytest.raises(Faulted, match="paused"):
            operator.send_action(UR_HOME)
        topics.tell("/sim/speed_scaling", 100.0)
        wait_for(lambda: operator.speed_scaling == 1.0)
        operator.send_action(UR_HOME)


@pytest.mark.realtime
def test_every_fault_reaches_whoever_listens(simulate, topics):
    simulate("aloha", "--ros2", "--cameras", "top")
    kept = topics.listen("/puppet/joint_left", "sensor_msgs.msg:JointState", 12)

    def late():
        return time.time() - stamps(kept)[-1]

    def silent():
        kept.clear()
        time.sleep(1.0)
        return not kept

    def full(check):
        return lambda: len(kept) == 12 and check()

    shows = {
        "freeze": full(lambda: len(set(stamps(kept))) == 1),
        "drop": silent,
        "delay:3": full(lambda: late() > 2.5),
        "nan": full(lambda: np.isnan(kept[-1].position).all()),
        "duplicate": full(lambda: len(set(stamps(kept))) <= 7),
        "out_of_order": full(lambda: (np.diff(stamps(kept)) < 0).sum() >= 5),
        "clock:-100": full(lambda: late() > 90),
    }
    wait_for(lambda: kept)
    for fault, check in shows.items():
        topics.tell("/sim/fault", f"left arm={fault}")
        wait_for(check)
    topics.tell("/sim/fault", "left arm=well")
    wait_for(full(lambda: late() < 2.0 and (np.diff(stamps(kept)) > 0).all()))
