"""An environment and policies for the tests; here because worker processes import them by name."""

from __future__ import annotations

import numpy as np


class Box:
    """What GymnasiumEnvironment uses of a space."""

    dtype, shape = np.float32, (1,)

    def seed(self, seed):
        self.seeded = seed


class Walk:
    """A walker on a line in Gymnasium's interface; success at 1, the end at -1, noise by seed."""

    def __init__(self, info_key: str = "is_success", pictures: bool = False) -> None:
        self.action_space = Box()
        self.info_key, self.pictures = info_key, pictures
        self.closed = 0

    def reset(self, seed=None):
        self.rng, self.place, self.steps = np.random.default_rng(seed), 0.0, 0
        return self._seen(), {}

    def step(self, action):
        assert action.dtype == np.float32
        assert action.shape == (1,)
        self.place += float(action[0]) + 0.05 * self.rng.normal()
        self.steps += 1
        info = {self.info_key: self.place >= 1}
        return self._seen(), self.place, self.place <= -1, self.steps >= 40, info

    def close(self):
        self.closed += 1

    def _seen(self):
        if not self.pictures:
            return np.array([self.place])
        picture = np.full((4, 5, 3), 9, np.uint8)
        return {"z": np.array([[1.0, 2.0]]), "eye": picture, "a": np.array([self.place])}


class Forward:
    """Walks ``speed`` a step, in chunks of 3; knows how often it was reset."""

    def __init__(self, speed: float = 0.2) -> None:
        self.speed, self.seeds, self.place = speed, [], None

    def enter(self, environment):
        self.place = environment

    def reset(self, seed):
        self.seeds.append(seed)

    def predict_action(self, observation):
        return np.full((3, 1), self.speed)


def make_environment():
    from fluxvla_core.evaluate.environment import GymnasiumEnvironment

    return GymnasiumEnvironment(Walk)
