"""An operator, as the page 'Adding Custom Engines' writes it, on ROS 2.

Three things differ from the page. ROS 2 is where ROS 1 was, and ``connect`` opens it, not the
constructor, so that a config can be checked without a robot. There is a wrist camera, which the
page's runner reads and its operator lacks. Below the page's methods is what it leaves out of the
operator contract.
"""
# The code below is the page's, in its own style.
# ruff: noqa
# fmt: off

import threading
from collections import deque

from fluxvla_core.errors import NotReady
from fluxvla_core.ros2 import checked_action
from fluxvla_core.ros2 import images
from fluxvla_myrobot.embodiment import SPEC


class MyRobotOperator:
    """A custom robot's ROS communication."""

    def __init__(self,
                 img_front_topic: str,
                 joint_state_topic: str,
                 joint_cmd_topic: str,
                 use_depth_image: bool = False,
                 img_front_depth_topic: str = None,
                 publish_rate: int = 30,
                 img_wrist_topic: str = '/wrist_camera/color/image_raw'):
        self.publish_rate = publish_rate
        self._img_front_topic = img_front_topic
        self._img_wrist_topic = img_wrist_topic
        self._joint_state_topic = joint_state_topic
        self._joint_cmd_topic = joint_cmd_topic
        self._use_depth_image = use_depth_image
        self._img_front_depth_topic = img_front_depth_topic

        # Buffers.
        self._img_front_buffer = deque(maxlen=1)
        self._img_wrist_buffer = deque(maxlen=1)
        self._joint_state_buffer = deque(maxlen=1)
        self._lock = threading.Lock()

        self._connection = None

    def _init_ros(self):
        """Subscribe and advertise."""
        from fluxvla_core.ros2 import Connection
        self._connection = Connection('my_robot')
        node = self._connection.node

        from rclpy.qos import qos_profile_sensor_data
        from sensor_msgs.msg import Image, JointState
        from std_msgs.msg import Float64

        node.create_subscription(
            Image, self._img_front_topic, self._img_front_callback, qos_profile_sensor_data)
        node.create_subscription(
            Image, self._img_wrist_topic, self._img_wrist_callback, qos_profile_sensor_data)
        node.create_subscription(
            JointState, self._joint_state_topic, self._joint_state_callback, qos_profile_sensor_data)
        self._joint_cmd_pub = node.create_publisher(
            JointState, self._joint_cmd_topic, 1)
        self._gripper_pub = node.create_publisher(
            Float64, '/gripper_command', 1)

    def _img_front_callback(self, msg):
        """An image of the front camera."""
        img = images.to_rgb(msg, msg.height, msg.width)
        with self._lock:
            self._img_front_buffer.append(img)

    def _img_wrist_callback(self, msg):
        """An image of the wrist camera."""
        img = images.to_rgb(msg, msg.height, msg.width)
        with self._lock:
            self._img_wrist_buffer.append(img)

    def _joint_state_callback(self, msg):
        """The joints."""
        with self._lock:
            self._joint_state_buffer.append(list(msg.position))

    def get_frame(self) -> dict:
        """The newest readings.

        Returns:
            dict: img_front, img_wrist and joint_state
        """
        with self._lock:
            frame = {
                'img_front': self._img_front_buffer[-1].copy()
                    if self._img_front_buffer else None,
                'img_wrist': self._img_wrist_buffer[-1].copy()
                    if self._img_wrist_buffer else None,
                'joint_state': self._joint_state_buffer[-1].copy()
                    if self._joint_state_buffer else None,
            }
        return frame

    def servoj(self, joint_positions):
        """Send joint positions."""
        from sensor_msgs.msg import JointState
        msg = JointState()
        msg.position = list(joint_positions)
        self._joint_cmd_pub.publish(msg)

    def movegrip(self, gripper_position):
        """Open or close the gripper."""
        from std_msgs.msg import Float64
        self._gripper_pub.publish(Float64(data=float(gripper_position)))

    # What the page leaves out.

    api = '1.0'
    embodiment = SPEC

    def connect(self):
        """Open the connection; nothing if it is open."""
        if self._connection is None:
            self._init_ros()

    def send_action(self, action):
        """Send one command of seven numbers, if they are within the limits."""
        checked = checked_action(self.embodiment, action)
        if self._connection is None:
            raise NotReady('the robot is not connected', next='call connect() first')
        self.servoj(checked[:6])
        self.movegrip(checked[6])

    def stop(self):
        """Nothing is sent: the arm stays at its last command."""

    def close(self):
        """Give the connection back and forget what was read; any number of times."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None
        for buffer in (self._img_front_buffer, self._img_wrist_buffer, self._joint_state_buffer):
            buffer.clear()
