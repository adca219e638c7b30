"""One closed-loop episode: observe, predict, execute some of the chunk, observe again."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from fluxvla_core.errors import RunFailed
from fluxvla_libero.embodiment import ACTION_DIM, CAMERAS
from fluxvla_libero.scene import LiberoScene
from fluxvla_libero.suites import NUM_STEPS_WAIT, SuiteTask

if TYPE_CHECKING:
    import numpy.typing as npt

    from fluxvla_core.contracts.frame import Observation
    from fluxvla_core.contracts.protocols import Policy
    from fluxvla_core.spec.embodiment import Camera


@dataclass(frozen=True)
class Episode:
    """What an episode is made of, beside scene and policy.

    Args:
        init_state: where it begins; at random, by ``seed``, without one.
        seed: of the policy, and of what is placed at random.
        asked: the task whose instruction the policy is told.
        cameras: what the policy looks at, by its own names and in its own sizes.
        replan_every: how many actions of a chunk are executed before the policy is asked again.
        max_steps: control steps after which it ends.
        num_steps_wait: steps that the arm holds still before; they do not count.
        judged: the tasks whose goals are looked at after each step.
    """

    init_state: npt.NDArray[np.float64] | None
    seed: int
    asked: SuiteTask
    cameras: tuple[Camera, ...]
    replan_every: int
    max_steps: int
    num_steps_wait: int = NUM_STEPS_WAIT
    judged: tuple[SuiteTask, ...] = ()


@dataclass(frozen=True)
class Rollout:
    """What one episode came to.

    Args:
        success: whether the scene's own task was done, at any moment.
        behaviours: the same for every judged task, by name.
        steps: control steps taken, without the waiting ones.
        calls: how often the policy was asked.
        clamped: actions with a value beyond 1, which LIBERO cuts.
        state_hash: of the simulation's final state; equal for equal episodes.
        seconds: of the whole episode; ``policy_seconds`` of it in the policy.
    """

    success: bool
    behaviours: dict[str, bool]
    steps: int
    calls: int
    clamped: int
    state_hash: str
    seconds: float
    policy_seconds: float


def rollout(
    scene: LiberoScene,
    policy: Policy,
    episode: Episode,
    watch: Callable[[npt.NDArray[np.float64] | None], None] | None = None,
) -> Rollout:
    """Run one episode until the scene's task or the one that was asked for is done.

    Args:
        watch: called with None before the first step, and with each action after its step.

    Raises:
        RunFailed: the policy's chunk has the wrong shape or is not finite.
    """
    began, policy_seconds = time.perf_counter(), 0.0
    scene.reset(episode.init_state, *([] if episode.init_state is not None else [episode.seed]))
    scene.settle(episode.num_steps_wait)
    if hasattr(policy, "enter"):
        policy.enter(scene)
    policy.reset(episode.seed)
    judged = {task.name: task for task in (scene.task, episode.asked, *episode.judged)}
    ends = {scene.task.name, episode.asked.name}
    did = dict.fromkeys(judged, False)
    calls = clamped = 0
    if watch is not None:
        watch(None)
    while not any(did[name] for name in ends) and scene.steps < episode.max_steps:
        asked = time.perf_counter()
        chunk = _checked(policy.predict_action(_observe(scene, episode)))
        policy_seconds += time.perf_counter() - asked
        calls += 1
        for action in chunk[: episode.replan_every]:
            clamped += bool(np.abs(action).max() > 1.0 + 1e-6)
            scene.step(action)
            did = {name: was or scene.done(judged[name]) for name, was in did.items()}
            if watch is not None:
                watch(action)
            if any(did[name] for name in ends) or scene.steps >= episode.max_steps:
                break
    return Rollout(
        success=did[scene.task.name],
        behaviours=did,
        steps=scene.steps,
        calls=calls,
        clamped=clamped,
        state_hash=scene.state_hash(),
        seconds=time.perf_counter() - began,
        policy_seconds=policy_seconds,
    )


def look(scene: LiberoScene, cameras: Sequence[Camera]) -> dict[str, npt.NDArray[np.uint8]]:
    """What each camera sees now, by the policy's names."""
    return {c.name: scene.render(CAMERAS[c.name], c.height, c.width) for c in cameras}


def _observe(scene: LiberoScene, episode: Episode) -> Observation:
    return {
        "qpos": scene.state.astype(np.float32),
        "images": look(scene, episode.cameras),
        "task_description": episode.asked.language,
    }


def _checked(chunk: Any) -> npt.NDArray[np.float64]:
    array = np.asarray(chunk, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != ACTION_DIM or not len(array):
        raise RunFailed(f"the policy's chunk has shape {array.shape}; (T, {ACTION_DIM}) is needed")
    if not np.isfinite(array).all():
        raise RunFailed("the policy's chunk is not finite")
    return array
