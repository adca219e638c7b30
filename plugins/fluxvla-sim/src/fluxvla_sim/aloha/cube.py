"""gym-aloha's cube scene, ``gym_aloha/AlohaTransferCube-v0``, its two tasks and their expert.

Both tasks start from the same scene, so that the instruction alone decides what is right. Success
of both is determined in every episode: a policy that gets the other instruction should do the other
task, and that can be counted.

The expert makes 300 joint commands from the cube's pose, open loop. An arm moves from rest to rest
between waypoints along a minimum-jerk profile (Flash and Hogan 1985), either straight in joint
space or along a straight line of its fingertips. The profile and the times keep commands within the
speeds and accelerations that the real arms allow, so that the limits that guard a real robot leave
the expert's motion as it is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from fluxvla_sim.aloha.arms import ARM_JOINTS, ARMS, DIM, HOME, TABLE, TwoArms, load_model
from fluxvla_sim.motion import ArmIK, minimum_jerk, quaternion_product, slow_noise, turn

if TYPE_CHECKING:
    import numpy.typing as npt

    Vector = npt.NDArray[np.float64]

MAX_STEPS = 300
"""Control steps in an episode: gym-aloha's limit, six seconds."""

LIFTED_M = 0.10
"""Height of the cube's centre that counts as lifted; it rests at about 0.02 on the table."""
CUBE_LOW, CUBE_HIGH = (0.0, 0.4, 0.05), (0.2, 0.6, 0.05)  # metres, world frame
_CUBE = "red_box"


def sample_cube(seed: int) -> npt.NDArray[np.float64]:
    """The cube's pose at the start, ``(7,)``: position in metres, quaternion wxyz."""
    position = np.random.RandomState(seed).uniform(CUBE_LOW, CUBE_HIGH)
    return np.concatenate([position, [1.0, 0.0, 0.0, 0.0]])


class AlohaScene(TwoArms):
    """The arms and one cube on the right arm's side."""

    file = "bimanual_viperx_transfer_cube.xml"

    def reset(self, seed: int) -> None:
        self.reset_to(sample_cube(seed))

    @property
    def cube(self) -> npt.NDArray[np.float64]:
        """``(7,)`` the cube's pose."""
        return self.objects

    def fingers_on_cube(self, arm: str) -> tuple[bool, bool]:
        """Which of ``arm``'s two fingers (left, right) touch the cube."""
        touching = self.touching(_CUBE)
        left, right = self.fingers[arm]
        return left in touching, right in touching

    def reward(self) -> int:
        """gym-aloha's reward: 1 right gripper touches, 2 lifted, 3 left touches, 4 handed over.

        As there, one named finger of each arm stands for its gripper.
        """
        touching = self.touching(_CUBE)
        on_table = self.geom[TABLE] in touching
        if self.fingers["left"][0] in touching:
            return 3 if on_table else 4
        if self.fingers["right"][1] in touching:
            return 1 if on_table else 2
        return 0


@dataclass(frozen=True)
class Facts:
    """See :class:`fluxvla_sim.world.Facts`; the rewards are gym-aloha's.

    Args:
        steps: control steps taken.
        reward: gym-aloha's, of the last step; ``best_reward`` the highest of any.
        left_touched: whether a finger of the left arm ever touched the cube.
        right_touches: whether a finger of the right arm touches the cube now.
        height: of the cube's centre now, in metres.
    """

    steps: int = 0
    reward: int = 0
    best_reward: int = 0
    left_touched: bool = False
    right_touches: bool = False
    height: float = 0.0

    def after(self, scene: AlohaScene) -> Facts:
        """The facts after one more control step of ``scene``."""
        reward = scene.reward()
        return Facts(
            steps=self.steps + 1,
            reward=reward,
            best_reward=max(self.best_reward, reward),
            left_touched=self.left_touched or any(scene.fingers_on_cube("left")),
            right_touches=any(scene.fingers_on_cube("right")),
            height=float(scene.cube[2]),
        )


