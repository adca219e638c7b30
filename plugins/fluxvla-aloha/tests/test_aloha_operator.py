"""AlohaOperator: what it is told by a config, and what it does on real topics."""

from __future__ import annotations

import time
from contextlib import ExitStack
from types import SimpleNamespace

import numpy as np
import pytest
from fluxvla_aloha.base import TIMEOUT_S
from fluxvla_aloha.embodiment import aloha_spec, start_pose
from fluxvla_aloha.operator import AlohaOperator
from fluxvla_aloha.presets import COBOT_MAGIC, INTERBOTIX

from fluxvla_core import build_operator_from_cfg
from fluxvla_core.errors import ConfigError, LoadFailed, NotReady, Rejected
from fluxvla_core.operators import RunContext
from fluxvla_core.ros2 import IMAGE, JOINT_STATE, ODOMETRY, TWIST, BadMessage, message_class
from fluxvla_core.testing import OperatorConformance
from fluxvla_core.testing.ros2 import drivers, lasting_drivers, ros_domain

from .quick import QUICK, SMALL, SPECIFICATION

__all__ = ["drivers", "lasting_drivers", "ros_domain"]


START_POSE = start_pose("viperx300")


def raw(pose, closed, opened):
    """One arm's seven numbers as its driver has them."""
    return [*pose[:6], closed + pose[6] * (opened - closed)]


def robot(preset=COBOT_MAGIC, depth=False, base=False, pose=START_POSE, ends=None, **messages):
    """Streams and sinks of an ALOHA's drivers, for ``Driver``."""
    ends = ends or (preset.gripper_closed, preset.gripper_open)
    streams = [
        {
            "topic": state,
            "message": JOINT_STATE,
            "hz": 100,
            "names": list(preset.joints),
            "positions": raw(pose[:7], *ends),
            "follows": command,
        }
        for state, command in zip(preset.states, preset.commands, strict=True)
    ]
    streams += [{"topic": t, "message": IMAGE, "hz": 30, **SMALL} for t in preset.images]
    sinks = [{"topic": t, "message": messages.get("arm", JOINT_STATE)} for t in preset.commands]
    for topic in preset.gripper_commands or ():
        sinks.append({"topic": topic, "message": messages["gripper"]})
    if depth:
        kind = {"message": IMAGE, "hz": 30, "encoding": "16UC1", **SMALL}
        streams += [{"topic": t, **kind} for t in preset.depths]
    if base:
        streams.append(
            {"topic": preset.odometry, "message": ODOMETRY, "hz": 50, "data": [0.2, -0.1]}
        )
        sinks.append({"topic": preset.velocity, "message": TWIST})
    return streams, sinks


def wait_for(condition, seconds=8.0):
    until = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until, "did not happen in time"
        time.sleep(0.01)


@pytest.fixture
def connect(ros_domain):
    made = []

    def make(**arguments):
        operator = AlohaOperator(**{**QUICK, **arguments})
        made.append(operator)
        operator.connect()
        return operator

    yield make
    for operator in made:
        operator.close()


@pytest.fixture(scope="module")
def lasting_robot(lasting_drivers):
    return lasting_drivers(*robot())


class TestArmsThatNobodyNamed:
    """A cobot_magic has ARX X5 or PiPER arms behind the same topics."""

    def test_nothing_is_connected(self):
        context = RunContext(section="go", origins={"go.operator": "robot.py:7"})
        operator = build_operator_from_cfg(SPECIFICATION, context)

        with pytest.raises(ConfigError, match="which arms this ALOHA has is not known") as caught:
            operator.connect()
        assert caught.value.where == "robot.py:7: go.operator"
        assert "known are viperx300, arx_x5, piper" in caught.value.what
        assert (
            "--set <AlohaOperator>.arms=arx_x5 or --set <AlohaOperator>.arms=piper"
            in caught.value.next
        )

    @pytest.mark.parametrize("named", [{"arms": "piper"}, {"embodiment": aloha_spec().to_dict()}])
    def test_once_they_are_named_it_goes_on(self, ros_domain, named):
        operator = AlohaOperator(**{**QUICK, "arms": None, "connect_timeout_s": 0.1, **named})

        with pytest.raises(NotReady, match="nobody publishes"):
            operator.connect()


