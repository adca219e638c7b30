"""A scripted expert for tasks of the form 'put this object into that container'.

It sees where things truly are. The gripper goes through nine waypoints, from above, steered by the
distance that is left: so it also finds back when something pushes it off its way.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import numpy.typing as npt

from fluxvla_core.errors import ConfigError
from fluxvla_core.models import Policy
from fluxvla_libero.embodiment import CLOSED, CONTROL_HZ, OPEN, libero_spec
from fluxvla_libero.environment import LiberoEnvironment
from fluxvla_libero.suites import SuiteTask, goal

if TYPE_CHECKING:
    from fluxvla_core.models import Observation
    from fluxvla_libero.scene import LiberoScene

Array = npt.NDArray[np.float64]

_POSITION_GAIN = 2.0 / 0.05  # full speed from 2.5 cm away; 0.05 m is a whole action
_ROTATION_GAIN = 1.0 / 0.5
_MAX_ROTATION = 0.5
_PATIENCE = 60  # steps after which a waypoint is given up
_GRASP_DEPTH = 0.035  # m below the object's top
_CLEARANCE = 0.03  # m between the object and the container's rim when it is let go
_CAREFUL = 0.25  # share of the noise where the gripper is close to something
_SMOOTH = 0.8  # how much of the noise stays from one step to the next


@dataclass(frozen=True)
class Waypoint:
    """Target pose of the gripper.

    Args:
        position: ``(3,)`` m, in the world.
        gripper: its command.
        tolerance: m; the waypoint is reached within it.
        hold: steps within the tolerance before continuing.
        speed: largest action, 1 being the controller's.
        free: nothing is near, so that the arm may be disturbed here.
    """

    position: tuple[float, float, float]
    gripper: float
    tolerance: float
    hold: int
    speed: float
    free: bool = False


class Expert:
    """Puts one object into a container.

    Args:
        scene: after its reset.
        task: what to do; its goal must be ``in`` with an object and a container's region.

    Raises:
        ConfigError: the expert cannot do this task, or its objects are not in the scene.
    """

    def __init__(self, scene: LiberoScene, task: SuiteTask) -> None:
        wanted = goal(task)
        if len(wanted) != 1 or wanted[0][0] != "in" or not scene.can_check(task):
            raise ConfigError(
                f"the scripted expert cannot do {task.name!r} in the scene of {scene.task.name!r}",
                cause="it only puts one object that is there into a container (libero_object)",
            )
        self._scene = scene
        _, thing, region = wanted[0]
        low, high = bounds(scene.model, scene.data, thing)
        container = region.replace("_contain_region", "")
        self._waypoints = plan(low, high, *bounds(scene.model, scene.data, container))
        self._upright = _matrix(scene.quaternion)
        self._index = self._waited = self._held = 0

    @property
    def done(self) -> bool:
        """Whether all waypoints are behind."""
        return self._index >= len(self._waypoints)

    @property
    def free(self) -> bool:
        """Whether the arm may be disturbed now."""
        return self._waypoint.free

    def act(self) -> Array:
        """The action ``(7,)`` for the scene as it is now."""
        point = self._waypoint
        error = np.array(point.position) - self._scene.state[:3]
        turn = _rotation_vector(self._upright @ _matrix(self._scene.quaternion).T)
        action = np.empty(7)
        action[:3] = np.clip(error * _POSITION_GAIN, -point.speed, point.speed)
        action[3:6] = np.clip(turn * _ROTATION_GAIN, -_MAX_ROTATION, _MAX_ROTATION)
        action[6] = point.gripper
        self._waited += 1
        self._held += bool(np.linalg.norm(error) < point.tolerance)
        if self._held >= point.hold or self._waited > _PATIENCE:
            self._index, self._waited, self._held = self._index + 1, 0, 0
        return action

    @property
    def _waypoint(self) -> Waypoint:
        return self._waypoints[min(self._index, len(self._waypoints) - 1)]


class LiberoExpert(Policy):
    """The expert as a policy: one action at a time, for the instruction's task.

    Its success through an evaluation is an upper bound for any policy, and a check of it.

    Args:
        noise: standard deviation of smooth disturbances of the executed positions' deltas, of
            which 1 is the largest. What it means to do, the labels of a demonstration, stays
            without, and so leads back to its way (Laskey et al., "DART", CoRL 2017).

    Raises:
        ConfigError: the noise is not from 0 to 1.
    """

    api: ClassVar[str] = "1.0"
    cameras: ClassVar[tuple[str, ...]] = ()
    action_rate_hz: ClassVar[float] = CONTROL_HZ
    horizon: ClassVar[int] = 1

    def __init__(self, noise: float = 0.0) -> None:
        if not 0 <= noise <= 1:
            raise ConfigError(f"noise must be from 0 to 1, got {noise}")
        self.embodiment = libero_spec(())
        self.executed: Array | None = None
        self._noise = noise
        self._environment: LiberoEnvironment | None = None
        self._expert: Expert | None = None
        self._disturbance = np.zeros(3)
        self._rng = np.random.default_rng(0)

    def enter(self, environment: Any) -> None:
        """Say where it acts.

        Raises:
            ConfigError: that is not LIBERO.
        """
        if not isinstance(environment, LiberoEnvironment):
            raise ConfigError(
                f"LIBERO's expert acts in LiberoEnvironment only, "
                f"not in {type(environment).__name__}"
            )
        self._environment = environment

    def reset(self, seed: int) -> None:
        self._expert = self.executed = None
        self._disturbance = np.zeros(3)
        self._rng = np.random.default_rng(seed)

    def predict_action(self, observation: Observation) -> Array:
        """``(1, 7)``; ``executed`` holds the same with the disturbance.

        Raises:
            ConfigError: ``enter`` was not called, or it cannot do the task.
        """
        if self._environment is None:
            raise ConfigError("LiberoExpert does not know its environment: call enter() first")
        if self._expert is None:
            self._expert = Expert(self._environment.scene, self._environment.task)
        size = self._noise if self._expert.free else _CAREFUL * self._noise
        fresh = self._rng.normal(size=3) * np.sqrt(1 - _SMOOTH**2)
        self._disturbance = _SMOOTH * self._disturbance + fresh
        action = np.clip(self._expert.act(), -1.0, 1.0)[None]
        self.executed = action.copy()
        self.executed[:, :3] = np.clip(action[:, :3] + size * self._disturbance, -1.0, 1.0)
        return action


def plan(low: Array, high: Array, rim_low: Array, rim_high: Array) -> list[Waypoint]:
    """Waypoints that take what lies between ``low`` and ``high`` into a container.

    Args:
        low, high: ``(3,)`` corners of the object's bounding box in the world, m.
        rim_low, rim_high: of the container's.
    """
    x, y = (low[:2] + high[:2]) / 2
    grasp = max(low[2] + 0.01, high[2] - _GRASP_DEPTH)
    there_x, there_y = (rim_low[:2] + rim_high[:2]) / 2
    release = rim_high[2] + (grasp - low[2]) + _CLEARANCE
    travel = max(grasp + 0.15, release + 0.08)
    return [
        Waypoint((x, y, grasp + 0.12), OPEN, 0.015, 2, 1.0, free=True),
        Waypoint((x, y, grasp + 0.03), OPEN, 0.010, 1, 0.6),
        Waypoint((x, y, grasp), OPEN, 0.008, 3, 0.4),
        Waypoint((x, y, grasp), CLOSED, 0.050, 12, 0.3),
        Waypoint((x, y, travel), CLOSED, 0.020, 1, 0.6),
        Waypoint((there_x, there_y, travel), CLOSED, 0.015, 2, 0.8, free=True),
        Waypoint((there_x, there_y, release), CLOSED, 0.012, 2, 0.5),
        Waypoint((there_x, there_y, release), OPEN, 0.050, 8, 0.3),
        Waypoint((there_x, there_y, travel), OPEN, 0.020, 10, 0.6),
    ]


def bounds(model: Any, data: Any, name: str) -> tuple[Array, Array]:
    """Lower and upper corner ``(3,)`` of an object's shapes in the world, m.

    Raises:
        ConfigError: the scene has no such object.
    """
    corners = []
    for geom in range(model.ngeom):
        body = model.body(model.geom_bodyid[geom]).name
        if body == name or body.startswith(f"{name}_"):
            turned = data.geom_xmat[geom].reshape(3, 3)
            corners.append(_shape(model, geom) @ turned.T + data.geom_xpos[geom])
    if not corners:
        raise ConfigError(f"the scene has no object {name!r}")
    points = np.concatenate(corners)
    return points.min(0), points.max(0)


def _shape(model: Any, geom: int) -> Array:
    """Corner points ``(N, 3)`` of a shape in its own frame: a mesh's vertices, else its box."""
    import mujoco

    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        first = model.mesh_vertadr[mesh]
        return np.asarray(model.mesh_vert[first : first + model.mesh_vertnum[mesh]])
    signs = np.array(np.meshgrid((-1, 1), (-1, 1), (-1, 1))).reshape(3, -1).T
    return signs * model.geom_size[geom]


def _matrix(quaternion: Array) -> Array:
    """Rotation matrix of a unit quaternion x, y, z, w."""
    x, y, z, w = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def _rotation_vector(matrix: Array) -> Array:
    """Axis times angle of a rotation well below 180 degrees, the shorter way round."""
    sine = np.array(
        [matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]]
    )
    length = float(np.linalg.norm(sine)) / 2
    if length < 1e-9:
        return np.zeros(3)
    return sine / (2 * length) * float(np.arctan2(length, (np.trace(matrix) - 1) / 2))
