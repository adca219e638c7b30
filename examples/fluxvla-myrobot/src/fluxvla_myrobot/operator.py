"""An operator, as the page 'Adding Custom Engines' writes it.

Where the page uses rospy, this uses ``fluxvla_myrobot.topics``, a robot in memory. Its pictures are
arrays already, so there is no cv_bridge. The page's operator has no wrist camera although its
runner reads one; here it has.
"""
# The code below is the page's, in its own style.
# ruff: noqa
# fmt: off

import threading
from collections import deque

from fluxvla_myrobot import topics


class MyRobotOperator:
    """A custom robot's communication."""

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

        self._init_ros()

    def _init_ros(self):
        """Subscribe and advertise."""
        topics.Subscriber(self._img_front_topic, self._img_front_callback)
        topics.Subscriber(self._img_wrist_topic, self._img_wrist_callback)
        topics.Subscriber(self._joint_state_topic, self._joint_state_callback)
        self._joint_cmd_pub = topics.Publisher(self._joint_cmd_topic)
        self._gripper_pub = topics.Publisher('/gripper_command')

    def _img_front_callback(self, msg):
        """A picture of the front camera."""
        with self._lock:
            self._img_front_buffer.append(msg)

    def _img_wrist_callback(self, msg):
        """A picture of the wrist camera."""
        with self._lock:
            self._img_wrist_buffer.append(msg)

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
        msg = topics.JointState()
        msg.position = list(joint_positions)
        self._joint_cmd_pub.publish(msg)

    def movegrip(self, gripper_position):
        """Open or close the gripper."""
        self._gripper_pub.publish(float(gripper_position))
