"""The config of ALOHA's operator, its messages, and velocity commands of its base; no ROS."""

from __future__ import annotations

import time
from types import SimpleNamespace

import numpy as np
import pytest
from fluxvla_aloha.arms import ARMS
from fluxvla_aloha.base import TIMEOUT_S, BaseDrive
from fluxvla_aloha.embodiment import aloha_spec
from fluxvla_aloha.operator import AlohaOperator, fill_command
from fluxvla_aloha.presets import INTERBOTIX

from fluxvla_core import build_operator_from_cfg
from fluxvla_core.errors import ConfigError, Rejected

from .quick import SMALL, SPECIFICATION


class TestConfig:
    def test_the_specifications_table_is_the_default(self):
        built = build_operator_from_cfg(SPECIFICATION)
        plain = AlohaOperator()

        assert isinstance(built, AlohaOperator)
        assert built.streams() == plain.streams()
        assert built.commands() == plain.commands()
        assert built.embodiment == aloha_spec()

    def test_topics_and_cameras_are_those_of_the_config(self):
        operator = AlohaOperator(
            img_front_topic="/top/compressed",
            puppet_arm_left_topic="/l",
            camera_names=("top",),
            camera_rate_hz=15.0,
            publish_rate=25.0,
            **SMALL,
        )
        left, right, top = operator.streams()

        assert (left.topic, right.topic) == ("/l", "/puppet/joint_right")
        assert (top.name, top.topic, top.expected_hz) == ("top", "/top/compressed", 15.0)
        assert top.message.endswith("CompressedImage")
        assert (top.camera.height, top.camera.width) == (48, 64)
        assert operator.embodiment.rate_hz == 25.0

    def test_depth_and_base_are_read_only_if_wanted(self):
        names = [s.name for s in AlohaOperator(use_depth_image=True, use_robot_base=True).streams()]

        assert names == [
            "left arm",
            "right arm",
            "cam_high",
            "cam_high_depth",
            "cam_left_wrist",
            "cam_left_wrist_depth",
            "cam_right_wrist",
            "cam_right_wrist_depth",
            "base",
        ]
        assert [c.topic for c in AlohaOperator(use_robot_base=True).commands()][-1] == "/cmd_vel"

    def test_interbotix_has_topics_messages_and_grippers_of_its_own(self):
        operator = AlohaOperator(preset="interbotix")

        assert [s.topic for s in operator.streams()] == [*INTERBOTIX.states, *INTERBOTIX.images]
        assert [(c.topic, c.message) for c in operator.commands()] == [
            ("/follower_left/commands/joint_group", "interbotix_xs_msgs.msg:JointGroupCommand"),
            ("/follower_right/commands/joint_group", "interbotix_xs_msgs.msg:JointGroupCommand"),
            ("/follower_left/commands/joint_single", "interbotix_xs_msgs.msg:JointSingleCommand"),
            ("/follower_right/commands/joint_single", "interbotix_xs_msgs.msg:JointSingleCommand"),
        ]

    @pytest.mark.parametrize(
        ("arguments", "what"),
        [
            (
                {"preset": "alhoa"},
                "unknown ALOHA preset 'alhoa'; known are cobot_magic, interbotix",
            ),
            ({"camera_names": tuple("abcd")}, "an ALOHA has 3 cameras, got"),
            ({"camera_names": ("a", "a")}, "AlohaOperator: camera names must be unique; twice: a"),
            ({"publish_rate": 0}, "AlohaOperator: rate_hz must be positive, got 0"),
            ({"joint_names": ("a", "b")}, "joint_names are 7 names of one arm"),
            ({"gripper_closed": 1.0, "gripper_open": 1.0}, "must be different finite numbers"),
            ({"base_max_linear": -1}, "base_max_linear must be positive, got -1"),
            ({"arms": "x5"}, "unknown arms 'x5'; known are viperx300, arx_x5, piper"),
            ({"arms": "piper", "embodiment": aloha_spec().to_dict()}, "both say which arms"),
        ],
    )
    def test_values_out_of_range_are_named(self, arguments, what):
        with pytest.raises(ConfigError, match=what):
            AlohaOperator(**arguments)

    @pytest.mark.parametrize("arms", ARMS)
    def test_arms_that_are_named_have_limits_of_their_own(self, arms):
        assert AlohaOperator(arms=arms).embodiment == aloha_spec(arms=arms)

    def test_interbotix_sells_one_kind_of_arms(self):
        assert AlohaOperator(preset="interbotix").embodiment == aloha_spec(arms="viperx300")
        assert AlohaOperator(preset="interbotix", arms="piper").embodiment.name == "aloha_piper"

    def test_other_arms_bring_their_own_limits(self):
        other = aloha_spec().to_dict()
        other["name"] = "sawyer"
        other["joints"][0]["upper"] = 2.0
        operator = AlohaOperator(embodiment=other, **SMALL)

        assert operator.embodiment.name == "sawyer"
        assert operator.embodiment.joints[0].upper == 2.0
        assert operator.embodiment.cameras[0].height == 48

    def test_an_embodiment_of_another_shape_is_refused(self):
        other = aloha_spec().to_dict()
        other["joints"] = other["joints"][:7]

        with pytest.raises(ConfigError, match="commands two arms of six joints and a gripper"):
            AlohaOperator(embodiment=other)


