"""UROperator: what it is told by a config, and what it does on real topics."""

from __future__ import annotations

import time

import numpy as np
import pytest
from fluxvla_ur.embodiment import JOINTS, ur_spec
from fluxvla_ur.operator import CONTROLLERS, TRAJECTORY, UROperator

from fluxvla_core import BaseInferenceRunner, RunContext
from fluxvla_core.errors import ConfigError, Faulted, NotReady, Rejected
from fluxvla_core.ros2 import FLOAT64, FLOAT64_ARRAY, IMAGE, JOINT_STATE
from fluxvla_core.testing import OperatorConformance
from fluxvla_core.testing.ros2 import drivers, lasting_drivers, ros_domain

__all__ = ["drivers", "lasting_drivers", "ros_domain"]

SMALL = {"height": 48, "width": 64}
# Machines that run tests stall for a second; what is silent for longer is silent.
QUICK = {**SMALL, "rate_window_s": 0.0, "connect_timeout_s": 8.0, "max_age_s": 2.0}
POSE = (0.1, -1.5, 1.4, -1.3, -1.2, 0.2)
FORWARD, SCALED, _ = CONTROLLERS
COMMANDS = CONTROLLERS[FORWARD][0]
SCALING = "/speed_scaling_state_broadcaster/speed_scaling"
RUNNING = "/io_and_status_controller/robot_program_running"


def where(pose):
    """Names and positions of a UR's joint states; older drivers order them by the alphabet."""
    at = dict(zip(JOINTS, pose, strict=True)) | {"finger_joint": 0.4}
    names = sorted(at)
    return {"names": names, "positions": [float(at[name]) for name in names]}


def robot(controller=FORWARD, scaling=100.0, running=True):
    """Streams and sinks of a UR's drivers."""
    topic, message = CONTROLLERS[controller]
    streams = [
        {
            "topic": "/joint_states",
            "message": JOINT_STATE,
            "hz": 125,
            **where(POSE),
            "follows": topic,
            "command_names": list(JOINTS),
        },
        {
            "topic": "/gripper/position",
            "message": FLOAT64,
            "hz": 50,
            "data": 0.5,
            "follows": "/gripper/command",
        },
    ]
    cameras = ("/front_camera/color/image_raw", "/wrist_camera/color/image_raw")
    streams += [{"topic": t, "message": IMAGE, "hz": 30, **SMALL} for t in cameras]
    if scaling is not None:
        streams.append({"topic": SCALING, "message": FLOAT64, "hz": 50, "data": scaling})
    if running is not None:
        bool_ = {"message": "std_msgs.msg:Bool", "hz": 0, "latched": True, "data": running}
        streams.append({"topic": RUNNING, **bool_})
    sinks = [
        {"topic": topic, "message": message},
        {"topic": "/gripper/command", "message": FLOAT64},
    ]
    return streams, sinks


class Turns:
    """Turns the base as far as it may."""

    action_rate_hz, horizon = 10.0, 5

    def __init__(self, embodiment):
        self.embodiment = embodiment

    def reset(self, seed):
        return

    def predict_action(self, observation):
        chunk = np.repeat(observation["qpos"][None].astype(np.float64), self.horizon, axis=0)
        chunk[:, 0] += 0.15 * np.arange(1, self.horizon + 1)
        return chunk


def wait_for(condition, seconds=8.0):
    until = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until, "did not happen in time"
        time.sleep(0.01)


def said(call, what, seconds=8.0):
    """Wait until ``call`` raises an error that says ``what``; other streams may be late first."""
    until, seen = time.monotonic() + seconds, []
    while time.monotonic() < until:
        try:
            call()
        except (NotReady, Faulted) as error:
            if what in error.what:
                return error
            seen.append(error.what)
        time.sleep(0.01)
    pytest.fail(f"nobody said {what!r}, but {seen[-3:]}")


@pytest.fixture
def connect(ros_domain):
    made = []

    def make(**arguments):
        operator = UROperator(**{**QUICK, **arguments})
        made.append(operator)
        operator.connect()
        return operator

    yield make
    for operator in made:
        operator.close()


@pytest.fixture(scope="module")
def lasting_robot(lasting_drivers):
    return lasting_drivers(*robot())


