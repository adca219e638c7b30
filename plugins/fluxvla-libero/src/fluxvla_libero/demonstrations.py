"""One demonstration of the scripted expert, as the frames of a dataset."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fluxvla_libero.embodiment import CAMERAS
from fluxvla_libero.expert import Expert
from fluxvla_libero.scene import LiberoScene
from fluxvla_libero.suites import NUM_STEPS_WAIT, SuiteTask, max_steps

if TYPE_CHECKING:
    import numpy.typing as npt

    from fluxvla_core.spec.embodiment import Camera

_CAREFUL = 0.25  # share of the noise where the gripper is close to something
_SMOOTH = 0.8  # how much of the noise stays from one step to the next


@dataclass(frozen=True)
class Demonstration:
    """What was seen and done.

    Args:
        seed: of the scene and of the noise.
        images: camera name -> ``(N, H, W, 3)`` uint8.
        states: ``(N, 8)`` before each step.
        actions: ``(N, 7)`` what the expert wanted in each step.
    """

    seed: int
    images: dict[str, npt.NDArray[np.uint8]]
    states: npt.NDArray[np.float64]
    actions: npt.NDArray[np.float64]


def demonstrate(
    scene: LiberoScene,
    task: SuiteTask,
    seed: int,
    cameras: Sequence[Camera],
    noise: float = 0.0,
) -> Demonstration | None:
    """Let the expert do ``task`` in ``scene``, with everything placed at random.

    Args:
        task: any that can be done in the scene.
        noise: standard deviation of smooth disturbances of the executed positions' deltas, of
            which 1 is the largest. The recorded actions are what the expert wants, so that they
            lead back to its way (Laskey et al., "DART", CoRL 2017).

    Returns:
        None if the expert did not succeed within the suite's steps.

    Raises:
        ConfigError: the expert cannot do the task.
    """
    scene.reset(seed=seed)
    scene.settle(NUM_STEPS_WAIT)
    expert = Expert(scene, task)
    rng, disturbance = np.random.default_rng(seed), np.zeros(3)
    images: dict[str, list[npt.NDArray[np.uint8]]] = {camera.name: [] for camera in cameras}
    states, actions = [], []
    while not scene.done(task) and not expert.done and scene.steps < max_steps(task.suite):
        for c in cameras:
            images[c.name].append(scene.render(CAMERAS[c.name], c.height, c.width))
        states.append(scene.state)
        size = noise if expert.free else _CAREFUL * noise
        fresh = rng.normal(size=3) * np.sqrt(1 - _SMOOTH**2)
        disturbance = _SMOOTH * disturbance + fresh
        actions.append(np.clip(expert.act(), -1.0, 1.0))
        executed = actions[-1].copy()
        executed[:3] = np.clip(executed[:3] + size * disturbance, -1.0, 1.0)
        scene.step(executed)
    if not scene.done(task):
        return None
    stacked = {name: np.stack(pictures) for name, pictures in images.items()}
    return Demonstration(seed, stacked, np.stack(states), np.stack(actions))
