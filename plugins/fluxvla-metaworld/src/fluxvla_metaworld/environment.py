"""``MetaWorldEnvironment``: Meta-World's tasks behind the core's contract.

Meta-World builds a model for each task; it is built once and then put back before every episode,
so that an episode follows from its task and seed alone. Tests hold an episode against one in a
model that was just built.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import numpy.typing as npt
from fluxvla_mujoco import Drawing, MujocoEnvironment, check_render, use_egl

from fluxvla_core.errors import ConfigError, MissingPlugin, RunFailed
from fluxvla_core.evaluation import EnvironmentSpec, Step, TaskSpec
from fluxvla_core.operators import Camera, EmbodimentSpec, Joint
from fluxvla_metaworld.tasks import INSTRUCTIONS, choose_tasks

if TYPE_CHECKING:
    from fluxvla_core.models import Observation

Array = npt.NDArray[np.float64]

CONTROL_HZ = 80.0
"""Five simulation steps of 2.5 ms."""

CAMERAS: Sequence[str] = (
    "corner",
    "corner2",
    "corner3",
    "corner4",
    "topview",
    "behindGripper",
    "gripperPOV",
)
TURNED = frozenset({"corner", "corner2", "corner3", "corner4"})
"""Cameras that hang upside down in Meta-World's scenes; their images are turned by 180 degrees,
as public datasets of Meta-World show ``corner2``."""

IMAGE_SIZE = 224

LIMIT = 500
"""Steps of an episode in Meta-World; it refuses any beyond."""


class MetaWorldEnvironment(MujocoEnvironment):
    """Meta-World's 50 tasks, each with its objects and goals placed by the episode's seed.

    A policy sees images and the state (4,): the hand and its fingers. What Meta-World's own
    observation says beyond that, objects and goals, is there for its scripted experts:
    ``privileged``. An episode ends with its first success.

    Args:
        tasks: ``MT50``, ``MT10``, or names in a list.
        cameras: which of the scene's, to look through by default; all can be asked for.
        height, width: of their images.
        render: ``cheap`` images (no shadows, no multisampling), or Meta-World's: ``reference``.
        max_steps: steps of 1/80 s after which an episode ends; at most 500.

    Raises:
        ConfigError: there is no such task or camera, or a number is impossible.
    """

    api: ClassVar[str] = "1.0"
    expert: ClassVar[str] = "MetaWorldExpert"

    def __init__(
        self,
        tasks: str | Sequence[str] = "MT50",
        cameras: Sequence[str] = ("corner2",),
        height: int = IMAGE_SIZE,
        width: int = IMAGE_SIZE,
        render: str = "cheap",
        max_steps: int = LIMIT,
    ) -> None:
        check_render(render)
        unknown = [name for name in cameras if name not in CAMERAS]
        if unknown:
            raise ConfigError(
                f"Meta-World's scenes have no camera {unknown[0]!r}; they have {', '.join(CAMERAS)}"
            )
        if min(height, width) < 16:
            raise ConfigError(f"images of {height}x{width} are too small")
        if not 1 <= max_steps <= LIMIT:
            raise ConfigError(f"max_steps must be 1 to {LIMIT}, got {max_steps}")
        self.spec = EnvironmentSpec(
            name="metaworld",
            embodiment=metaworld_spec([Camera(name, height, width) for name in cameras]),
            tasks=tuple(
                TaskSpec(name, INSTRUCTIONS[name], max_steps) for name in choose_tasks(tasks)
            ),
            keep_together=True,
            details={"render": render},
        )
        self._render = render
        self._env: Any = None
        self._task = ""
        self._fixed: dict[str, Any] = {}
        self._seen = np.zeros(39)
        self._success = False
        self._drawing: Drawing | None = None
        self._shown: Any = None

    @property
    def state(self) -> Array:
        """``(4,)``: hand x, y, z (m) and how far the fingers are apart (1 is 0.1 m)."""
        return self._seen[:4].copy()

    @property
    def privileged(self) -> Array:
        """``(39,)``, Meta-World's own observation: hand and objects now and one step ago, goal."""
        return self._seen.copy()

    @property
    def simulation(self) -> Any:
        """``mujoco.MjData``."""
        return self._env.data

    @property
    def task(self) -> str:
        """The task of the episode."""
        return self._task

    def reset(self, seed: int, task: str) -> None:
        """Begin an episode: objects and goals are placed by ``seed``.

        Raises:
            ConfigError: it is not one of the environment's tasks.
            MissingPlugin, RunFailed: Meta-World is not installed, or cannot be imported.
        """
        if task not in {known.name for known in self.spec.tasks}:
            raise ConfigError(f"{task!r} is not a task of this environment")
        if task != self._task or self._env is None:
            self._build(task)
        env = self._env
        for name, values in self._fixed.items():
            getattr(env.model, name)[:] = values
        env.seed(seed)
        self._seen = np.asarray(env.reset()[0], dtype=np.float64)
        self._success = False

    def step(self, action: Array) -> Step:
        """One control step, 1/80 s.

        Raises:
            RunFailed: the action is not four finite numbers, or the episode is over.
        """
        action = np.asarray(action, dtype=np.float64)
        if action.shape != (4,) or not np.isfinite(action).all():
            raise RunFailed(f"Meta-World takes 4 finite numbers, got {action.tolist()}")
        if self._env is None or self._env.curr_path_length >= LIMIT:
            raise RunFailed("Meta-World: the episode is over; reset begins another one")
        seen, reward, _, truncated, info = self._env.step(action)
        self._seen = seen
        self._success |= bool(info["success"])
        return Step(float(reward), self._success, self._success or bool(truncated))

    def observe(self, cameras: Sequence[Camera]) -> Observation:
        """The state, and images as public datasets of Meta-World show them: upright.

        Raises:
            ConfigError: there is no such camera.
            RunFailed: nothing here can draw.
        """
        return {
            "qpos": self._seen[:4].astype(np.float32),
            "images": {c.name: self._image(c) for c in cameras},
            "task_description": INSTRUCTIONS[self._task],
        }

    def state_hash(self) -> str:
        """Hash of positions and velocities; equal for equal episodes."""
        data = self._env.data
        return hashlib.sha256(data.qpos.tobytes() + data.qvel.tobytes()).hexdigest()[:16]

    def close(self) -> None:
        """Give everything back; any number of times."""
        if self._drawing is not None:
            self._drawing.close()
            self._drawing = None
        if self._env is not None:
            self._env.close()
            self._env = None

    def _image(self, camera: Camera) -> npt.NDArray[np.uint8]:
        import mujoco

        if camera.name not in CAMERAS:
            raise ConfigError(f"Meta-World's scenes have no camera {camera.name!r}")
        model, data = self._env.model, self._env.data
        if self._drawing is None:
            self._drawing = Drawing(model, self._render)
            self._shown = mujoco.MjData(model)
        # A copy, brought up to date: after a reset Meta-World's own data still show the goal of
        # the episode before, and what is drawn must not touch what is simulated.
        shown = self._shown
        for name in ("qpos", "mocap_pos", "mocap_quat"):
            getattr(shown, name)[:] = getattr(data, name)
        for update in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_camlight):
            update(model, shown)
        seen = self._drawing.image(shown, camera.name, camera.height, camera.width)
        return np.ascontiguousarray(seen[::-1, ::-1]) if camera.name in TURNED else seen

    def _build(self, task: str) -> None:
        self.close()
        made = import_metaworld()[f"{task}-goal-observable"]
        self._env = made(seed=0)
        # Placed by the generator that seed() makes, for each episode.
        self._env._freeze_rand_vec = False
        self._env.seeded_rand_vec = True
        model = self._env.model
        self._fixed = {name: getattr(model, name).copy() for name in _CHANGED_BY_EPISODES}
        self._task = task


