"""ROS 2 robots: one connection, typed streams, messages as arrays, safe stops.

``rclpy`` and message packages are imported when an operator connects, never before: a config can be
checked, and an operator built and described, on a machine without ROS. Only what ROS 2 Humble's
rclpy has is used, so the same code runs on Humble, Jazzy and Kilted.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from fluxvla_core import _lazy

if TYPE_CHECKING:
    from fluxvla_core.contracts.frame import RobotFrame as RobotFrame
    from fluxvla_core.ros2 import images as images
    from fluxvla_core.ros2 import joints as joints
    from fluxvla_core.ros2 import qos as qos
    from fluxvla_core.ros2.connection import Connection as Connection
    from fluxvla_core.ros2.connection import require_rclpy as require_rclpy
    from fluxvla_core.ros2.faults import AMOUNTS as AMOUNTS
    from fluxvla_core.ros2.faults import MODES as MODES
    from fluxvla_core.ros2.faults import Fault as Fault
    from fluxvla_core.ros2.faults import Faults as Faults
    from fluxvla_core.ros2.faults import Outbox as Outbox
    from fluxvla_core.ros2.messages import COMPRESSED_IMAGE as COMPRESSED_IMAGE
    from fluxvla_core.ros2.messages import FLOAT64 as FLOAT64
    from fluxvla_core.ros2.messages import FLOAT64_ARRAY as FLOAT64_ARRAY
    from fluxvla_core.ros2.messages import IMAGE as IMAGE
    from fluxvla_core.ros2.messages import JOINT_STATE as JOINT_STATE
    from fluxvla_core.ros2.messages import ODOMETRY as ODOMETRY
    from fluxvla_core.ros2.messages import TWIST as TWIST
    from fluxvla_core.ros2.messages import BadMessage as BadMessage
    from fluxvla_core.ros2.messages import message_class as message_class
    from fluxvla_core.ros2.operator import RosOperator as RosOperator
    from fluxvla_core.ros2.stop_motion import checked_action as checked_action
    from fluxvla_core.ros2.streams import AUXILIARY as AUXILIARY
    from fluxvla_core.ros2.streams import CAMERA as CAMERA
    from fluxvla_core.ros2.streams import DEPTH as DEPTH
    from fluxvla_core.ros2.streams import STATE as STATE
    from fluxvla_core.ros2.streams import CommandSpec as CommandSpec
    from fluxvla_core.ros2.streams import StreamSpec as StreamSpec
    from fluxvla_core.ros2.streams import camera_stream as camera_stream
    from fluxvla_core.ros2.streams import depth_stream as depth_stream
    from fluxvla_core.ros2.sync import Stale as Stale

__getattr__, __dir__, __all__ = _lazy.attach(__name__, {"SIDE": "AUXILIARY"})
