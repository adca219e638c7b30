"""``python -m fluxvla_myrobot.demos FOLDER``: a few demonstrations of both tasks.

The simulated arm's joint 1 turns to the cup or to the shelf, and the gripper closes or opens:
enough to train on. Nothing is sent over ROS here; the simulation is in this process.
"""

from __future__ import annotations

import sys

import numpy as np
from fluxvla_sim.operators import URSimOperator

from fluxvla_core.data import LeRobotWriter
from fluxvla_myrobot.embodiment import HOME, SIZE, SPEC, STROKE

FPS = 10.0
TASKS = {"pick up the red cup": (0.8, 0.0), "place it on the shelf": (-0.8, STROKE)}
# The simulated gripper goes from 0 to 1.
UNITS = np.array([1.0] * 6 + [STROKE])


def main(folder: str, episodes: int = 4, frames: int = 20) -> None:
    """Write ``episodes`` of each task into ``folder``, as a LeRobot v3.0 dataset."""
    rng = np.random.default_rng(0)
    arm = URSimOperator(height=SIZE, width=SIZE)
    arm.connect()
    with LeRobotWriter(folder, FPS, SPEC) as writer:
        for number in range(2 * episodes):
            task, (angle, opening) = list(TASKS.items())[number % 2]
            start, end = np.array(HOME), np.array(HOME)
            start[0] = rng.uniform(-0.2, 0.2)
            end[[0, 6]] = angle, opening
            arm.reset(number)
            drive(arm, start, seconds=3.0)
            path = start + np.linspace(0, 1, frames + 1)[:, None] * (end - start)
            for target in path[1:]:
                frame = arm.get_frame()
                images = {f"cam_{name}": image for name, image in frame.images.items()}
                writer.add_frame(images, frame.state * UNITS, target, task)
                drive(arm, target, seconds=1 / FPS)
            writer.save_episode()
    arm.close()


def drive(arm: URSimOperator, target: np.ndarray, seconds: float) -> None:
    """In a straight line to ``target``, in the example's units."""
    steps = round(seconds * arm.embodiment.rate_hz)
    joints, start = arm.embodiment.joints, arm.get_state()
    lower, upper = [joint.lower for joint in joints], [joint.upper for joint in joints]
    for share in np.arange(1, steps + 1) / steps:
        arm.send_action(np.clip(start + share * (target / UNITS - start), lower, upper))


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python -m fluxvla_myrobot.demos FOLDER")
    main(sys.argv[1])
