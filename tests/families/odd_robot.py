"""A plugin file: a robot of 13 joints whose images are 97 x 131, and a simulation of it."""

from __future__ import annotations

from typing import Any

import numpy as np

from fluxvla_core import (
    ENVIRONMENTS,
    OPERATORS,
    Camera,
    EmbodimentSpec,
    EnvironmentSpec,
    Frame,
    Joint,
    Step,
    TaskSpec,
)
from fluxvla_core.operators import SimulatedClock

JOINTS, HEIGHT, WIDTH, RATE = 13, 97, 131, 20.0
INSTRUCTION = "wave at the camera"


def robot(cameras: int) -> EmbodimentSpec:
    joints = tuple(Joint(f"joint_{i}", "rad", -2.0, 2.0, 2.0, 20.0) for i in range(JOINTS))
    eyes = tuple(Camera(f"eye_{i}", HEIGHT, WIDTH) for i in range(cameras))
    return EmbodimentSpec("odd", joints, eyes, RATE)


def images(cameras: int, state: Any) -> dict[str, Any]:
    """Stripes that move with the state, of another colour in each camera."""
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH]
    found = {}
    for camera in range(cameras):
        shade = (rows + 2 * columns + 40 * camera + int(100 * state[0])) % 256
        found[f"eye_{camera}"] = np.stack([shade, 255 - shade, shade // 2], -1).astype(np.uint8)
    return found


@OPERATORS.register_module()
class OddOperator:
    """It is at once where it is commanded to be, in simulated time."""

    api = "1.0"

    def __init__(self, cameras: int = 1) -> None:
        self.embodiment, self.clock = robot(cameras), SimulatedClock()
        self.cameras, self.state = cameras, np.zeros(JOINTS)

    def connect(self) -> None:
        return

    def get_frame(self) -> Frame:
        seen = images(self.cameras, self.state)
        stamps = dict.fromkeys(("state", *seen), self.clock.now())
        return Frame(self.state.copy(), seen, stamps)

    def send_action(self, action: Any) -> None:
        self.state = np.array(action, np.float64)
        self.clock.advance(1 / RATE)

    def stop(self) -> None:
        return

    def close(self) -> None:
        return


@ENVIRONMENTS.register_module()
class OddWorld:
    """The same robot; a task without a goal."""

    def __init__(self, cameras: int = 1) -> None:
        tasks = (TaskSpec("wave", INSTRUCTION, 12),)
        self.spec = EnvironmentSpec("odd", robot(cameras), tasks, limited=True)
        self.count, self.state = cameras, np.zeros(JOINTS)

    def reset(self, seed: int, task: str) -> None:
        self.state = np.random.default_rng(seed).uniform(-0.2, 0.2, JOINTS)

    def step(self, action: Any) -> Step:
        assert action.shape == (JOINTS,)
        self.state = np.array(action, np.float64)
        return Step(0.0, False, False)

    def observe(self, cameras: Any) -> Any:
        assert [(c.height, c.width) for c in cameras] == [(HEIGHT, WIDTH)] * len(cameras)
        seen = images(self.count, self.state)
        return {
            "qpos": self.state.astype(np.float32),
            "images": {c.name: seen[c.name] for c in cameras},
            "task_description": INSTRUCTION,
        }

    def close(self) -> None:
        return