class TransferCube:
    """gym-aloha's task: the left arm holds the cube in the air (reward 4), at any moment."""

    name = "transfer_cube"
    instruction = "hand the cube over to the left arm"
    record_steps = 250

    def success(self, facts: Facts) -> bool:
        return facts.best_reward == 4

    def done(self, facts: Facts) -> bool:
        return self.success(facts)


class LiftHold:
    """The right arm holds the cube in the air at step 300, and the left one never touched it.

    One finger's contact is enough: the solver drops one of a firm grip's two for single steps, and
    nothing else could keep the cube up there.
    """

    name = "lift_hold"
    instruction = "pick up the cube with the right arm and hold it"
    record_steps = 200

    def success(self, facts: Facts) -> bool:
        held = facts.right_touches and facts.height > LIFTED_M
        return held and not facts.left_touched and self.done(facts)

    def done(self, facts: Facts) -> bool:
        return facts.steps >= MAX_STEPS


MEET = np.array([0.0, 0.5, 0.22])  # where the cube changes hands, metres, world frame
HOLD = np.array([0.12, 0.5, 0.25])  # where the right arm holds it up
GRASP_HEIGHT = 0.02
OPEN, CLOSED = 1.0, 0.0
HOME_OPENING = float(HOME[6])
TIP = (0.135, 0.0, 0.0)  # between the fingertips, in the gripper link's frame, metres
# Steps in which a few millimetres decide: coming down on the cube, changing hands.
_DELICATE = ((55, 112), (130, 215))


@dataclass(frozen=True)
class Reach:
    """Be at ``tip`` at step ``until`` (from wherever the arm was).

    Args:
        until: control step at which the motion ends.
        tip: fingertip position ``(3,)`` in metres, world frame; None stays.
        straight: along a straight line of the fingertips rather than of the joints.
    """

    until: int
    tip: Vector | None = None
    straight: bool = True


@dataclass(frozen=True)
class Grip:
    """Move the gripper to ``opening`` (0 closed, 1 open) from step ``start`` to ``until``."""

    start: int
    until: int
    opening: float


@dataclass(frozen=True)
class ArmPlan:
    """The plan of one arm; steps without a motion hold still."""

    reaches: tuple[Reach, ...]
    grips: tuple[Grip, ...]


def _orientation(arm: str, tip: Vector, base: Vector) -> Vector:
    """Quaternion wxyz of the gripper of an arm that stands at ``base``, at ``tip``.

    The right one reaches down at 60 degrees within the plane that its waist turns, so that the
    forearm and the wrist need no roll. The left one comes level, rolled by 90 degrees, so that its
    fingers pass the right ones above and below.
    """
    if arm == "left":
        return turn((1, 0, 0), 90)
    heading = np.arctan2(*(tip[:2] - base[:2])[::-1])
    return quaternion_product(turn((0, 0, 1), np.rad2deg(heading)), turn((0, 1, 0), 60))


# Where the solver starts for the first waypoint. At home the wrist is nearly straight, and there
# a tiny difference in the cube's place decides whether the forearm turns by +pi or -pi; from here
# every plan is on the same branch.
_BRANCH = {
    "left": np.array([0.0, -0.6, 0.9, 0.0, -0.3, np.pi / 2]),
    "right": np.array([0.0, -0.3, 0.6, 0.0, 0.3, 0.0]),
}


def _pick(cube: Vector) -> tuple[tuple[Reach, ...], tuple[Grip, ...]]:
    above, at = np.array([*cube[:2], 0.10]), np.array([*cube[:2], GRASP_HEIGHT])
    reaches = (Reach(50, above, straight=False), Reach(76, at), Reach(110))
    return reaches, (Grip(0, 50, OPEN), Grip(74, 118, CLOSED))


