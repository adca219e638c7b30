"""One demonstration of the scripted expert, as the frames of a dataset."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fluxvla_sim.expert import frame_stride
from fluxvla_sim.world import Expert, Scene, Task, World

if TYPE_CHECKING:
    import numpy.typing as npt

    from fluxvla_core.spec.embodiment import Camera


@dataclass(frozen=True)
class Demonstration:
    """What was seen and done.

    Args:
        seed: of the scene and of the noise.
        images: camera name -> ``(N, H, W, 3)`` uint8.
        states: ``(N, D)`` joint positions when each picture was taken.
        actions: ``(N, D)`` where the expert wants the joints to be one frame later.
    """

    seed: int
    images: dict[str, npt.NDArray[np.uint8]]
    states: npt.NDArray[np.float64]
    actions: npt.NDArray[np.float64]


def demonstrate(
    world: World,
    scene: Scene,
    expert: Expert,
    task: Task,
    seed: int,
    cameras: Sequence[Camera],
    fps: float,
    noise: float = 0.0,
) -> Demonstration | None:
    """Act out ``task`` and record its first ``task.record_steps`` control steps.

    A frame is taken every ``50 / fps`` steps, before the step; its action is the plan's target
    for the last step before the next frame.

    Args:
        noise: standard deviation, in rad, of smooth offsets on what the arms are told. The
            recorded actions are without it, so that they lead back to the expert's way (Laskey
            et al., "DART", CoRL 2017).

    Returns:
        None if the expert did not succeed, judged over the world's whole episode.
    """
    stride = frame_stride(fps)
    scene.reset(seed)
    plan = expert.plan(task.name, scene.objects)
    executed = plan + noise * world.noise(np.random.default_rng(seed)) if noise else plan
    images: dict[str, list[npt.NDArray[np.uint8]]] = {camera.name: [] for camera in cameras}
    states, actions, facts = [], [], world.begin()
    for step, command in enumerate(executed):
        if step < task.record_steps and step % stride == 0:
            for c in cameras:
                images[c.name].append(scene.render(c.name, c.height, c.width))
            states.append(scene.state)
            actions.append(plan[min(step + stride, world.max_steps) - 1])
        scene.step(command)
        facts = facts.after(scene)
    if not task.success(facts):
        return None
    stacked = {name: np.stack(pictures) for name, pictures in images.items()}
    return Demonstration(seed, stacked, np.stack(states), np.stack(actions))