class TestConfig:
    def test_the_defaults_are_the_drivers(self):
        operator = UROperator()

        assert [(s.name, s.topic, s.required) for s in operator.streams()] == [
            ("arm", "/joint_states", True),
            ("cam_high", "/front_camera/color/image_raw", True),
            ("cam_left_wrist", "/wrist_camera/color/image_raw", True),
            ("gripper", "/gripper/position", True),
            ("speed scaling", SCALING, True),
            ("program running", RUNNING, True),
        ]
        status = UROperator(require_status=False).streams()[-2:]
        assert [s.required for s in status] == [False, False]
        assert [(c.topic, c.message) for c in operator.commands()] == [
            ("/forward_position_controller/commands", FLOAT64_ARRAY),
            ("/gripper/command", FLOAT64),
        ]
        assert operator.embodiment == ur_spec(rate_hz=125.0)

    @pytest.mark.parametrize(
        ("model", "controller", "rate_hz"),
        [("ur3e", FORWARD, 250.0), ("ur10e", FORWARD, 125.0), ("ur5e", SCALED, 30.0)],
    )
    def test_the_default_rate_is_what_the_robot_needs(self, model, controller, rate_hz):
        operator = UROperator(model=model, controller=controller)

        assert operator.embodiment.rate_hz == rate_hz

    @pytest.mark.parametrize(("model", "rate_hz"), [("ur5e", 50.0), ("ur3e", 125.0)])
    def test_a_rate_at_which_the_robot_would_ignore_commands_is_refused(self, model, rate_hz):
        with pytest.raises(ConfigError, match=r"the robot ignores more than 0\.04 rad") as caught:
            UROperator(model=model, publish_rate=rate_hz)
        assert "leave publish_rate out, or --set <UROperator>.publish_rate=" in caught.value.next
        UROperator(model=model, publish_rate=rate_hz, controller=SCALED)

    def test_topics_models_and_cameras_are_those_of_the_config(self):
        operator = UROperator(
            model="ur3e",
            controller=SCALED,
            puppet_arm_left_cmd_topic="/left/commands",
            img_front_topic="/top/compressed",
            use_depth_image=True,
            camera_names=("top",),
            gripper_joint="finger_joint",
            publish_rate=50.0,
        )

        assert [s.name for s in operator.streams()][:3] == ["arm", "top", "top_depth"]
        assert "gripper" not in [s.name for s in operator.streams()]
        command, _ = operator.commands()
        assert (command.topic, command.message) == ("/left/commands", TRAJECTORY)
        assert (operator.embodiment.name, operator.embodiment.rate_hz) == ("ur3e", 50.0)

    @pytest.mark.parametrize(
        ("arguments", "what"),
        [
            ({"controller": "velocity"}, "unknown controller 'velocity'; known are forward_pos"),
            ({"model": "ur99"}, "unknown UR model 'ur99'"),
            ({"camera_names": tuple("abc")}, "there are 2 cameras, got"),
            ({"gripper_open": 0.0}, "must be different finite numbers"),
            ({"trajectory_time_s": 0}, "trajectory_time_s must be positive, got 0"),
            ({"publish_rate": -1}, "UROperator: rate_hz must be positive, got -1"),
        ],
    )
    def test_values_out_of_range_are_named(self, arguments, what):
        with pytest.raises(ConfigError, match=what):
            UROperator(**arguments)