class TestCobotMagic:
    def test_state_images_depth_and_base(self, connect, drivers):
        drivers(*robot(depth=True, base=True))
        operator = connect(use_depth_image=True, use_robot_base=True)
        frame = operator.get_frame()

        np.testing.assert_allclose(frame.state, START_POSE)
        assert set(frame.images) == {"cam_high", "cam_left_wrist", "cam_right_wrist"}
        assert set(frame.depths) == set(frame.images)
        np.testing.assert_allclose(frame.depths["cam_high"], 1.5)
        np.testing.assert_allclose(frame.base, [0.2, -0.1])

    def test_a_speed_of_the_base_that_is_no_number(self, connect, drivers):
        streams, sinks = robot(base=True)
        drivers([*streams[:-1], streams[-1] | {"data": [float("nan"), 0.0]}], sinks)
        with pytest.raises(BadMessage, match=r"base \(/odom_raw\): its speed is \[nan, 0.0\]"):
            connect(use_robot_base=True)

    def test_both_arms_are_commanded_by_name_with_raw_grippers(self, connect, drivers):
        driver = drivers(*robot())
        operator = connect()
        action = np.array(START_POSE)
        action[0], action[6], action[13] = 0.3, 0.0, 0.5
        operator.send_action(action)
        wait_for(lambda: all(driver.on(topic) for topic in COBOT_MAGIC.commands))

        for index, topic in enumerate(COBOT_MAGIC.commands):
            (heard,) = driver.on(topic)
            assert tuple(heard["name"]) == COBOT_MAGIC.joints
            ends = COBOT_MAGIC.gripper_closed, COBOT_MAGIC.gripper_open
            wanted = raw(action[7 * index : 7 * index + 7], *ends)
            np.testing.assert_allclose(heard["position"], wanted)
        wait_for(lambda: np.allclose(operator.get_state(), action, atol=1e-9))

    def test_pipers_tell_their_grippers_in_metres(self, connect, drivers):
        driver = drivers(*robot(pose=start_pose("piper"), ends=(0.0, 0.07)))
        operator = connect(arms="piper")
        np.testing.assert_allclose(operator.get_frame().state, start_pose("piper"))
        action = np.array(start_pose("piper"))
        action[6], action[13] = 0.0, 0.5
        operator.send_action(action)
        wait_for(lambda: all(driver.on(topic) for topic in COBOT_MAGIC.commands))

        heard = [driver.on(topic)[0]["position"][6] for topic in COBOT_MAGIC.commands]
        np.testing.assert_allclose(heard, [0.0, 0.035])

    def test_the_base_stops_by_itself_and_with_every_stop(self, connect, drivers):
        driver = drivers(*robot(base=True))
        operator = connect(use_robot_base=True)

        def speeds():
            heard = driver.on("/cmd_vel")
            return [(h["linear"]["x"], h["angular"]["z"]) for h in heard]

        # From before the call: the first message may well be received late.
        began = time.monotonic()
        operator.drive(0.1, 0.0)
        wait_for(lambda: len(speeds()) == 2)
        assert speeds() == [(0.1, 0.0), (0.0, 0.0)]
        _, second = driver.on("/cmd_vel")
        assert second["at"] - began >= TIMEOUT_S

        # What was sent: of two commands at once a driver that stalls gets the newer one alone.
        sent = base_speeds(operator)
        operator.drive(0.2, 0.1)
        driven = len(sent)
        operator.stop()
        stopped = len(sent)
        operator.close()
        assert 0 < driven < stopped < len(sent)
        assert sent == [(0.2, 0.1)] + [(0.0, 0.0)] * (len(sent) - 1)
        wait_for(lambda: speeds()[2:] and speeds()[-1] == (0.0, 0.0))
        with pytest.raises(NotReady, match="aloha is not connected"):
            operator.drive(0.1, 0.0)

    def test_a_policy_drives_the_base_within_its_limits(self, connect, drivers, monkeypatch):
        # Nobody commands for a second where a machine stalls, and that is not what is tested.
        monkeypatch.setattr("fluxvla_aloha.base.TIMEOUT_S", 5.0)
        streams, sinks = robot(base=True)
        driver = drivers([*streams[:-1], streams[-1] | {"data": [0.0, 0.0]}], sinks)
        operator = connect(policy_drives_base=True)

        def speeds():
            return [(m["linear"]["x"], m["angular"]["z"]) for m in driver.on("/cmd_vel")]

        spec = operator.embodiment
        assert spec.joint_names[14:] == ("base_forward", "base_turn")
        assert [j.unit for j in spec.joints[14:]] == ["m/s", "rad/s"]
        np.testing.assert_array_equal(operator.get_frame().state[14:], [0.0, 0.0])
        with pytest.raises(Rejected, match="the policy drives the base"):
            operator.drive(0.1, 0.0)
        with pytest.raises(Rejected, match=r"base_forward: the command 0.4 m/s is outside"):
            operator.send_action([*START_POSE, 0.4, 0.0])
        published = base_speeds(operator)
        for place in range(1, 11):
            operator.send_action([*START_POSE, 0.02 * place, -0.02 * place])
            time.sleep(1 / spec.rate_hz)
        operator.stop()
        wait_for(lambda: speeds() and speeds()[-1] == (0.0, 0.0))
        sent = np.array(published)
        assert sent[9:].max() == pytest.approx(0.2)
        assert np.abs(np.diff(sent[:, 0])).max() <= 0.5 / spec.rate_hz + 0.0101

    def test_a_base_that_a_policy_drives_stops_when_nobody_commands(self, connect, drivers):
        streams, sinks = robot(base=True)
        driver = drivers([*streams[:-1], streams[-1] | {"data": [0.0, 0.0]}], sinks)
        connect(policy_drives_base=True).send_action([*START_POSE, 0.1, 0.0])
        wait_for(lambda: len(driver.on("/cmd_vel")) >= 2)
        first, second = driver.on("/cmd_vel")[:2]
        assert [m["linear"]["x"] for m in (first, second)] == [0.1, 0.0]

    def test_only_the_part_with_commands_drives_the_base(self, ros_domain, drivers):
        driver = drivers(*robot(base=True))
        with ExitStack() as stack:
            made = [AlohaOperator(**{**QUICK, "use_robot_base": True}) for _ in range(2)]
            control, cameras = made[0].without_cameras(), made[1].without_commands()
            for part in (cameras, control):
                stack.callback(part.close)
                part.connect()
            np.testing.assert_allclose(cameras.get_frame().base, [0.2, -0.1])
            with pytest.raises(Rejected, match="this part of aloha sends no commands"):
                cameras.drive(0.1, 0.0)
            cameras.stop()
            cameras.close()
            time.sleep(TIMEOUT_S)
            assert driver.on("/cmd_vel") == []

            control.drive(0.1, 0.0)
            wait_for(lambda: len(driver.on("/cmd_vel")) == 2)

    def test_without_a_base_there_is_no_driving(self):
        with pytest.raises(Rejected, match="the base is not used") as caught:
            AlohaOperator().drive(0.1, 0.0)

        assert caught.value.next == "--set <AlohaOperator>.use_robot_base=true"


