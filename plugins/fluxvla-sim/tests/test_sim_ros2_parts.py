"""A simulated robot over ROS 2 without the network: judge, clock, drivers, command line."""

from __future__ import annotations

import time
from types import SimpleNamespace

import numpy as np
import pytest
from fluxvla_aloha.presets import COBOT_MAGIC, INTERBOTIX
from fluxvla_sim.aloha.arms import HOME
from fluxvla_sim.aloha.cube import AlohaScene, Expert, sample_cube
from fluxvla_sim.aloha.world import CUBE
from fluxvla_sim.ros2.drivers import AlohaDriver, MobileBase, URDriver, command_values
from fluxvla_sim.ros2.node import Judge, RobotNode
from fluxvla_sim.ros2.operators import AlohaSimROSOperator, SlowedClock, URSimROSOperator
from fluxvla_sim.ros2.settings import NodeSettings, stream_latency, timed_fault
from fluxvla_ur.embodiment import JOINTS

from fluxvla_core.control.clock import in_lockstep
from fluxvla_core.errors import ConfigError, NotReady, UsageError
from fluxvla_core.ros2 import BadMessage, Fault
from fluxvla_core.testing.ros2 import ros_domain

__all__ = ["ros_domain"]


def test_what_a_signal_handler_calls_takes_no_lock():
    """A handler runs in the thread that it interrupts: a lock that is held there stays held."""
    node = object.__new__(RobotNode)  # not connected
    for name in ("_lock", "_stopping"):
        setattr(node, name, None)

    node.stop()

    assert node._stop_wanted


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
        told = judge.facts()
        assert (told["seed"], told["resets"], told["steps"]) == (7, 1, 299)
        assert not told["tasks"]["lift_hold"]["done"]
        for _ in range(5):
            judge.after(scene)
        told = judge.facts()
        assert told["steps"] == 300
        assert [t["done"] for t in told["tasks"].values()] == [True, True]
        assert [t["success"] for t in told["tasks"].values()] == [False, False]
        for command in Expert(scene.model).plan("lift_hold", sample_cube(8)):
            if judge.facts()["seed"] != 8:
                scene.reset(8)
                judge.reset(8)
            scene.step(command)
            judge.after(scene)
        told = judge.facts()["tasks"]
        assert told["lift_hold"] == {
            "instruction": "pick up the cube with the right arm and hold it",
            "success": True,
            "done": True,
        }
        assert not told["transfer_cube"]["success"]
        judge.reset(9)
        assert (judge.facts()["resets"], judge.facts()["steps"]) == (3, 0)


def test_a_slowed_clock_is_slower():
    clock = SlowedClock(0.25)
    begin, began = clock.now(), time.monotonic()
    clock.sleep_until(begin + 0.05)
    assert clock.now() - begin >= 0.05
    assert time.monotonic() - began >= 0.2
    clock.sleep_until(begin)
    assert not in_lockstep(clock)


def trajectory(controller, goal, seconds=0, nanosec=0):
    after = SimpleNamespace(sec=seconds, nanosec=nanosec)
    point = SimpleNamespace(positions=[goal] * 6, time_from_start=after)
    message = SimpleNamespace(joint_names=list(JOINTS), points=[point])
    return f"/{controller}/joint_trajectory", message


