"""An inference runner, as the page 'Adding Custom Engines' writes it.

What ``_execute_actions`` is given has passed the core's safety: finite, and within the position,
velocity and acceleration limits of the config's ``embodiment``.
"""
# The code below is the page's, in its own style.
# ruff: noqa
# fmt: off


from typing import Dict, List, Tuple

import numpy as np

from fluxvla_core import BaseInferenceRunner


class MyRobotInferenceRunner(BaseInferenceRunner):
    """A custom inference runner."""

    def __init__(self,
                 prepare_pose: List[float] = None,
                 *args, **kwargs):
        # Defaults.
        if 'camera_names' not in kwargs or kwargs['camera_names'] is None:
            kwargs['camera_names'] = ['cam_front', 'cam_wrist']

        if 'operator' not in kwargs or kwargs['operator'] is None:
            kwargs['operator'] = {
                'type': 'MyRobotOperator',
                'img_front_topic': '/camera/color/image_raw',
                'joint_state_topic': '/joint_states',
                'joint_cmd_topic': '/joint_commands',
            }

        super().__init__(*args, **kwargs)
        self.prepare_pose = prepare_pose

    def get_ros_observation(self) -> Tuple:
        """Read synchronized sensor data.

        Returns:
            tuple: (front image, wrist image, joint state)
        """
        frame = self.ros_operator.get_frame()
        img_front = frame['img_front']
        img_wrist = frame['img_wrist']
        joint_state = frame['joint_state']
        return img_front, img_wrist, joint_state

    def update_observation_window(self) -> Dict:
        """Make the model's input.

        Returns:
            dict: 'qpos' and the images
        """
        img_front, img_wrist, joint_state = self.get_ros_observation()

        observation = {
            'qpos': np.array(joint_state, dtype=np.float32),
            'images': {
                'cam_front': img_front,
                'cam_wrist': img_wrist,
            }
        }
        return observation

    def _execute_actions(self, actions: np.ndarray, rate):
        """Send the predicted actions to the robot.

        Args:
            actions: shape=(action_chunk, action_dim)
            rate: sets the pace
        """
        for action in actions:
            joint_cmd = action[:6]     # the first six are joint angles
            gripper_cmd = action[6]    # the seventh opens and closes the gripper
            self.ros_operator.servoj(joint_cmd)
            self.ros_operator.movegrip(gripper_cmd)
            rate.sleep()
