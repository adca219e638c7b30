"""``python -m fluxvla_myrobot.demos FOLDER``: a few demonstrations of both tasks.

Joint 1 turns to the cup or to the shelf, and the gripper closes or opens: enough to train on.
"""

from __future__ import annotations

import itertools
import sys

import numpy as np

from fluxvla_core.data.writer import LeRobotWriter
from fluxvla_myrobot.embodiment import SPEC
from fluxvla_myrobot.topics import HOME, STROKE, picture

FPS = 10.0
TASKS = {"pick up the red cup": (0.8, 0.0), "place it on the shelf": (-0.8, STROKE)}


def main(folder: str, episodes: int = 4, frames: int = 20) -> None:
    """Write ``episodes`` of each task into ``folder``, as a LeRobot v3.0 dataset."""
    rng = np.random.default_rng(0)
    with LeRobotWriter(folder, FPS, SPEC) as writer:
        for number in range(2 * episodes):
            task, (angle, opening) = list(TASKS.items())[number % 2]
            start, end = np.array(HOME), np.array(HOME)
            start[0] = rng.uniform(-0.2, 0.2)
            end[[0, 6]] = angle, opening
            path = start + np.linspace(0, 1, frames + 1)[:, None] * (end - start)
            for pose, target in itertools.pairwise(path):
                images = {"cam_front": picture(pose), "cam_wrist": picture(pose[::-1])}
                writer.add_frame(images, pose, target, task)
            writer.save_episode()


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python -m fluxvla_myrobot.demos FOLDER")
    main(sys.argv[1])
