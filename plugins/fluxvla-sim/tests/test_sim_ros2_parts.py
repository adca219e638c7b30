"""A simulated robot over ROS 2 without the network: judge, clock, bodies, command line."""

from __future__ import annotations

import time
from types import SimpleNamespace

import numpy as np
import pytest
from fluxvla_aloha.presets import COBOT_MAGIC, INTERBOTIX
from fluxvla_sim.aloha.arms import HOME
from fluxvla_sim.aloha.expert import Expert
from fluxvla_sim.aloha.scene import AlohaScene, sample_cube
from fluxvla_sim.aloha.world import CUBE
from fluxvla_sim.ros2.bodies import AlohaBody, URBody, command_values
from fluxvla_sim.ros2.clock import SlowedClock
from fluxvla_sim.ros2.command import timed_fault
from fluxvla_sim.ros2.judge import Judge
from fluxvla_sim.ros2.operators import AlohaSimROSOperator, URSimROSOperator
from fluxvla_ur.embodiment import JOINTS

from fluxvla_core.control.clock import in_lockstep
from fluxvla_core.errors import ConfigError, NotReady, UsageError
from fluxvla_core.ros2.faults import Fault
from fluxvla_core.ros2.trouble import BadMessage
from fluxvla_core.testing.ros2 import ros_domain

__all__ = ["ros_domain"]


class TestWhatTheSimulatorTells:
    FACTS = (
        '{"tasks": {"a": {"instruction": "Do this", "success": true, "done": true},'
        ' "b": {"instruction": "do that", "success": false, "done": false}}, "time": %s}'
    )

    @pytest.fixture
    def operator(self, monkeypatch):
        operator = AlohaSimROSOperator(real_time_factor=0.5)
        self.time, self.receipt = 10.0, 100.0

        def newest(name):
            message = SimpleNamespace(data=self.FACTS % self.time)
            return SimpleNamespace(message=message, receipt=self.receipt)

        monkeypatch.setattr(operator, "newest", newest)
        return operator

    @pytest.mark.parametrize(
        ("said", "success", "done"),
        [("do  THIS", True, True), ("do that", False, False), ("dance", None, False)],
    )
    def test_success_is_that_of_the_instruction(self, operator, said, success, done):
        operator._instruction = said
        assert operator.task_success() is success
        assert operator.task_done() is done

    @pytest.mark.parametrize(("simulated", "kept"), [(5.0, 1.0), (2.0, 0.4)])
    def test_time_that_was_not_kept_is_told(self, operator, caplog, simulated, kept):
        assert operator.episode_facts() == {"real_time_factor": 0.5, "real_time_kept": None}
        operator._begun = operator._simulated()
        self.time, self.receipt = self.time + simulated, self.receipt + 10.0
        operator.task_success()
        assert operator.episode_facts() == {"real_time_factor": 0.5, "real_time_kept": kept}
        warned = "the simulator kept 40 % of the time that it stated" in caplog.text
        assert warned == (kept < 0.95)

    def test_silence_is_no_answer(self, operator, monkeypatch):
        monkeypatch.setattr(operator, "newest", lambda name: None)
        with pytest.raises(NotReady, match=r"the simulator \(/sim/facts\) has said nothing yet"):
            operator.task_success()

    @pytest.mark.parametrize("factor", [0.0, 2.0])
    def test_a_factor_that_is_none_is_refused(self, factor):
        with pytest.raises(ConfigError, match="real_time_factor must be above 0 and at most 1"):
            URSimROSOperator(real_time_factor=factor)

    def test_ages_are_in_simulated_seconds(self):
        operator = URSimROSOperator(real_time_factor=0.25, max_age_s=0.5, max_skew_s=0.1)
        assert (operator.max_age_s, operator.max_skew_s) == (2.0, 0.4)


class TestJudge:
    def test_an_episode_is_settled_after_its_last_step(self):
        judge, scene = Judge(CUBE), AlohaScene()
        judge.reset(7)
        scene.reset(7)
        for _ in range(299):
            judge.after(scene)
        told = judge.tell()
        assert (told["seed"], told["resets"], told["steps"]) == (7, 1, 299)
        assert not told["tasks"]["lift_hold"]["done"]
        for _ in range(5):
            judge.after(scene)
        told = judge.tell()
        assert told["steps"] == 300
        assert [t["done"] for t in told["tasks"].values()] == [True, True]
        assert [t["success"] for t in told["tasks"].values()] == [False, False]
        for command in Expert(scene.model).plan("lift_hold", sample_cube(8)):
            if judge.tell()["seed"] != 8:
                scene.reset(8)
                judge.reset(8)
            scene.step(command)
            judge.after(scene)
        told = judge.tell()["tasks"]
        assert told["lift_hold"] == {
            "instruction": "pick up the cube with the right arm and hold it",
            "success": True,
            "done": True,
        }
        assert not told["transfer_cube"]["success"]
        judge.reset(9)
        assert (judge.tell()["resets"], judge.tell()["steps"]) == (3, 0)


