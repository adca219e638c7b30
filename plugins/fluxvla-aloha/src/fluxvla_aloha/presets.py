"""Topics and messages of the ALOHAs that are sold: AgileX cobot_magic and Interbotix ALOHA.

Both have two arms and three cameras. They differ in the names of topics and joints, in the raw
value of a gripper's ends, in the messages that command an arm, and in the arms: Interbotix takes
its own ViperX 300; cobot_magic came with ARX X5 (``arx5v.launch`` in its readme) and comes with
AgileX PiPER arms, and nothing in its messages shows which.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from fluxvla_core.ros2 import JOINT_STATE


@dataclass(frozen=True)
class Preset:
    """One kind of ALOHA. Pairs are left, right; triples are front, left, right.

    Args:
        images, depths: image topics.
        states, commands: of the arms.
        gripper_commands: of the grippers, where the arms' commands do not hold them.
        odometry, velocity: of the mobile base.
        joints: names of one arm's six joints and its gripper in joint states.
        gripper_closed, gripper_open: a gripper's raw values at its ends.
        arm_message, gripper_message: types of the commands.
        arms: name of its arms in ``fluxvla_aloha.arms``; None where it comes with different ones.
    """

    images: tuple[str, str, str]
    depths: tuple[str, str, str]
    states: tuple[str, str]
    commands: tuple[str, str]
    gripper_commands: tuple[str, str] | None
    odometry: str
    velocity: str
    joints: tuple[str, ...]
    gripper_closed: float
    gripper_open: float
    arm_message: str = JOINT_STATE
    gripper_message: str = JOINT_STATE
    arms: str | None = None


COBOT_MAGIC = Preset(
    # aloha-devel/act/inference.py in agilexrobotics/cobot_magic @ 447b8c9; its ports to ROS 2 keep
    # the names. The gripper's ends are those of its start poses left1 and left0.
    images=(
        "/camera_f/color/image_raw",
        "/camera_l/color/image_raw",
        "/camera_r/color/image_raw",
    ),
    depths=(
        "/camera_f/depth/image_raw",
        "/camera_l/depth/image_raw",
        "/camera_r/depth/image_raw",
    ),
    states=("/puppet/joint_left", "/puppet/joint_right"),
    commands=("/master/joint_left", "/master/joint_right"),
    gripper_commands=None,
    odometry="/odom_raw",
    velocity="/cmd_vel",
    joints=("joint0", "joint1", "joint2", "joint3", "joint4", "joint5", "joint6"),
    gripper_closed=-0.3393220901489258,
    gripper_open=3.557830810546875,
)

INTERBOTIX = Preset(
    # aloha/robot_utils.py in Interbotix/aloha @ 2fbacff: FOLLOWER_GRIPPER_JOINT_CLOSE and _OPEN.
    images=(
        "/cam_high/camera/color/image_rect_raw",
        "/cam_left_wrist/camera/color/image_rect_raw",
        "/cam_right_wrist/camera/color/image_rect_raw",
    ),
    depths=(
        "/cam_high/camera/depth/image_rect_raw",
        "/cam_left_wrist/camera/depth/image_rect_raw",
        "/cam_right_wrist/camera/depth/image_rect_raw",
    ),
    states=("/follower_left/joint_states", "/follower_right/joint_states"),
    commands=("/follower_left/commands/joint_group", "/follower_right/commands/joint_group"),
    gripper_commands=(
        "/follower_left/commands/joint_single",
        "/follower_right/commands/joint_single",
    ),
    odometry="/mobile_base/odom",
    velocity="/mobile_base/cmd_vel",
    joints=(
        "waist",
        "shoulder",
        "elbow",
        "forearm_roll",
        "wrist_angle",
        "wrist_rotate",
        "gripper",
    ),
    gripper_closed=0.6197,
    gripper_open=1.6214,
    arm_message="interbotix_xs_msgs.msg:JointGroupCommand",
    gripper_message="interbotix_xs_msgs.msg:JointSingleCommand",
    arms="viperx300",
)

PRESETS: Mapping[str, Preset] = {"cobot_magic": COBOT_MAGIC, "interbotix": INTERBOTIX}