class TestRobot:
    def test_joints_by_name_and_a_gripper_of_its_own(self, connect, drivers):
        drivers(*robot())
        operator = connect(gripper_closed=0.0, gripper_open=2.0)

        np.testing.assert_allclose(operator.get_frame().state, [*POSE, 0.25])
        assert operator.speed_scaling == 1.0

    def test_commands_are_in_the_controllers_order(self, connect, drivers):
        driver = drivers(*robot())
        operator = connect(gripper_closed=0.8, gripper_open=0.0)
        operator.send_action([*np.add(POSE, 0.01), 0.25])
        wait_for(lambda: driver.on(COMMANDS) and driver.on("/gripper/command"))

        np.testing.assert_allclose(driver.on(COMMANDS)[0]["data"], np.add(POSE, 0.01))
        np.testing.assert_allclose(driver.on("/gripper/command")[0]["data"], 0.6)
        wait_for(lambda: np.allclose(operator.get_state(), [*np.add(POSE, 0.01), 0.25]))

    def test_a_command_that_the_robot_would_ignore_is_refused(self, connect, drivers):
        driver = drivers(*robot())
        operator = connect()
        for count, away in ((1, 0.03), (2, 0.06)):
            operator.send_action([*np.add(POSE, away), 0.5])
            wait_for(lambda n=count: len(driver.on(COMMANDS)) == n)
        jump = [*np.add(POSE, 0.06 + 0.05), 0.5]

        with pytest.raises(Rejected, match=r"more than 0\.04 rad from the last one and from where"):
            operator.send_action(jump)
        assert len(driver.on(COMMANDS)) == 2
        # Somebody moved it there by hand.
        driver.tell(change={"/joint_states": {"follows": "", **where(np.add(POSE, 0.11))}})
        wait_for(lambda: np.allclose(operator.get_state()[:6], np.add(POSE, 0.11)))
        operator.send_action(jump)

    def test_the_robot_takes_every_command_of_a_stop(self, connect, drivers):
        driver = drivers(*robot())
        operator = connect()
        # What was sent: of two commands at once a driver that stalls gets the newer one alone.
        path, publish = [], operator.publish_action

        def publishing(action):
            path.append(action[:6].copy())
            publish(action)

        operator.publish_action = publishing
        driver.tell(change={"/joint_states": {"follows": ""}})
        for count in range(1, 9):
            operator.send_action([*np.add(POSE, 0.03 * count), 0.5])
            wait_for(lambda n=count: len(driver.on(COMMANDS)) == n)
        # The base is blocked, and the other joints have a little way to go.
        reached, there = np.add(POSE, [0.0, *[0.18] * 5]), np.add(POSE, [0.0, *[0.24] * 5])
        driver.tell(change={"/joint_states": where(reached)})
        wait_for(lambda: np.allclose(operator.get_state()[:6], reached))
        # No longer in motion: neither by its commands nor by its last two readings.
        time.sleep(0.7)
        newest = operator.newest("arm").receipt
        wait_for(lambda: operator.newest("arm").receipt > newest)
        before = len(path)
        operator.stop()
        wait_for(lambda: np.allclose(driver.on(COMMANDS)[-1]["data"], there))

        assert before == 8
        assert len(path) > before
        assert np.abs(np.diff(path, axis=0)).max() <= 0.04

    def test_trajectories_may_be_as_long_as_they_like(self, connect, drivers):
        driver = drivers(*robot(SCALED))
        connect(controller=SCALED).send_action([*np.add(POSE, 0.5), 0.5])
        wait_for(lambda: driver.on(CONTROLLERS[SCALED][0]))

    def test_a_gripper_among_the_joints(self, connect, drivers):
        drivers(*robot())
        operator = connect(gripper_joint="finger_joint", gripper_closed=0.8, gripper_open=0.0)

        np.testing.assert_allclose(operator.get_frame().state[6], 0.5)

    def test_a_gripper_that_is_no_number_is_a_fault(self, connect, drivers):
        driver = drivers(*robot())
        operator = connect()
        driver.tell(fault="/gripper/position=nan")

        error = said(operator.get_frame, "the gripper (/gripper/position) reports nan")
        assert isinstance(error, Faulted)

    def test_a_silent_gripper_is_named(self, connect, drivers):
        driver = drivers(*robot())
        operator = connect(max_age_s=0.5)
        driver.tell(fault="/gripper/position=drop")

        error = said(operator.get_frame, "gripper (/gripper/position) is silent")
        assert isinstance(error, NotReady)

    def test_trajectories_name_their_joints_and_say_when(self, connect, drivers):
        driver = drivers(*robot(SCALED))
        operator = connect(controller=SCALED, trajectory_time_s=1.25)
        topic = CONTROLLERS[SCALED][0]
        operator.send_action([*POSE, 1.0])
        # One that a newer overtakes never arrives.
        wait_for(lambda: driver.on(topic))
        operator.stop()
        wait_for(lambda: len(driver.on(topic)) == 2)

        heard, held = driver.on(topic)
        (point,) = heard["points"]
        assert heard["joint_names"] == list(JOINTS)
        np.testing.assert_allclose(point["positions"], POSE)
        assert point["time_from_start"] == {"sec": 1, "nanosec": 250_000_000}
        assert held["points"] == heard["points"]


