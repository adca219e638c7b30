"""One demonstration of the scripted expert, as the frames of a dataset."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fluxvla_sim.aloha.expert import Expert
from fluxvla_sim.aloha.scene import CONTROL_HZ, DIM, AlohaScene
from fluxvla_sim.aloha.tasks import MAX_STEPS, Facts, Task

if TYPE_CHECKING:
    import numpy.typing as npt

    from fluxvla_core.spec.embodiment import Camera

# Steps in which a few millimetres decide: coming down on the cube, changing hands.
_DELICATE = ((55, 112), (130, 215))
_DELICATE_SHARE = 0.25
_NOISE_EVERY = 25  # steps between independent offsets; linear in between
_BLEND = 11  # steps over which the offsets' size changes


@dataclass(frozen=True)
class Demonstration:
    """What was seen and done.

    Args:
        seed: of the scene and of the noise.
        images: camera name -> ``(N, H, W, 3)`` uint8.
        states: ``(N, 14)`` joint positions when each picture was taken.
        actions: ``(N, 14)`` where the expert wants the joints to be one frame later.
    """

    seed: int
    images: dict[str, npt.NDArray[np.uint8]]
    states: npt.NDArray[np.float64]
    actions: npt.NDArray[np.float64]


def demonstrate(
    scene: AlohaScene,
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
        None if the expert did not succeed, judged over the whole episode of 300 steps.
    """
    stride = frame_stride(fps)
    scene.reset(seed)
    plan = expert.plan(task.name, scene.cube)
    executed = plan + noise * smooth_noise(np.random.default_rng(seed)) if noise else plan
    images: dict[str, list[npt.NDArray[np.uint8]]] = {camera.name: [] for camera in cameras}
    states, actions, facts = [], [], Facts()
    for step, command in enumerate(executed):
        if step < task.record_steps and step % stride == 0:
            for c in cameras:
                images[c.name].append(scene.render(c.name, c.height, c.width))
            states.append(scene.state)
            actions.append(plan[min(step + stride, MAX_STEPS) - 1])
        scene.step(command)
        facts = facts.after(scene)
    if not task.success(facts):
        return None
    stacked = {name: np.stack(pictures) for name, pictures in images.items()}
    return Demonstration(seed, stacked, np.stack(states), np.stack(actions))


def frame_stride(fps: float) -> int:
    """Control steps from frame to frame.

    Raises:
        ValueError: ``fps`` does not divide 50.
    """
    stride = round(CONTROL_HZ / fps) if fps > 0 else 0
    if stride < 1 or stride * fps != CONTROL_HZ:
        raise ValueError(f"fps must divide {CONTROL_HZ:g}, got {fps:g}")
    return stride


def smooth_noise(rng: np.random.Generator) -> npt.NDArray[np.float64]:
    """``(300, 14)`` offsets of about unit size: slow, smaller where it is delicate, no grippers."""
    knots = rng.standard_normal((MAX_STEPS // _NOISE_EVERY + 2, DIM))
    at = np.arange(MAX_STEPS) / _NOISE_EVERY
    lines = [np.interp(at, np.arange(len(knots)), knots[:, joint]) for joint in range(DIM)]
    size = np.ones(MAX_STEPS)
    for first, last in _DELICATE:
        size[first:last] = _DELICATE_SHARE
    padded = np.pad(size, _BLEND // 2, mode="edge")
    size = np.convolve(padded, np.full(_BLEND, 1 / _BLEND), "valid")
    offsets = np.stack(lines, axis=1) * size[:, None]
    offsets[:, [6, 13]] = 0.0
    # The first command continues from rest.
    offsets[:_BLEND] *= np.linspace(0, 1, _BLEND)[:, None]
    return offsets
