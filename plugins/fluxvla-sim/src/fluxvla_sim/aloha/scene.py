"""gym-aloha's cube scene, ``gym_aloha/AlohaTransferCube-v0``, for both tasks with the cube."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from fluxvla_sim.aloha.arms import TABLE, TwoArms

if TYPE_CHECKING:
    import numpy.typing as npt

CUBE_LOW, CUBE_HIGH = (0.0, 0.4, 0.05), (0.2, 0.6, 0.05)  # metres, world frame
_CUBE = "red_box"


def sample_cube(seed: int) -> npt.NDArray[np.float64]:
    """The cube's pose at the start, ``(7,)``: position in metres, quaternion wxyz."""
    position = np.random.RandomState(seed).uniform(CUBE_LOW, CUBE_HIGH)
    return np.concatenate([position, [1.0, 0.0, 0.0, 0.0]])


class AlohaScene(TwoArms):
    """The arms and one cube on the right arm's side."""

    file = "bimanual_viperx_transfer_cube.xml"

    def reset(self, seed: int) -> None:
        self.reset_to(sample_cube(seed))

    @property
    def cube(self) -> npt.NDArray[np.float64]:
        """``(7,)`` the cube's pose."""
        return self.objects

    def fingers_on_cube(self, arm: str) -> tuple[bool, bool]:
        """Which of ``arm``'s two fingers (left, right) touch the cube."""
        touching = self.touching(_CUBE)
        left, right = self.fingers[arm]
        return left in touching, right in touching

    def reward(self) -> int:
        """gym-aloha's reward: 1 right gripper touches, 2 lifted, 3 left touches, 4 handed over.

        As there, one named finger of each arm stands for its gripper.
        """
        touching = self.touching(_CUBE)
        on_table = self.geom[TABLE] in touching
        if self.fingers["left"][0] in touching:
            return 3 if on_table else 4
        if self.fingers["right"][1] in touching:
            return 1 if on_table else 2
        return 0
