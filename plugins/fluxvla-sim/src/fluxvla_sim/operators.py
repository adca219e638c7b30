"""Simulated robots as operators: ``AlohaSimOperator`` and ``URSimOperator``.

Importing this module, and constructing an operator, loads neither MuJoCo nor a model file, so
that a config check stays quick.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from fluxvla_mujoco import check_render, divergence

from fluxvla_core.errors import ConfigError, Faulted, NotReady
from fluxvla_core.operators import Camera, Frame, MonotonicClock, Operator, SimulatedClock
from fluxvla_core.ros2 import STATE, checked_action
from fluxvla_sim.aloha.world import ALOHA
from fluxvla_sim.ur import UR5E
from fluxvla_sim.world import SimRobot, task_of

if TYPE_CHECKING:
    import numpy.typing as npt

    from fluxvla_core.operators import Camera


class SimOperator(Operator):
    """One simulated robot behind the operator contract.

    In simulated time (the default) a control period passes with each ``send_action``, and the
    world waits while the policy thinks. With ``realtime`` the world keeps moving: periods pass
    with the wall clock, and the last command holds until the next one. Either way the physics is
    stepped only in multiples of the control period, in the calling thread.

    Args:
        robot: which.
        task: which of its worlds, and what :meth:`task_success` checks.
        cameras: in the order of the images.
        seed: of the first episode; :meth:`connect` resets to it.
        realtime: follow the wall clock.
        render: quality of the images.

    Raises:
        ConfigError: the robot has no such task.
    """

    api: ClassVar[str] = "1.0"

    def __init__(
        self,
        robot: SimRobot,
        task: str,
        cameras: tuple[Camera, ...],
        seed: int,
        realtime: bool,
        render: str,
    ) -> None:
        self.robot = robot
        self.world, self.task = robot.find(task)
        self.embodiment = robot.embodiment(cameras)
        self.seed = seed
        self.realtime = realtime
        self.clock = MonotonicClock() if realtime else SimulatedClock()
        self._render = render
        self._period = 1.0 / self.embodiment.rate_hz
        self._periods = 0
        self._started = 0.0
        self._lock = threading.RLock()
        self._scene: Any = None
        self._target: npt.NDArray[np.float64] = np.zeros(self.embodiment.dim)
        self._moving = False  # commanded since the last stop
        self._facts = self.world.begin()
        self._judged = True

    @property
    def scene(self) -> Any:
        """The scene; experts see through it.

        Raises:
            NotReady: not connected.
        """
        return self._connected()

    def connect(self) -> None:
        """Build the scene and reset it to ``seed``; again after :meth:`close` if wanted."""
        with self._lock:
            if self._scene is None:
                self._scene = self.world.open_scene(self._render)
                self._periods, self._started = 0, self.clock.now()
                self.reset(self.seed)

    def reset(self, seed: int) -> None:
        """Begin an episode: robot at home, objects where ``seed`` puts them. Time continues.

        Raises:
            NotReady: not connected.
        """
        with self._lock:
            self._connected().reset(seed)
            self._target, self._moving = self._measured(), False
            self._facts = self.world.begin()

    def begin_episode(self, instruction: str, episode: int) -> None:
        """Reset for episode number ``episode``, counted from 0; runners call this before each.

        Objects go where ``seed + episode`` puts them; the task that ``instruction`` asks for, if
        any, is the one that is checked.
        """
        with self._lock:
            found = task_of(self.world, instruction)
            self.task, self._judged = found or self.task, found is not None
            self.reset(self.seed + episode)

    def get_state(self) -> npt.NDArray[np.float64]:
        """``(dim,)`` the state alone, without drawing anything.

        Raises:
            NotReady: not connected.
        """
        with self._lock:
            scene = self._connected()
            self._catch_up()
            return np.array(scene.state)

    def get_frame(self) -> Frame:
        """State and images of this moment.

        Raises:
            NotReady: not connected.
        """
        with self._lock:
            scene = self._connected()
            self._catch_up()
            now = self.clock.now()
            images = {
                c.name: scene.render(c.name, c.height, c.width) for c in self.embodiment.cameras
            }
            stamps = dict.fromkeys((STATE, *images), now)
            return Frame(state=np.array(scene.state), images=images, stamps=stamps)

    def task_success(self) -> bool | None:
        """Whether ``task`` is done by now, from everything since :meth:`reset`.

        None if the episode's instruction is not one of the world's.
        """
        with self._lock:
            return self.task.success(self._facts) if self._judged else None

    def task_done(self) -> bool:
        """Whether the episode can end: nothing that comes could change :meth:`task_success`."""
        with self._lock:
            return self._judged and self.task.done(self._facts)

    def send_action(self, action: npt.NDArray[np.float64]) -> None:
        """Command joint targets; in simulated time one control period passes.

        Raises:
            NotReady: not connected.
            Faulted: the simulation diverged.
            Rejected: wrong shape, non-finite, or outside the embodiment's position limits.
        """
        target = checked_action(self.embodiment, action)
        with self._lock:
            self._connected()
            self._catch_up()
            self._target, self._moving = target, True
            if not self.realtime:
                self._step()

    def stop(self) -> None:
        """Hold where the robot is; any state, any thread, any number of times.

        A later one changes nothing: an arm that droops would sink further with each.
        """
        with self._lock:
            if self._scene is not None and self._moving:
                self._target, self._moving = self._measured(), False

    def close(self) -> None:
        """Free the scene; any number of times."""
        with self._lock:
            if self._scene is not None:
                self._scene.close()
                self._scene = None

    def _connected(self) -> Any:
        if self._scene is None:
            raise NotReady(f"{type(self).__name__} is not connected", next="call connect() first")
        return self._scene

    def _step(self) -> None:
        self._scene.step(self._target)
        self._periods += 1
        why = divergence(self._scene.data)
        if why is not None:
            raise Faulted(f"the simulation diverged: {why}", next="begin another episode")
        if isinstance(self.clock, SimulatedClock):
            self.clock.advance(self._period)
        self._facts = self._facts.after(self._scene)

    def _catch_up(self) -> None:
        if self.realtime:
            due = int((self.clock.now() - self._started) / self._period)
            while self._periods < due:
                self._step()

    def _measured(self) -> npt.NDArray[np.float64]:
        lower = [j.lower for j in self.embodiment.joints]
        upper = [j.upper for j in self.embodiment.joints]
        return np.clip(np.asarray(self._scene.state, dtype=np.float64), lower, upper)


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
