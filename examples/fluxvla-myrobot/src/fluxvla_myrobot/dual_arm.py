"""The page's FAQ: a new operator alone, driven by an existing runner.

Two arms whose topics differ and which have no runner of their own. The operator says what is read
and written, ``RosOperator`` does the rest of the contract, ``AlohaInferenceRunner`` drives it.
"""

from __future__ import annotations

from fluxvla_core.ros2 import (
    JOINT_STATE,
    CommandSpec,
    RosOperator,
    StreamSpec,
    camera_stream,
    joints,
    message_class,
)
from fluxvla_myrobot.embodiment import DUAL_ARM


class MyDualArmOperator(RosOperator):
    """Two arms of six joints and a gripper, and a camera.

    Args:
        img_front_topic, joint_state_topic, joint_cmd_topic: as the page's configuration names them.
        connect_timeout_s, max_age_s: see ``RosOperator``.
    """

    embodiment = DUAL_ARM

    def __init__(
        self,
        img_front_topic: str,
        joint_state_topic: str,
        joint_cmd_topic: str,
        connect_timeout_s: float = 10.0,
        max_age_s: float = 0.5,
    ) -> None:
        super().__init__(connect_timeout_s=connect_timeout_s, max_age_s=max_age_s)
        self._image, self._state, self._command = (
            img_front_topic,
            joint_state_topic,
            joint_cmd_topic,
        )

    def streams(self):
        camera = camera_stream(self.embodiment.cameras[0], self._image)
        return [StreamSpec("arms", self._state, JOINT_STATE), camera]

    def commands(self):
        return [CommandSpec(self._command, JOINT_STATE)]

    def read_state(self, messages):
        return joints.positions(messages["arms"], self.embodiment.joint_names, "arms")

    def publish_action(self, action):
        message = message_class(JOINT_STATE)()
        self.publish(self._command, joints.fill(message, self.embodiment.joint_names, action))