class TestBodies:
    def test_aloha_commands_are_taken_by_name_with_raw_grippers(self):
        driver = AlohaDriver(COBOT_MAGIC)
        driver.reset(HOME)
        names = list(reversed(COBOT_MAGIC.joints))
        raw = COBOT_MAGIC.gripper_open
        left = SimpleNamespace(name=names, position=[raw, 6, 5, 4, 3, 2, 1])
        driver.receive("/master/joint_left", left, 0.0)

        np.testing.assert_allclose(driver.target(0.0), [1, 2, 3, 4, 5, 6, 1.0, *HOME[7:]])

    def test_interbotix_has_grippers_of_its_own(self):
        driver = AlohaDriver(INTERBOTIX)
        driver.reset(HOME)
        arm, gripper = (
            SimpleNamespace(cmd=[1.0] * 6),
            SimpleNamespace(cmd=INTERBOTIX.gripper_closed),
        )
        driver.receive("/follower_right/commands/joint_group", arm, 0.0)
        driver.receive("/follower_right/commands/joint_single", gripper, 0.0)

        np.testing.assert_allclose(driver.target(0.0), [*HOME[:7], *[1.0] * 6, 0.0], atol=1e-9)

    def test_trajectories_take_their_time(self):
        driver = URDriver("scaled_joint_trajectory_controller")
        driver.reset(np.zeros(7))
        driver.receive(
            *trajectory("scaled_joint_trajectory_controller", 1.0, nanosec=5 * 10**8), 10.0
        )

        assert [driver.target(t)[0] for t in (10.0, 10.25, 10.5, 11.0)] == [0.0, 0.5, 1.0, 1.0]

    def test_streamed_positions_that_are_too_far_are_ignored(self):
        driver, topic = URDriver(), "/forward_position_controller/commands"
        driver.reset(np.zeros(7))
        for position in (0.04, 0.08):
            driver.receive(topic, SimpleNamespace(data=[position] * 6), 0.0)
        with pytest.raises(BadMessage, match=r"more than 0\.04 rad from the last one and from the"):
            driver.receive(topic, SimpleNamespace(data=[0.13] * 6), 0.0)
        assert driver.target(0.0)[0] == 0.08

        driver.messages(np.full(7, 0.1), 0.0)
        driver.receive(topic, SimpleNamespace(data=[0.13] * 6), 0.0)
        assert driver.target(0.0)[0] == 0.13

    def test_a_speed_slider_slows_down_what_is_left_of_a_trajectory(self):
        driver = URDriver("scaled_joint_trajectory_controller", speed_scaling=50.0)
        driver.reset(np.zeros(7))
        driver.receive(*trajectory("scaled_joint_trajectory_controller", 1.0, seconds=1), 10.0)

        assert [driver.target(t)[0] for t in (10.0, 11.0)] == [0.0, 0.5]
        driver.receive("/sim/speed_scaling", SimpleNamespace(data=0.0), 11.0)
        assert driver.target(20.0)[0] == 0.5
        driver.receive("/sim/speed_scaling", SimpleNamespace(data=100.0), 20.0)
        assert [driver.target(t)[0] for t in (20.0, 20.25, 20.5, 30.0)] == [0.5, 0.75, 1.0, 1.0]

    def test_a_speed_slider_means_nothing_to_other_controllers(self):
        driver = URDriver("joint_trajectory_controller", speed_scaling=10.0)
        driver.reset(np.zeros(7))
        driver.receive(*trajectory("joint_trajectory_controller", 1.0, seconds=1), 10.0)

        assert driver.target(10.5)[0] == 0.5

    @pytest.mark.parametrize("percent", [-1.0, 101.0, float("nan")])
    def test_a_speed_slider_has_ends(self, percent):
        driver = URDriver()
        with pytest.raises(BadMessage, match="/sim/speed_scaling: a speed slider goes from 0 to"):
            driver.receive("/sim/speed_scaling", SimpleNamespace(data=percent), 0.0)
        with pytest.raises(ConfigError, match="a speed slider goes from 0 to 100 %"):
            URDriver(speed_scaling=percent)

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


@pytest.fixture
def base(ros_domain):
    return MobileBase()


def speed(forward, turning):
    return SimpleNamespace(linear=SimpleNamespace(x=forward), angular=SimpleNamespace(z=turning))


class TestBase:
    """Driven at times that the test makes up."""

    def told(self, base, now):
        message = base.odometry(now)
        pose, twist = message.pose.pose, message.twist.twist
        heading = 2 * np.arctan2(pose.orientation.z, pose.orientation.w)
        where = pose.position.x, pose.position.y, heading
        return np.round(where, 6).tolist(), (twist.linear.x, twist.angular.z)

    def test_it_drives_while_it_is_asked_to(self, base):
        for now in np.arange(5.0, 7.0, 0.1):
            base.drive(speed(0.3, 0.0), "/cmd_vel", now)
        assert self.told(base, 7.0) == ([0.6, 0.0, 0.0], (0.3, 0.0))
        base.drive(speed(0.0, 0.0), "/cmd_vel", 7.0)
        assert self.told(base, 9.0) == ([0.6, 0.0, 0.0], (0.0, 0.0))

    def test_a_speed_that_is_not_asked_for_again_ends(self, base):
        base.drive(speed(0.2, 0.0), "/cmd_vel", 5.0)
        assert self.told(base, 5.4) == ([0.08, 0.0, 0.0], (0.2, 0.0))
        assert self.told(base, 60.0) == ([0.1, 0.0, 0.0], (0.0, 0.0))

    def test_it_turns_on_a_circle(self, base):
        for now in np.arange(0.0, np.pi, 0.01):
            base.drive(speed(1.0, 1.0), "/cmd_vel", now)
        (x, y, heading), _ = self.told(base, np.pi)
        assert (x, y) == pytest.approx((0.0, 2.0), abs=1e-3)
        assert abs(heading) == pytest.approx(np.pi, abs=1e-3)

    def test_an_episode_begins_where_odometry_does(self, base):
        driver = AlohaDriver(COBOT_MAGIC)
        driver.receive("/cmd_vel", speed(0.3, 0.1), 1.0)
        assert driver.messages(HOME, 1.4)["base"].twist.twist.linear.x == 0.3
        driver.reset(HOME)
        assert self.told(driver._base, 1.5) == ([0.0, 0.0, 0.0], (0.0, 0.0))

    @pytest.mark.parametrize("value", [float("nan"), float("inf")])
    def test_a_speed_that_is_no_number_is_not_taken(self, base, value):
        with pytest.raises(BadMessage, match="/cmd_vel: a speed is not finite"):
            base.drive(speed(0.0, value), "/cmd_vel", 0.0)
        assert self.told(base, 0.1)[1] == (0.0, 0.0)