def test_a_slowed_clock_is_slower():
    clock = SlowedClock(0.25)
    begin, began = clock.now(), time.monotonic()
    clock.sleep_until(begin + 0.05)
    assert clock.now() - begin >= 0.05
    assert time.monotonic() - began >= 0.2
    clock.sleep_until(begin)
    assert not in_lockstep(clock)


class TestBodies:
    def test_aloha_commands_are_taken_by_name_with_raw_grippers(self):
        body = AlohaBody(COBOT_MAGIC)
        body.reset(HOME)
        names = list(reversed(COBOT_MAGIC.joints))
        raw = COBOT_MAGIC.gripper_open
        left = SimpleNamespace(name=names, position=[raw, 6, 5, 4, 3, 2, 1])
        body.hear("/master/joint_left", left, 0.0)

        np.testing.assert_allclose(body.target(0.0), [1, 2, 3, 4, 5, 6, 1.0, *HOME[7:]])

    def test_interbotix_has_grippers_of_its_own(self):
        body = AlohaBody(INTERBOTIX)
        body.reset(HOME)
        arm, gripper = (
            SimpleNamespace(cmd=[1.0] * 6),
            SimpleNamespace(cmd=INTERBOTIX.gripper_closed),
        )
        body.hear("/follower_right/commands/joint_group", arm, 0.0)
        body.hear("/follower_right/commands/joint_single", gripper, 0.0)

        np.testing.assert_allclose(body.target(0.0), [*HOME[:7], *[1.0] * 6, 0.0], atol=1e-9)

    def test_trajectories_take_their_time(self):
        body = URBody("scaled_joint_trajectory_controller")
        body.reset(np.zeros(7))
        point = SimpleNamespace(
            positions=[1.0] * 6, time_from_start=SimpleNamespace(sec=0, nanosec=500_000_000)
        )
        message = SimpleNamespace(joint_names=list(JOINTS), points=[point])
        body.hear("/scaled_joint_trajectory_controller/joint_trajectory", message, 10.0)

        assert [body.target(t)[0] for t in (10.0, 10.25, 10.5, 11.0)] == [0.0, 0.5, 1.0, 1.0]

    @pytest.mark.parametrize(
        ("message", "what"),
        [
            (SimpleNamespace(data=[1.0]), r"/c: 2 values are needed, got \(1,\)"),
            (SimpleNamespace(data=[1.0, float("nan")]), "/c: a value is not finite"),
            (SimpleNamespace(points=[]), "/c: a trajectory without points"),
            (SimpleNamespace(name=["a"], position=[1.0]), "/c: no joint called b"),
        ],
    )
    def test_what_is_no_command_is_refused(self, message, what):
        with pytest.raises(BadMessage, match=what):
            command_values(message, ("a", "b"), "/c")


class TestCommandLine:
    def test_faults_may_wait(self):
        assert timed_fault("top=delay:0.2@3.5") == (3.5, "top", Fault("delay", 0.2))
        assert timed_fault("top=drop") == (0.0, "top", Fault("drop"))

    def test_a_time_that_is_none_is_refused(self):
        with pytest.raises(UsageError, match="'soon' is no number of seconds"):
            timed_fault("top=drop@soon")

    @pytest.mark.parametrize(
        ("arguments", "what"),
        [
            (["aloha"], "a simulated robot is reached over ROS 2 here"),
            (["aloha", "--ros2", "--fault", "x=drop"], "the robot has no stream 'x'; it has left"),
            (["aloha", "--ros2", "--fault", "top=nan"], "top is a camera: a picture's numbers"),
            (["ur5e", "--ros2", "--fault", "gripper=clock:1"], "gripper is a bare number"),
            (["ur5e", "--ros2", "--fault", "program running=drop"], "said once, at the start"),
            (["aloha", "--ros2", "--task", "x"], "there is no task 'x'; there are transfer_cube"),
            (["aloha", "--ros2", "--real-time-factor", "0"], "must be above 0 and at most 1"),
            (["aloha", "--ros2", "--camera-hz", "0"], "cameras need a rate from 0 to 1000 Hz"),
            (["aloha", "--ros2", "--preset", "x"], "unknown preset 'x'; known are cobot_magic"),
            (["aloha", "--ros2", "--cameras", "x"], "no camera 'x'; there are top, left_wrist"),
            (["ur5e", "--ros2", "--controller", "x"], "unknown controller 'x'"),
        ],
    )
    def test_what_does_not_exist_is_named(self, ros_domain, capsys, arguments, what):
        from fluxvla_core.cli.main import main

        assert main(["sim", *arguments]) == 2
        assert what in capsys.readouterr().err
