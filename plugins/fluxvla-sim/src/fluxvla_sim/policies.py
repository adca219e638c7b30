"""Policies that an evaluation can measure: a checkpoint's, and what to compare it with."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from fluxvla_core.errors import ConfigError
from fluxvla_sim.world import CONTROL_HZ, Scene, SimRobot, World, task_of

if TYPE_CHECKING:
    import numpy.typing as npt

    from fluxvla_core.contracts.frame import Observation
    from fluxvla_core.contracts.protocols import Policy

POLICIES = ("checkpoint", "expert", "untrained")
NEEDS_CHECKPOINT = ("checkpoint", "untrained")


class ExpertPolicy:
    """The scripted expert as a policy: keyframes of its plan. It sees the objects' true places.

    Its success through the whole pipeline (keyframes, interpolation, limits) is an upper bound
    for any policy, and a check of the pipeline.

    Args:
        robot: what acts.
        world, scene: where it acts; looked at when an episode's first chunk is asked for.
        action_rate_hz: keyframes a second; must divide 50.
        horizon: keyframes in a chunk.
    """

    def __init__(
        self,
        robot: SimRobot,
        world: World,
        scene: Scene,
        action_rate_hz: float = 10.0,
        horizon: int = 20,
    ) -> None:
        self.embodiment = robot.embodiment(())
        self.cameras: tuple[str, ...] = ()
        self.action_rate_hz = action_rate_hz
        self.horizon = horizon
        self._stride = round(CONTROL_HZ / action_rate_hz)
        if self._stride * action_rate_hz != CONTROL_HZ:
            raise ConfigError(f"{action_rate_hz:g} keyframes a second do not divide 50 steps")
        self._world = world
        self._scene = scene
        self._expert = world.open_expert(scene.model)
        self._plan: npt.NDArray[np.float64] | None = None

    def reset(self, seed: int) -> None:
        self._plan = None

    def predict_action(self, observation: Observation) -> npt.NDArray[np.float64]:
        """``(horizon, D)`` keyframes from the present step on; the last one holds at the end.

        Raises:
            ConfigError: the instruction is none that the expert knows.
        """
        if self._plan is None:
            task = task_of(self._world, observation["task_description"])
            if task is None:
                raise ConfigError(
                    f"the expert does not know {observation['task_description']!r}",
                    next="ask for one of the tasks' own instructions",
                )
            self._plan = self._expert.plan(task.name, self._scene.objects)
        steps = self._scene.steps + self._stride * (1 + np.arange(self.horizon)) - 1
        return self._plan[np.minimum(steps, self._world.max_steps - 1)]


def make_policy(
    name: str,
    robot: SimRobot,
    world: World,
    scene: Scene,
    ckpt_path: str | None,
    device: str,
    dataset: Any = None,
    denormalize_action: Any = None,
    mixed_precision_dtype: str = "float32",
) -> Policy:
    """The policy called ``name``, one of ``POLICIES``.

    ``untrained`` is the checkpoint's model with fresh random weights (seed 0) and everything else
    as it is: what the same pipeline does without having learned.

    Raises:
        CheckpointError, SpecMismatch, ConfigError, PluginError: see ``load_policy``.
    """
    if name == "expert":
        return ExpertPolicy(robot, world, scene)
    from fluxvla_core.infer.local_policy import load_policy

    assert ckpt_path is not None
    policy = load_policy(ckpt_path, device, dataset, denormalize_action, mixed_precision_dtype)
    if name == "untrained":
        from fluxvla_core.evaluate.subject import untrained_model

        policy.model = untrained_model(ckpt_path, device)
    return policy