# What Meta-World writes into the model: where things stand that have no joint, and the goal.
_CHANGED_BY_EPISODES = ("body_pos", "body_quat", "site_pos", "geom_pos", "geom_rgba", "site_rgba")


def is_installed() -> bool:
    """Whether there is a Meta-World to import; imports nothing."""
    return find_spec("metaworld") is not None


def import_metaworld() -> Any:
    """Meta-World's classes by name, goals in their observations."""
    if not is_installed():
        raise MissingPlugin(
            "Meta-World is not installed",
            cause="fluxvla-metaworld alone brings no simulator",
            next="pip install 'fluxvla-metaworld[metaworld]'",
        )
    use_egl()
    try:
        from metaworld.env_dict import ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE
    except Exception as error:
        raise RunFailed(
            f"Meta-World is installed and cannot be imported: {type(error).__name__}: {error}",
            cause="a version of mujoco or gymnasium that it was not written for",
            next="pip install 'fluxvla-metaworld[metaworld]'",
        ) from error
    return ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE


def metaworld_spec(cameras: Sequence[Camera]) -> EmbodimentSpec:
    """Meta-World's Sawyer.

    Actions move the hand for one control step along the world's axes (1 is 0.01 m), its
    orientation stays; the fourth is the fingers' effort, -1 opens and 1 closes. The state is the
    hand's position in the world (m) and how far the fingers are apart (1 is 0.1 m).
    Limits are those of ``SawyerXYZEnv`` in metaworld 3.1.
    """
    return EmbodimentSpec(
        name="metaworld_sawyer",
        joints=(
            *(
                Joint(name, "normalized", -1.0, 1.0, 160.0, 25_600.0, "prismatic")
                for name in ("dx", "dy", "dz")
            ),
            Joint("gripper", "normalized", -1.0, 1.0, 160.0, 25_600.0, "gripper", -1.0, 1.0),
        ),
        cameras=tuple(cameras),
        rate_hz=CONTROL_HZ,
        action_mode="delta",
        frame="world",
        source="metaworld 3.1 SawyerXYZEnv",
        state_joints=(
            Joint("x", "m", -0.525, 0.525, 2.0, 50.0, "prismatic"),
            Joint("y", "m", 0.348, 1.025, 2.0, 50.0, "prismatic"),
            Joint("z", "m", -0.0525, 0.7, 2.0, 50.0, "prismatic"),
            Joint("fingers", "normalized", 0.0, 1.0, 20.0, 2000.0, "gripper", 1.0, 0.0),
        ),
    )
