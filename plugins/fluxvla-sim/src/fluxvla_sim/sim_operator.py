"""Base of the simulated robots' operators: time, thread safety, refusals, frames."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from fluxvla_mujoco import divergence

from fluxvla_core.errors import Faulted, NotReady
from fluxvla_core.operators import Frame, MonotonicClock, Operator, SimulatedClock
from fluxvla_core.ros2 import STATE, checked_action
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