class TestRates:
    @pytest.mark.parametrize(
        ("state_hz", "parts"), [(1, 1), (50, 1), (60, 2), (100, 2), (125, 5), (250, 5), (500, 10)]
    )
    def test_physics_is_stepped_as_often_as_states_are_said(self, state_hz, parts):
        assert NodeSettings("x", state_hz=state_hz).parts == parts

    @pytest.mark.parametrize("state_hz", [0.5, 7, 25, 30, 50, 60, 100, 130, 500])
    def test_as_many_states_are_said_as_there_are_to_be(self, state_hz):
        settings = NodeSettings("x", state_hz=state_hz)
        by = [settings.states_by(part) for part in range(int(20 * 50 * settings.parts) + 1)]
        assert (by[0], by[-1]) == (0, 20 * state_hz)
        assert set(np.diff(by)) <= {0, 1}, "two at once would bear one stamp"
        # Never further from its own time than one step.
        first = np.searchsorted(by, np.arange(1, by[-1] + 1)) / (50 * settings.parts)
        late = first - np.arange(1, by[-1] + 1) / state_hz
        assert -1e-6 < late.min() <= late.max() < 1 / (50 * settings.parts)

    def test_a_latency_is_in_simulated_seconds(self):
        settings = NodeSettings("x", real_time_factor=0.5, latencies={"top": 0.1})
        assert (settings.latency_s("top"), settings.latency_s("base")) == (0.2, 0.0)


class TestCommandLine:
    def test_faults_may_wait(self):
        assert timed_fault("top=delay:0.2@3.5") == (3.5, "top", Fault("delay", 0.2))
        assert timed_fault("top=drop") == (0.0, "top", Fault("drop"))

    def test_a_latency_is_of_a_stream(self):
        assert stream_latency("left arm=0.05") == ("left arm", 0.05)

    @pytest.mark.parametrize("text", ["top", "top=", "=0.1", "top=soon", "top=-1", "top=inf"])
    def test_a_latency_that_is_none_is_refused(self, text):
        with pytest.raises(UsageError, match=f"'{text}' is not a latency; write STREAM=SECONDS"):
            stream_latency(text)

    def test_a_time_that_is_none_is_refused(self):
        with pytest.raises(UsageError, match="'soon' is not a number of seconds"):
            timed_fault("top=drop@soon")

    @pytest.mark.parametrize(
        ("arguments", "what"),
        [
            (["aloha"], "a simulated robot is reached over ROS 2 here"),
            (["aloha", "--ros2", "--fault", "x=drop"], "the robot has no stream 'x'; it has left"),
            (["aloha", "--ros2", "--fault", "top=nan"], "top is a camera: an image's numbers"),
            (["aloha", "--ros2", "--fault", "top_depth=nan"], "top_depth is a camera: an image's"),
            (["aloha", "--ros2", "--fault", "base=nan"], "base is odometry: only joints and bare"),
            (["aloha", "--ros2", "--latency", "x=1"], "the robot has no stream 'x'; it has left"),
            (["aloha", "--ros2", "--state-hz", "501"], "states need a rate from 0 to 500 Hz"),
            (["aloha", "--ros2", "--speed-scaling", "50"], "an ALOHA has no speed slider"),
            (["ur5e", "--ros2", "--speed-scaling", "150"], "a speed slider goes from 0 to 100 %"),
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
