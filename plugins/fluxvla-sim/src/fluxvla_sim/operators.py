"""Simulated robots as operators: ``AlohaSimOperator`` and ``URSimOperator``.

Importing this module, and constructing an operator, loads neither MuJoCo nor a model file, so
that a config check stays quick.
"""

from __future__ import annotations

from collections.abc import Sequence

from fluxvla_mujoco import check_render

from fluxvla_core.errors import ConfigError
from fluxvla_core.operators import Camera
from fluxvla_sim.aloha.world import ALOHA
from fluxvla_sim.sim_operator import SimOperator
from fluxvla_sim.ur.world import UR5E
from fluxvla_sim.world import SimRobot


def sim_cameras(
    robot: SimRobot, names: Sequence[str], height: int, width: int
) -> tuple[Camera, ...]:
    """Cameras of ``robot`` as its embodiment has them.

    Raises:
        ConfigError: the robot has no such camera, or the size is none.
    """
    unknown = [name for name in names if name not in robot.cameras]
    if unknown:
        raise ConfigError(
            f"the simulated {robot.title} has no camera {', '.join(map(repr, unknown))}; "
            f"it has {', '.join(robot.cameras)}"
        )
    if height < 1 or width < 1:
        raise ConfigError(f"images need a positive size, got {height}x{width}")
    return tuple(Camera(name, height, width) for name in names)


def check_arms(arms: str, operator: str) -> None:
    """Refuse arms that the simulated ALOHA does not have.

    Args:
        arms: as ``AlohaOperator`` takes it.
        operator: the name of the class that was given them.

    Raises:
        ConfigError: they are not ViperX 300.
    """
    if arms != "viperx300":
        raise ConfigError(
            f"the simulated ALOHA has ViperX 300 arms, the config says arms={arms!r}",
            next=f"--set <{operator}>.arms=viperx300",
        )


class AlohaSimOperator(SimOperator):
    """gym-aloha's scenes: two ViperX 300 S arms, 50 Hz.

    Args:
        task: ``transfer_cube``, ``lift_hold`` or ``insertion``: which scene, and what
            :meth:`task_success` checks until an episode's instruction says otherwise.
        seed: places the objects in the first episode; each later one adds 1.
        camera_names: cameras of the scene, in the order of the images.
        height, width: of every image, in pixels.
        realtime: follow the wall clock instead of simulated time.
        render: ``cheap``, ``coarse`` or ``reference`` images, see ``SimEnvironment``.
        arms: ``viperx300``, as a real ALOHA's config says it.

    Raises:
        ConfigError: an unknown task, camera or way to render, or other arms.
    """

    def __init__(
        self,
        task: str = "transfer_cube",
        seed: int = 0,
        camera_names: Sequence[str] = ("top",),
        height: int = 480,
        width: int = 640,
        realtime: bool = False,
        render: str = "cheap",
        arms: str = "viperx300",
    ) -> None:
        check_arms(arms, type(self).__name__)
        check_render(render)
        cameras = sim_cameras(ALOHA, camera_names, height, width)
        super().__init__(ALOHA, task, cameras, seed, realtime, render)


class URSimOperator(SimOperator):
    """A UR5e with a Robotiq 2F-85 at a table with a cube, 50 Hz.

    Args:
        task: ``lift_cube``.
        seed: places the cube in the first episode; each later one adds 1.
        camera_names: ``front`` and ``wrist``, in the order of the images.
        height, width: of every image, in pixels.
        realtime: follow the wall clock instead of simulated time.
        render: ``cheap``, ``coarse`` or ``reference`` images, see ``SimEnvironment``.

    Raises:
        ConfigError: an unknown task, camera or way to render.
    """

    def __init__(
        self,
        task: str = "lift_cube",
        seed: int = 0,
        camera_names: Sequence[str] = UR5E.cameras,
        height: int = 480,
        width: int = 640,
        realtime: bool = False,
        render: str = "cheap",
    ) -> None:
        check_render(render)
        cameras = sim_cameras(UR5E, camera_names, height, width)
        super().__init__(UR5E, task, cameras, seed, realtime, render)
