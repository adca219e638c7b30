"""One closed-loop episode in simulation: observe, predict, interpolate, limit, step.

Commands are formed as an inference runner forms them in simulated time: the keyframes are joined
linearly from the last command on, and pass the same limits. A policy that was evaluated here does
the same thing, command for command, through the robot's simulated operator.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from fluxvla_core.contracts.frame import Observation
from fluxvla_core.control.keyframes import interpolate
from fluxvla_core.errors import RunFailed
from fluxvla_core.safety.limits import Limiter
from fluxvla_sim.world import CONTROL_HZ, Scene, SimRobot, Task, World

if TYPE_CHECKING:
    from fluxvla_core.contracts.protocols import Policy
    from fluxvla_core.spec.embodiment import Camera


@dataclass(frozen=True)
class Rollout:
    """What one episode came to.

    Args:
        success: of the task that was asked for.
        behaviours: success of every task of the world, by name.
        steps: control steps taken.
        best_reward: the highest reward of any step.
        clamped: commands that the limits changed.
        calls: how often the policy was asked.
        state_hash: of the simulation's final state; equal for equal episodes.
        seconds: of the whole episode; ``policy_seconds`` of it in the policy.
    """

    success: bool
    behaviours: dict[str, bool]
    steps: int
    best_reward: int
    clamped: int
    calls: int
    state_hash: str
    seconds: float
    policy_seconds: float


def rollout(
    robot: SimRobot,
    world: World,
    scene: Scene,
    policy: Policy,
    task: Task,
    instruction: str,
    seed: int,
    cameras: Sequence[Camera],
    replan_every: int,
    max_steps: int | None = None,
    watch: Callable[[], None] | None = None,
) -> Rollout:
    """Run one episode; its course follows from the arguments alone.

    Args:
        robot, world: what acts, and where.
        scene: of ``world``; is reset to ``seed``.
        policy: is reset to ``seed`` too.
        task: whose end ends the episode: that of ``instruction``, whatever is being measured.
        instruction: what the policy is told.
        cameras: the pictures that the policy gets.
        replan_every: how many keyframes of a chunk are used before the policy is asked again.
        max_steps: control steps after which the episode ends; the world's by default.
        watch: called before the first step and after each, for a video.

    Raises:
        RunFailed: the policy's chunk has the wrong shape or is not finite.
    """
    began, policy_seconds = time.perf_counter(), 0.0
    scene.reset(seed)
    policy.reset(seed)
    limiter = Limiter(robot.embodiment(()), 1.0 / CONTROL_HZ)
    limiter.start(scene.state)
    facts, clamped, calls = world.begin(), 0, 0
    most = world.max_steps if max_steps is None else max_steps
    if watch is not None:
        watch()
    while not task.done(facts) and facts.steps < most:
        observation = _observe(scene, cameras, instruction)
        asked = time.perf_counter()
        chunk = _checked(policy.predict_action(observation), limiter.last.shape[0])
        policy_seconds += time.perf_counter() - asked
        calls += 1
        keyframes = chunk[:replan_every]
        for target in interpolate(limiter.last, keyframes, policy.action_rate_hz, CONTROL_HZ):
            command, clamps = limiter.step(target)
            clamped += bool(clamps)
            scene.step(command)
            facts = facts.after(scene)
            if watch is not None:
                watch()
            if task.done(facts) or facts.steps >= most:
                break
    return Rollout(
        success=task.success(facts),
        behaviours={each.name: each.success(facts) for each in world.tasks},
        steps=facts.steps,
        best_reward=facts.best_reward,
        clamped=clamped,
        calls=calls,
        state_hash=hashlib.sha256(scene.data.qpos.tobytes()).hexdigest()[:16],
        seconds=time.perf_counter() - began,
        policy_seconds=policy_seconds,
    )


def _observe(scene: Scene, cameras: Sequence[Camera], instruction: str) -> Observation:
    return {
        "qpos": scene.state.astype(np.float32),
        "images": {c.name: scene.render(c.name, c.height, c.width) for c in cameras},
        "task_description": instruction,
    }


def _checked(chunk: Any, dim: int) -> Any:
    array = np.asarray(chunk, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != dim or not len(array):
        raise RunFailed(f"the policy's chunk has shape {array.shape}; (T, {dim}) is needed")
    if not np.isfinite(array).all():
        raise RunFailed("the policy's chunk is not finite")
    return array