def base_speeds(operator):
    """The speeds of the base that the operator sends from now on."""
    sent, publish = [], operator.publish

    def publishing(topic, message):
        if topic == "/cmd_vel":
            sent.append((message.linear.x, message.angular.z))
        publish(topic, message)

    operator.publish = publishing
    return sent


class TestInterbotix:
    def test_without_its_messages_the_package_is_named(self, ros_domain):
        operator = AlohaOperator(preset="interbotix", **QUICK)

        with pytest.raises(LoadFailed, match="interbotix_xs_msgs") as caught:
            operator.connect()
        assert "ros-$ROS_DISTRO-interbotix-xs-msgs" in caught.value.next

    def test_arms_and_grippers_have_topics_of_their_own(self, connect, drivers):
        array, number = "std_msgs.msg:Float64MultiArray", "std_msgs.msg:Float64"
        driver = drivers(*robot(INTERBOTIX, arm=array, gripper=number))
        operator = connect(preset="interbotix", arm_message=array, gripper_message=number)
        np.testing.assert_allclose(operator.get_frame().state, START_POSE)

        action = np.array(START_POSE)
        action[1], action[13] = -0.5, 0.0
        operator.send_action(action)
        topics = [*INTERBOTIX.commands, *INTERBOTIX.gripper_commands]
        wait_for(lambda: all(driver.on(topic) for topic in topics))

        sent = [driver.on(topic)[0]["data"] for topic in topics]
        np.testing.assert_allclose(sent[0], action[:6])
        np.testing.assert_allclose(sent[1], action[7:13])
        np.testing.assert_allclose(sent[2:], [INTERBOTIX.gripper_open, INTERBOTIX.gripper_closed])

    def test_its_messages_are_imported_by_their_dotted_name(self, monkeypatch):
        module = SimpleNamespace(JointGroupCommand=SimpleNamespace)
        monkeypatch.setitem(__import__("sys").modules, "interbotix_xs_msgs", SimpleNamespace())
        monkeypatch.setitem(__import__("sys").modules, "interbotix_xs_msgs.msg", module)

        assert message_class(INTERBOTIX.arm_message) is SimpleNamespace
        message_class.cache_clear()


class TestConformance(OperatorConformance):
    entry_point = "AlohaOperator"
    arguments = QUICK

    @pytest.fixture(autouse=True)
    def driver(self, lasting_robot):
        """Who stands in for the arms."""
        self.arms = lasting_robot

    def commands_heard(self, operator):
        return sum(len(self.arms.on(topic)) for topic in COBOT_MAGIC.commands)