class TestMessages:
    def test_joint_states_get_names(self):
        filled = fill_command(SimpleNamespace(position=[]), ("a", "b"), np.array([1.0, 2.0]), "arm")

        assert (filled.name, filled.position) == (["a", "b"], [1.0, 2.0])

    def test_interbotix_groups_and_singles(self):
        """Their classes are not on any package index; these have the same fields."""
        group = fill_command(SimpleNamespace(name="", cmd=[]), ("a", "b"), np.ones(2), "arm")
        single = fill_command(SimpleNamespace(name="", cmd=0.0), ("g",), np.array([0.7]), "gripper")

        assert (group.name, group.cmd) == ("arm", [1.0, 1.0])
        assert (single.name, single.cmd) == ("gripper", 0.7)

    def test_arrays_and_numbers(self):
        assert fill_command(SimpleNamespace(data=[]), "ab", np.ones(2), "").data == [1.0, 1.0]
        assert fill_command(SimpleNamespace(data=0.0), "a", np.ones(1), "").data == 1.0

    def test_other_messages_are_refused(self):
        with pytest.raises(ConfigError, match="none of the fields position, cmd and data"):
            fill_command(SimpleNamespace(text=""), "a", np.ones(1), "")


class TestBaseDrive:
    def drive(self):
        sent = []

        def twist():
            return SimpleNamespace(linear=SimpleNamespace(x=0.0), angular=SimpleNamespace(z=0.0))

        def publish(message):
            sent.append((message.linear.x, message.angular.z))

        return BaseDrive(publish, twist, 0.3, 0.5), sent

    @pytest.mark.parametrize(
        ("speeds", "what"),
        [
            ((0.31, 0.0), "the base's forward speed 0.31 m/s is beyond 0.3 m/s"),
            ((0.0, -0.6), "the base's turning speed -0.6 rad/s is beyond 0.5 rad/s"),
            ((float("nan"), 0.0), "forward speed nan m/s"),
        ],
    )
    def test_speeds_beyond_the_limits_are_refused(self, speeds, what):
        drive, sent = self.drive()
        with pytest.raises(Rejected, match=what):
            drive.drive(*speeds)

        assert sent == []

    def test_a_speed_runs_out(self):
        drive, sent = self.drive()
        drive.drive(0.1, 0.2)
        drive.tick()
        assert sent == [(0.1, 0.2)]

        time.sleep(TIMEOUT_S + 0.01)
        drive.tick()
        drive.tick()
        assert sent == [(0.1, 0.2), (0.0, 0.0)]
