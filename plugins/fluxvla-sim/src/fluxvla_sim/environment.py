"""The simulated robots as environments: what evaluations and collections act in."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import numpy.typing as npt
from fluxvla_mujoco import MujocoEnvironment, check_render

from fluxvla_core.evaluation import EnvironmentSpec, Step, TaskSpec
from fluxvla_core.operators import Camera
from fluxvla_sim.aloha.world import ALOHA
from fluxvla_sim.ur import UR5E
from fluxvla_sim.world import Scene, SimRobot, SimWorld

if TYPE_CHECKING:
    from fluxvla_core.models import Observation

Array = npt.NDArray[np.float64]


class SimEnvironment(MujocoEnvironment):
    """All tasks of the simulated robot that a subclass names.

    Actions are joint targets and take the way of a robot's commands: joined, and kept within the
    arm's limits. A task's scene is built when it is first asked for, and kept.

    Args:
        render: ``cheap`` images (no shadows, no multisampling), ``coarse`` ones, or
            ``reference``: as the model files ask. See ``fluxvla_mujoco.drawing``.
        ends_with_success: end an episode when its task is done, not after its last step.

    Raises:
        ConfigError: there is no such quality.
    """

    api: ClassVar[str] = "1.0"
    expert: ClassVar[str] = "SimExpert"
    robot: ClassVar[SimRobot]

    def __init__(self, render: str = "cheap", ends_with_success: bool = True) -> None:
        check_render(render)
        self._render = render
        self._ends = ends_with_success
        robot = self.robot
        self.spec = EnvironmentSpec(
            name=f"the simulated {robot.title}",
            embodiment=robot.embodiment([Camera(name, 480, 640) for name in robot.cameras]),
            tasks=tuple(
                TaskSpec(task.name, task.instruction, world.max_steps, task.record_steps)
                for world in robot.worlds
                for task in world.tasks
            ),
            limited=True,
            details={"render": render},
        )
        self._scenes: dict[int, Scene] = {}
        self.world: SimWorld = robot.worlds[0]
        self._task = self._instructed = self.world.tasks[0]
        self._facts = self.world.begin()

    @property
    def scene(self) -> Scene:
        """The scene of the episode; experts see through it."""
        key = id(self.world)
        if key not in self._scenes:
            self._scenes[key] = self.world.open_scene(self._render)
        return self._scenes[key]

    @property
    def state(self) -> Array:
        """``(D,)`` joint positions."""
        return self.scene.state

    @property
    def simulation(self) -> Any:
        """``mujoco.MjData``."""
        return self.scene.data

    def reset(self, seed: int, task: str) -> None:
        """Robot at home, the objects of ``task`` where ``seed`` puts them.

        Raises:
            ConfigError: the robot has no such task.
            RunFailed: its model files are not installed.
        """
        self.world, self._task = self.robot.find(task)
        self._instructed = self._task
        self._facts = self.world.begin()
        self.scene.reset(seed)

    def other_tasks(self, task: str) -> Sequence[str]:
        """The other tasks of the world that ``task`` is in."""
        world, _ = self.robot.find(task)
        return tuple(other.name for other in world.tasks if other.name != task)

    def set_instruction(self, task: str) -> None:
        """After ``reset``: give the policy the instruction of ``task``, with which it ends."""
        _, self._instructed = self.robot.find(task)

    def step(self, action: Array) -> Step:
        """Drive to the joint targets ``(D,)`` for 20 ms."""
        self.scene.step(action)
        self._facts = facts = self._facts.after(self.scene)
        return Step(
            reward=float(facts.reward),
            success=self._task.success(facts),
            ended=self._ends and self._instructed.done(facts),
            behaviours={task.name: task.success(facts) for task in self.world.tasks},
        )

    def observe(self, cameras: Sequence[Camera]) -> Observation:
        """State, instruction, and images in the sizes that are asked for."""
        scene = self.scene
        return {
            "qpos": scene.state.astype(np.float32),
            "images": {c.name: scene.render(c.name, c.height, c.width) for c in cameras},
            "task_description": self._instructed.instruction,
        }

    def state_hash(self) -> str:
        """Hash of all positions; equal for equal episodes."""
        positions: Any = self.scene.data.qpos
        return hashlib.sha256(positions.tobytes()).hexdigest()[:16]

    def close(self) -> None:
        """Free the scenes; any number of times."""
        for scene in self._scenes.values():
            scene.close()
        self._scenes = {}


class AlohaSimEnvironment(SimEnvironment):
    """gym-aloha's scenes: ``transfer_cube`` and ``lift_hold`` with a cube, ``insertion``."""

    robot: ClassVar[SimRobot] = ALOHA


class URSimEnvironment(SimEnvironment):
    """A UR5e with a Robotiq 2F-85 at a table: ``lift_cube``."""

    robot: ClassVar[SimRobot] = UR5E


ENVIRONMENTS: Mapping[str, type[SimEnvironment]] = {
    cls.robot.name: cls for cls in (AlohaSimEnvironment, URSimEnvironment)
}
"""By the robot's name, as commands take it."""