def transfer_plan(cube: Vector) -> dict[str, ArmPlan]:
    """Pick with the right arm, meet in the middle, change hands."""
    reaches, grips = _pick(cube)
    aside, inside = MEET + [-0.14, 0, 0], MEET + [-0.015, 0, 0]
    right = (*reaches, Reach(150, MEET), Reach(226), Reach(262, MEET + [0.12, 0, 0.04]))
    left = (
        Reach(70, aside, straight=False),
        Reach(138),
        Reach(168, inside),
        Reach(228),
        Reach(264, MEET + [-0.12, 0, 0.02]),
    )
    return {
        "left": ArmPlan(left, (Grip(0, 50, OPEN), Grip(162, 206, CLOSED))),
        "right": ArmPlan(right, (*grips, Grip(200, 244, OPEN))),
    }


def lift_plan(cube: Vector) -> dict[str, ArmPlan]:
    """Pick with the right arm, hold up; the left arm stays at home."""
    reaches, grips = _pick(cube)
    return {"left": ArmPlan((), ()), "right": ArmPlan((*reaches, Reach(150, HOLD)), grips)}


_PLANS = {"transfer_cube": transfer_plan, "lift_hold": lift_plan}


def arm_ik(model: Any, arm: str) -> ArmIK:
    """Inverse kinematics of ``arm`` (``left`` or ``right``)."""
    joints = [f"vx300s_{arm}/{name}" for name in ARM_JOINTS]
    return ArmIK(model, joints, f"vx300s_{arm}/gripper_link", TIP)


class Expert:
    """Plans for the tasks of :mod:`fluxvla_sim.aloha.cube`; knows the cube's true pose."""

    def __init__(self, model: Any = None) -> None:
        model = load_model(AlohaScene.file) if model is None else model
        self._ik = {arm: arm_ik(model, arm) for arm in ARMS}
        self._base = {arm: model.body(f"vx300s_{arm}").pos.copy() for arm in ARMS}

    def plan(self, task: str, objects: Vector) -> Vector:
        """Commands for one episode.

        Args:
            task: a task's name.
            objects: ``(7,)`` the cube's pose before the first step.

        Returns:
            ``(300, 14)`` joint targets; row ``t`` is to be reached at the end of step ``t``.
        """
        arms = _PLANS[task](np.asarray(objects, dtype=np.float64))
        return np.concatenate([self._arm(arm, arms[arm]) for arm in ARMS], axis=1)

    def _arm(self, arm: str, plan: ArmPlan) -> Vector:
        actions = np.tile(HOME[:7], (MAX_STEPS, 1))
        ik, base = self._ik[arm], self._base[arm]
        joints, step = HOME[:6].copy(), 0
        for reach in plan.reaches:
            share = minimum_jerk(reach.until - step)
            if reach.tip is not None and reach.straight:
                tip, _ = ik.forward(joints)
                for k, part in enumerate(share):
                    at = tip + part * (reach.tip - tip)
                    joints, _ = ik.solve(joints, at, _orientation(arm, at, base))
                    actions[step + k, :6] = joints
            elif reach.tip is not None:
                wanted = _orientation(arm, reach.tip, base)
                goal, _ = ik.solve(_BRANCH[arm], reach.tip, wanted)
                actions[step : reach.until, :6] = joints + np.outer(share, goal - joints)
                joints = goal
            step = reach.until
            actions[step:, :6] = joints
        actions[:, 6] = _gripper(plan.grips)
        return actions


def _gripper(grips: tuple[Grip, ...]) -> Vector:
    opening = np.full(MAX_STEPS, HOME_OPENING)
    for grip in grips:
        before = opening[grip.start]
        share = minimum_jerk(grip.until - grip.start)
        opening[grip.start : grip.until] = before + share * (grip.opening - before)
        opening[grip.until :] = grip.opening
    return opening


def smooth_noise(rng: np.random.Generator) -> Vector:
    """``(300, 14)`` offsets of about unit size that disturb the expert within what the arms can do.

    They are slow, smaller in delicate phases, and 0 for the grippers.
    """
    return slow_noise(rng, MAX_STEPS, DIM, _DELICATE, grippers=(6, 13))