class TestWhatTheRobotSays:
    def test_a_slider_that_is_moved_while_the_arm_moves(self, connect, drivers, tmp_path):
        """Commands keep all limits and the share of the speed; the arm is not taken for blocked."""
        driver = drivers(*robot(scaling=20.0))
        operator = connect()
        wait_for(lambda: operator.newest("speed scaling"))
        published, publish = [], operator.publish_action

        def publishing(action):
            share = {200: 100.0, 300: 30.0}.get(len(published))
            if share is not None:
                driver.tell(change={SCALING: {"data": share}})
            published.append((operator.speed_scaling, action))
            publish(action)

        operator.publish_action = publishing
        runner = BaseInferenceRunner(
            context=RunContext(section="inference", work_dir=tmp_path, task="1"),
            operator=operator,
            policy=Turns(operator.embodiment),
            task_descriptions={"1": "turn"},
            prepare_pose=[0.4, *POSE[1:], 0.5],
            record_fps=None,
            max_publish_step=400,
            safety={"max_age_s": 2.0},
        )
        runner.run_setup()
        assert runner.run()["outcome"] == "max_steps"

        shares, actions = (np.array(values) for values in zip(*published, strict=True))
        joint = operator.embodiment.joints[0]
        speed = np.diff(actions[:, 0], prepend=POSE[0]) * 125.0
        push = np.diff(speed, prepend=0.0) * 125.0
        assert sorted(set(shares)) == pytest.approx([0.2, 0.3, 1.0])
        assert np.abs(push).max() <= joint.acceleration
        assert np.abs(speed).max() <= joint.velocity
        assert 0.19 * joint.velocity < np.abs(speed[shares == 0.2]).max() < 0.21 * joint.velocity
        assert np.abs(speed).max() > 0.4 * joint.velocity

    def test_a_slider_that_is_no_number_stops_the_arm(self, connect, drivers):
        driver = drivers(*robot(scaling=20.0))
        operator = connect()
        wait_for(lambda: operator.newest("speed scaling"))
        driver.tell(fault=f"{SCALING}=nan")
        wait_for(lambda: np.isnan(operator.newest("speed scaling").message.data))

        with pytest.raises(Faulted, match=rf"the speed scaling \({SCALING}\) is nan"):
            operator.send_action([*POSE, 0.5])
        assert driver.on(COMMANDS) == []

    def test_a_paused_robot_refuses(self, connect, drivers):
        drivers(*robot(scaling=0.0))
        operator = connect()
        wait_for(lambda: operator.newest("speed scaling"))

        with pytest.raises(Faulted, match="the robot is paused: its speed scaling is 0"):
            operator.send_action([*POSE, 0.5])

    def test_a_robot_that_says_nothing_of_itself_is_refused(self, ros_domain, drivers):
        drivers(*robot(scaling=None, running=None))
        with pytest.raises(NotReady, match=f"no publisher on {SCALING}") as caught:
            UROperator(**{**QUICK, "connect_timeout_s": 2.0}).connect()

        assert f"no publisher on {RUNNING} (program running)" in caught.value.what
        assert "speed_scaling_state_broadcaster is not active" in caught.value.cause
        assert "require_status=False" in caught.value.cause

    def test_a_program_that_never_ran_is_refused(self, ros_domain, drivers):
        """ur_robot_driver tells of changes only: until it is played first, it says nothing."""
        streams, sinks = robot()
        streams[-1]["latched"] = False
        drivers(streams, sinks)
        with pytest.raises(NotReady, match=r"no message arrives on program running") as caught:
            UROperator(**{**QUICK, "connect_timeout_s": 2.0}).connect()

        assert "External Control was not played on the teach pendant" in caught.value.cause

    def test_without_them_there_is_a_warning(self, connect, drivers, caplog):
        drivers(*robot(scaling=None, running=None))
        operator = connect(require_status=False)

        for label in (f"speed scaling ({SCALING})", f"program running ({RUNNING})"):
            assert f"nobody publishes {label}: " in caplog.text
        operator.send_action([*POSE, 0.5])
        assert operator.speed_scaling == 1.0

    @pytest.mark.parametrize("require_status", [True, False])
    def test_a_slider_that_falls_silent_stops_the_arm(self, connect, drivers, require_status):
        driver = drivers(*robot())
        operator = connect(require_status=require_status, max_age_s=0.5)
        wait_for(lambda: operator.newest("speed scaling"))
        driver.tell(fault=f"{SCALING}=drop")

        error = said(operator.get_state, f"speed scaling ({SCALING}) is silent for")
        assert isinstance(error, NotReady)

    @pytest.mark.parametrize("running", [True, False])
    def test_a_robot_whose_program_stopped_refuses(self, connect, drivers, running):
        """The driver says so once, before anybody listens."""
        driver = drivers(*robot(running=running))
        operator = connect()
        wait_for(lambda: operator.newest("program running"))
        if running:
            operator.send_action([*POSE, 0.5])
            wait_for(lambda: driver.on(COMMANDS))
        else:
            with pytest.raises(Faulted, match="the robot's program is not running") as caught:
                operator.send_action([*POSE, 0.5])
            assert "protective or emergency stop" in caught.value.cause
            assert driver.on(COMMANDS) == []


class TestConformance(OperatorConformance):
    entry_point = "UROperator"
    arguments = QUICK

    @pytest.fixture(autouse=True)
    def driver(self, lasting_robot):
        """Who stands in for the arm."""
        self.arm = lasting_robot

    def commands_heard(self, operator):
        return len(self.arm.on(COMMANDS))
