"""gym-aloha's insertion, ``gym_aloha/AlohaInsertion-v0``: a peg goes into a socket in the air."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fluxvla_sim.aloha.arms import TABLE, TwoArms

if TYPE_CHECKING:
    import numpy.typing as npt

# Metres, world frame: the peg on the right arm's side, the socket on the left one's.
PEG_LOW, PEG_HIGH = (0.1, 0.4, 0.05), (0.2, 0.6, 0.05)
SOCKET_LOW, SOCKET_HIGH = (-0.2, 0.4, 0.05), (-0.1, 0.6, 0.05)
_PEG, _PIN = "red_peg", "pin"
_SOCKET = ("socket-1", "socket-2", "socket-3", "socket-4")


def sample_peg_and_socket(seed: int) -> npt.NDArray[np.float64]:
    """Both poses at the start, ``(14,)``, peg first: position in metres, quaternion wxyz."""
    rng, upright = np.random.RandomState(seed), [1.0, 0.0, 0.0, 0.0]
    peg = rng.uniform(PEG_LOW, PEG_HIGH)
    return np.concatenate([peg, upright, rng.uniform(SOCKET_LOW, SOCKET_HIGH), upright])


class InsertionScene(TwoArms):
    """The arms, a peg, and a socket with a pin inside that only a peg in it can touch."""

    file = "bimanual_viperx_insertion.xml"

    def reset(self, seed: int) -> None:
        self.reset_to(sample_peg_and_socket(seed))

    def reward(self) -> int:
        """gym-aloha's reward: 1 both touched, 2 both lifted, 3 they touch in the air, 4 inserted.

        As there, one named finger of each arm stands for its gripper.
        """
        peg = self.touching(_PEG)
        socket = set().union(*(self.touching(name) for name in _SOCKET))
        if self.geom[_PIN] in peg:
            return 4
        in_air = self.geom[TABLE] not in peg | socket
        if in_air and any(self.geom[name] in peg for name in _SOCKET):
            return 3
        if self.fingers["left"][0] in socket and self.fingers["right"][1] in peg:
            return 2 if in_air else 1
        return 0


@dataclass(frozen=True)
class InsertionFacts:
    """See :class:`fluxvla_sim.world.Facts`; the rewards are gym-aloha's."""

    steps: int = 0
    reward: int = 0
    best_reward: int = 0

    def after(self, scene: InsertionScene) -> InsertionFacts:
        """The facts after one more control step of ``scene``."""
        reward = scene.reward()
        return InsertionFacts(self.steps + 1, reward, max(self.best_reward, reward))


class Insertion:
    """gym-aloha's task: the peg touches the pin inside the socket (reward 4), at any moment."""

    name = "insertion"
    instruction = "put the peg into the socket"
    record_steps = 300

    def success(self, facts: InsertionFacts) -> bool:
        return facts.best_reward == 4

    def done(self, facts: InsertionFacts) -> bool:
        return self.success(facts)
