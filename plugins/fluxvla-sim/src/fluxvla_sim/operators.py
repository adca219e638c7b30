"""Simulated robots as operators: ``AlohaSimOperator`` and ``URSimOperator``.

Importing this module, and constructing an operator, loads neither MuJoCo nor a model file, so
that a config check stays quick.
"""

from __future__ import annotations

from collections.abc import Sequence

from fluxvla_aloha.embodiment import aloha_spec
from fluxvla_ur.embodiment import ur_spec

from fluxvla_core.errors import ConfigError
from fluxvla_core.spec.embodiment import Camera
from fluxvla_sim.render import QUALITIES
from fluxvla_sim.sim_operator import Scene, SimOperator

ALOHA_CAMERAS = (
    "top",
    "left_wrist",
    "right_wrist",
    "angle",
    "front_close",
    "left_pillar",
    "right_pillar",
)
ALOHA_HZ = 50.0
UR_CAMERAS = ("front", "wrist")
UR_HZ = 50.0


def _cameras(
    robot: str, names: Sequence[str], known: Sequence[str], height: int, width: int
) -> tuple[Camera, ...]:
    unknown = [name for name in names if name not in known]
    if unknown:
        raise ConfigError(
            f"the simulated {robot} has no camera {', '.join(map(repr, unknown))}; "
            f"it has {', '.join(known)}"
        )
    if height < 1 or width < 1:
        raise ConfigError(f"pictures need a positive size, got {height}x{width}")
    return tuple(Camera(name, height, width) for name in names)


def _check_quality(quality: str) -> str:
    if quality not in QUALITIES:
        raise ConfigError(f"quality {quality!r} is none of {', '.join(QUALITIES)}")
    return quality


class AlohaSimOperator(SimOperator):
    """gym-aloha's cube scene: two ViperX 300 S arms, 50 Hz.

    Args:
        task: ``transfer_cube`` or ``lift_hold``: what :meth:`task_success` judges.
        seed: places the cube in the first episode; each later one adds 1.
        camera_names: cameras of the scene, in the order of the images.
        height, width: of every picture, in pixels.
        realtime: follow the wall clock instead of simulated time.
        quality: ``cheap`` or ``reference`` pictures.

    Raises:
        ConfigError: an unknown task, camera or quality.
    """

    def __init__(
        self,
        task: str = "transfer_cube",
        seed: int = 0,
        camera_names: Sequence[str] = ("top",),
        height: int = 480,
        width: int = 640,
        realtime: bool = False,
        quality: str = "cheap",
    ) -> None:
        from fluxvla_sim.aloha.tasks import Facts, get_task

        self.task = get_task(task)
        self._quality = _check_quality(quality)
        self._facts = Facts()
        self._size = height, width
        cameras = _cameras("ALOHA", camera_names, ALOHA_CAMERAS, height, width)
        super().__init__(aloha_spec(cameras, ALOHA_HZ), seed, realtime)

    def _make_scene(self) -> Scene:
        from fluxvla_sim.aloha.scene import AlohaScene

        return AlohaScene(self._quality, *self._size)

    def reset(self, seed: int) -> None:
        """Begin an episode: arms at home, cube where ``seed`` puts it."""
        with self._lock:
            super().reset(seed)
            self._facts = type(self._facts)()

    def begin_episode(self, instruction: str, episode: int) -> None:
        """As every simulated robot; and judge the task that ``instruction`` asks for, if any."""
        from fluxvla_sim.aloha.tasks import task_of

        with self._lock:
            self.task = task_of(instruction) or self.task
            super().begin_episode(instruction, episode)

    def _after_step(self) -> None:
        self._facts = self._facts.after(self._scene)

    def task_success(self) -> bool:
        """Whether ``task`` is done, judged now, over everything since :meth:`reset`."""
        with self._lock:
            return self.task.success(self._facts)

    def task_done(self) -> bool:
        """Whether the episode can end: nothing that comes could change :meth:`task_success`."""
        with self._lock:
            return self.task.done(self._facts)


class URSimOperator(SimOperator):
    """A UR5e with a Robotiq 2F-85 at a table with a cube, 50 Hz.

    Args:
        seed: places the cube in the first episode; each later one adds 1.
        camera_names: ``front`` and ``wrist``, in the order of the images.
        height, width: of every picture, in pixels.
        realtime: follow the wall clock instead of simulated time.
        quality: ``cheap`` or ``reference`` pictures.

    Raises:
        ConfigError: an unknown camera or quality.
    """

    def __init__(
        self,
        seed: int = 0,
        camera_names: Sequence[str] = UR_CAMERAS,
        height: int = 480,
        width: int = 640,
        realtime: bool = False,
        quality: str = "cheap",
    ) -> None:
        self._quality = _check_quality(quality)
        self._size = height, width
        cameras = _cameras("UR5e", camera_names, UR_CAMERAS, height, width)
        super().__init__(ur_spec("ur5e", cameras, UR_HZ), seed, realtime)

    def _make_scene(self) -> Scene:
        from fluxvla_sim.ur.scene import URScene

        return URScene(self._quality, *self._size)

    def task_success(self) -> bool:
        """Whether the gripper holds the cube off the table now."""
        with self._lock:
            return bool(self._connected().lifted())
