"""Physics of gym-aloha's two ViperX 300 S arms, stepped directly.

State, command, gripper scale, placement of objects and reward are those of gym-aloha 0.1.5: same
model files, same 2 ms steps, ten to a command, same order of MuJoCo calls, so that a trajectory is
bit-identical to the stock environments'. What is left out is their price: three 480x640 images
with shadows after every step.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from fluxvla_mujoco import set_render

from fluxvla_core.errors import RunFailed
from fluxvla_sim.render import DrawnScene, import_mujoco
from fluxvla_sim.world import SUBSTEPS

if TYPE_CHECKING:
    import numpy.typing as npt

DIM = 14
ARMS = ("left", "right")
ARM_JOINTS = ("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate")
TABLE = "table"

# gym_aloha.constants; that module cannot be imported without gymnasium and dm_control.
FINGER_CLOSED, FINGER_OPEN = 0.01844, 0.05800  # metres
HOME_ARM = (0.0, -0.96, 1.16, 0.0, -0.3, 0.0)  # radians
HOME_FINGER = 0.02239  # metres


def to_normalized(finger: float | npt.NDArray[np.float64]) -> Any:
    """Finger position in metres to gripper opening, 0 closed to 1 open."""
    return (finger - FINGER_CLOSED) / (FINGER_OPEN - FINGER_CLOSED)


def to_metres(opening: float | npt.NDArray[np.float64]) -> Any:
    """Gripper opening, 0 closed to 1 open, to finger position in metres."""
    return opening * (FINGER_OPEN - FINGER_CLOSED) + FINGER_CLOSED


HOME: npt.NDArray[np.float64] = np.array([*HOME_ARM, to_normalized(HOME_FINGER)] * 2)


def load_model(file: str, render: str = "cheap") -> Any:
    """``mujoco.MjModel`` of one of the files that gym-aloha installs.

    Raises:
        RunFailed: gym-aloha is not installed, or EGL is missing.
    """
    mujoco = import_mujoco()
    # Found without importing the package, which would pull in gymnasium.
    package = importlib.util.find_spec("gym_aloha")
    if package is None or package.origin is None:
        raise RunFailed(
            "the ALOHA scene is not installed", next="pip install --no-deps gym-aloha==0.1.5"
        )
    model = mujoco.MjModel.from_xml_path(str(Path(package.origin).parent / "assets" / file))
    set_render(model, render)
    return model


class TwoArms(DrawnScene):
    """Both arms and the objects of one model file; see :class:`fluxvla_sim.world.Scene`.

    A subclass says in ``file`` which, places the objects in :meth:`reset`, and gives the reward.

    Args:
        render: quality of the images, see ``fluxvla_mujoco.drawing``.

    Attributes:
        steps: commands since the last reset.
    """

    file: str

    def __init__(self, render: str = "cheap") -> None:
        self._mujoco = import_mujoco()
        self.model = load_model(self.file, render)
        self.data = self._mujoco.MjData(self.model)
        self.steps = 0
        names = [self.model.geom(i).name for i in range(self.model.ngeom)]
        self.geom = {name: i for i, name in enumerate(names) if name}
        self.fingers = {
            arm: tuple(
                self.geom[f"vx300s_{arm}/10_{finger}_gripper_finger"]
                for finger in ("left", "right")
            )
            for arm in ARMS
        }

    def reset(self, seed: int) -> None:
        """Arms at home, objects where gym-aloha puts them for ``seed`` (0 to 2**32 - 1)."""
        raise TypeError(f"{type(self).__name__} must say where its objects are")

    def reset_to(self, objects: npt.NDArray[np.float64]) -> None:
        """Arms at home, objects at the poses ``(7 n,)``."""
        mujoco, model, data = self._mujoco, self.model, self.data
        fingers = (HOME_FINGER, -HOME_FINGER)
        home = (*HOME_ARM, *fingers) * 2
        # dm_control computes the derived quantities, with the actuators off, in the model's own
        # pose and then twice in ours (its nested reset contexts each end so). Each pass starts the
        # contact solver from the one before, and the last bits of every later step depend on it.
        flags = model.opt.disableflags
        model.opt.disableflags = flags | mujoco.mjtDisableBit.mjDSBL_ACTUATION
        mujoco.mj_resetData(model, data)
        mujoco.mj_forward(model, data)
        data.qpos[:16] = home
        data.ctrl[:] = home
        data.qpos[16:] = objects
        mujoco.mj_forward(model, data)
        mujoco.mj_forward(model, data)
        model.opt.disableflags = flags
        self.steps = 0

    def step(self, action: npt.NDArray[np.float64]) -> None:
        """Drive to the joint targets ``action`` ``(14,)`` for one control period (20 ms)."""
        self.advance(action, SUBSTEPS)
        self.steps += 1

    def advance(self, action: npt.NDArray[np.float64], substeps: int) -> None:
        """Drive to ``action`` for ``substeps`` steps of 2 ms."""
        mujoco, model, data = self._mujoco, self.model, self.data
        left, right = to_metres(action[6]), to_metres(action[13])
        data.ctrl[:] = [*action[:6], left, -left, *action[7:13], right, -right]
        # Positions and velocities are already up to date, so the first step is only its second
        # half, and one first half at the end brings them up to date again.
        mujoco.mj_step2(model, data)
        mujoco.mj_step(model, data, substeps - 1)
        mujoco.mj_step1(model, data)

    @property
    def state(self) -> npt.NDArray[np.float64]:
        """``(14,)`` joint positions: radians, and gripper openings 0 closed to 1 open."""
        q = self.data.qpos
        return np.concatenate(
            [q[:6], [to_normalized(q[6])], q[8:14], [to_normalized(q[14])]]
        ).astype(np.float64)

    @property
    def objects(self) -> npt.NDArray[np.float64]:
        """``(7 n,)`` poses: position in metres in the world frame, quaternion wxyz."""
        return np.array(self.data.qpos[16:])

    def touching(self, name: str) -> set[int]:
        """The geoms that touch the geom called ``name``."""
        geom = self.geom[name]
        return {int(a if b == geom else b) for a, b in self.data.contact.geom if geom in (a, b)}
