"""``LiberoEnvironment``: LIBERO's suites behind the core's contract."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import numpy.typing as npt
from fluxvla_mujoco import MujocoEnvironment, check_render

from fluxvla_core.errors import ConfigError, SpecMismatch
from fluxvla_core.evaluation import EnvironmentSpec, Step, TaskSpec
from fluxvla_core.operators import Camera
from fluxvla_libero.embodiment import CAMERAS, IMAGE_SIZE, SCENE_CAMERAS, libero_spec
from fluxvla_libero.suites import (
    NUM_STEPS_WAIT,
    SuiteTask,
    can_be_done_in,
    check_suite,
    choose_tasks,
    init_states,
    max_steps,
)

if TYPE_CHECKING:
    from fluxvla_core.models import Observation
    from fluxvla_libero.scene import LiberoScene

FIXED, RANDOM = "fixed", "random"
FLUXVLA, OPENVLA = "fluxvla", "openvla"


class LiberoEnvironment(MujocoEnvironment):
    """A suite's tasks by the standard protocol.

    An episode with seed ``n`` begins in the task's ``n``-th fixed state, or, with
    ``begin="random"``, with everything placed at random by the seed; then the arm holds still for
    ``num_steps_wait`` steps. Success is LIBERO's own goal test, at any step, and ends the episode.
    Of scenes only the last one is kept, because one takes hundreds of MB.

    The fixed states say nothing about what cannot move (cabinets, stoves, 1 to 2 cm): LIBERO's
    random numbers place it, at each reset. They start from 0, and when is a matter of the protocol.
    ``fluxvla``: before each episode, so that everything stands alike in all of a task's episodes.
    ``openvla``: as in OpenVLA's evaluation, once for a task before its first episode; episode ``n``
    then has the places of the ``n``-th reset, whichever episodes are run, and in whatever order.

    Args:
        suite: libero_spatial, _object, _goal, _10, _90, or one of LIBERO-PRO's.
        tasks: which of the suite's, by index or name; all by default.
        mixed: each of these tasks in the scenes of all of them where it can be done: then the
            scene does not say what to do. Tasks are called ``<task>-in-scene-<index>``.
        cameras: of the scene, also by the names that public datasets give them.
        height, width: of their images, if no other size is requested.
        render: how images are drawn, see ``fluxvla_mujoco.drawing``.
        begin: ``fixed`` or ``random``.
        num_steps_wait: they do not count.
        protocol: ``fluxvla`` or ``openvla``; results of one do not compare with the other's.
        instruction: language instruction for the policy instead of the task's own.

    Raises:
        ConfigError: a value is impossible.
    """

    api: ClassVar[str] = "1.0"
    expert: ClassVar[str] = "LiberoExpert"

    def __init__(
        self,
        suite: str = "libero_object",
        tasks: Sequence[int | str] | None = None,
        mixed: bool = False,
        cameras: Sequence[str] = SCENE_CAMERAS,
        height: int = IMAGE_SIZE,
        width: int = IMAGE_SIZE,
        render: str = "cheap",
        begin: str = FIXED,
        num_steps_wait: int = NUM_STEPS_WAIT,
        instruction: str | None = None,
        protocol: str = FLUXVLA,
    ) -> None:
        check_suite(suite)
        check_render(render)
        unknown = [name for name in cameras if name not in CAMERAS]
        if unknown:
            raise ConfigError(
                f"LIBERO's scenes have no camera {unknown[0]!r}; they have {', '.join(CAMERAS)}"
            )
        if min(height, width) < 16:
            raise ConfigError(f"images of {height}x{width} are too small")
        if begin not in (FIXED, RANDOM):
            raise ConfigError(f"begin {begin!r} is unknown; choose one of {FIXED}, {RANDOM}")
        if protocol not in (FLUXVLA, OPENVLA):
            raise ConfigError(
                f"protocol {protocol!r} is unknown; choose one of {FLUXVLA}, {OPENVLA}"
            )
        if protocol == OPENVLA and begin == RANDOM:
            raise ConfigError("protocol 'openvla' has fixed states: it cannot begin at random")
        if num_steps_wait < 0:
            raise ConfigError(f"num_steps_wait must be at least 0, got {num_steps_wait}")
        self.suite = suite
        self.action = np.zeros(7)
        self._wanted = tasks
        self._mixed = mixed
        self._cameras = tuple(Camera(name, height, width) for name in cameras)
        self._render = render
        self._begin = begin
        self._wait = num_steps_wait
        self._protocol = protocol
        self._instruction = instruction
        self._scene: LiberoScene | None = None
        self._name = self._instructed = ""
        self._checked: dict[str, SuiteTask] = {}
        self._did: dict[str, bool] = {}

    @cached_property
    def spec(self) -> EnvironmentSpec:
        """The description of the environment, known before a scene is built.

        Raises:
            MissingPlugin, RunFailed: LIBERO is not installed, or cannot be imported.
            ConfigError: the suite has no such task.
        """
        limit = max_steps(self.suite)
        return EnvironmentSpec(
            name=self.suite,
            embodiment=libero_spec(self._cameras),
            tasks=tuple(
                TaskSpec(name, self._instruction or task.language, limit)
                for name, (_, task) in self.pairs.items()
            ),
            keep_together=True,
            details={
                "render": self._render,
                "begin": self._begin,
                "num_steps_wait": self._wait,
                "protocol": self._protocol,
            },
        )

    @cached_property
    def pairs(self) -> Mapping[str, tuple[SuiteTask, SuiteTask]]:
        """Name of a task -> in whose scene, and what is to be done there; scene by scene."""
        tasks = choose_tasks(self.suite, self._wanted)
        if not self._mixed:
            return {task.name: (task, task) for task in tasks}
        return {
            f"{task.name}-in-scene-{scene.index}": (scene, task)
            for scene in tasks
            for task in tasks
            if can_be_done_in(task, scene)
        }

    @property
    def scene(self) -> LiberoScene:
        """The scene of the episode; there is one after the first reset."""
        assert self._scene is not None
        return self._scene

    @property
    def state(self) -> npt.NDArray[np.float64]:
        """``(8,)``, see ``libero_spec``."""
        return self.scene.state

    @property
    def simulation(self) -> Any:
        """``mujoco.MjData``."""
        return self.scene.data

    @property
    def task(self) -> SuiteTask:
        """The task of the policy's instruction."""
        return self._checked[self._instructed]

    def reset(self, seed: int, task: str) -> None:
        """Begin an episode of ``task``.

        Raises:
            ConfigError: there is no such task or fixed state.
            RunFailed: see ``LiberoScene.reset``.
        """
        if task not in self.pairs:
            raise ConfigError(f"{task!r} is not a task of this environment")
        where, _ = self.pairs[task]
        state = None
        if self._begin == FIXED:
            states = init_states(self.suite, where.index)
            if seed >= len(states):
                raise ConfigError(
                    f"{self.suite} has {len(states)} fixed states for each task; there is no "
                    f"episode {seed}",
                    next="evaluate fewer episodes, or --set <LiberoEnvironment>.begin=random",
                )
            state = states[seed]
        scene = self._enter(where)
        if state is None:
            scene.reset(seed=seed)
        else:
            scene.reset(state, resets=seed + 1 if self._protocol == OPENVLA else 1)
        scene.settle(self._wait)
        self._name = self._instructed = task
        here = {name: pair[1] for name, pair in self.pairs.items() if self._shares(name, where)}
        self._checked = {name: each for name, each in here.items() if scene.can_check(each)}
        self._did = dict.fromkeys(self._checked, False)

    def other_tasks(self, task: str) -> tuple[str, ...]:
        """Tasks with other words that could also be done in the scene of ``task``."""
        where, own = self.pairs[task]
        return tuple(
            name
            for name, (_, other) in self.pairs.items()
            if other.language != own.language and self._shares(name, where)
        )

    def set_instruction(self, task: str) -> None:
        """After ``reset``: give the policy the instruction of ``task``.

        Raises:
            ConfigError: that cannot be done in this scene.
        """
        if task not in self._checked:
            raise ConfigError(f"{task!r} cannot be done in the scene of {self._name!r}")
        self._instructed = task

    def step(self, action: npt.NDArray[np.float64]) -> Step:
        """One control step, 1/20 s.

        Raises:
            RunFailed: the action is not seven finite numbers.
        """
        scene = self.scene
        scene.step(action)
        self.action = np.array(action)
        self._did = {n: was or scene.done(self._checked[n]) for n, was in self._did.items()}
        success, instructed = self._did[self._name], self._did[self._instructed]
        return Step(float(success), success, success or instructed, dict(self._did))

    def observe(self, cameras: Sequence[Camera]) -> Observation:
        """State, instruction, and images in the sizes that are asked for.

        Raises:
            SpecMismatch: there is no such camera.
            RunFailed: nothing here can draw.
        """
        unknown = [c.name for c in cameras if c.name not in CAMERAS]
        if unknown:
            raise SpecMismatch(f"LIBERO's scenes have no camera {unknown[0]!r}")
        scene = self.scene
        images = {c.name: scene.render(CAMERAS[c.name], c.height, c.width) for c in cameras}
        return {
            "qpos": scene.state.astype(np.float32),
            "images": images,
            "task_description": self._instruction or self.task.language,
        }

    def state_hash(self) -> str:
        """Hash of positions and velocities; equal for equal episodes."""
        return self.scene.state_hash()

    def close(self) -> None:
        """Give everything back; any number of times."""
        if self._scene is not None:
            self._scene.close()
            self._scene = None

    def _shares(self, name: str, where: SuiteTask) -> bool:
        """Whether the task called ``name`` belongs into the scene or could be done there."""
        scene, task = self.pairs[name]
        if self._mixed:
            return scene == where
        return can_be_done_in(task, where)

    def _enter(self, where: SuiteTask) -> LiberoScene:
        from fluxvla_libero.scene import LiberoScene

        if self._scene is None or self._scene.task != where:
            self.close()
            self._scene = LiberoScene(where, self._render)
        return self._scene
