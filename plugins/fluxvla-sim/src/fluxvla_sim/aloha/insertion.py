"""gym-aloha's insertion, ``gym_aloha/AlohaInsertion-v0``: a peg goes into a socket in the air.

The scripted expert plays the episode in a copy of the simulation first: its commands are the plan.
Both arms grasp and lift open loop. What they hold has slipped by then, by more than the socket
leaves room for, so from there on the objects are servoed: each arm corrects its commands by what
its object's pose lacks, while the two are brought together on one line. That needs the objects'
poses all the way; a copy of the simulation gives them, and as the simulation is deterministic, the
commands that were found there do the same in the episode itself.

For about one placement in eight a wrist is asked for up to a tenth more than its velocity limit,
for a few steps while the objects are turned straight; the limiter in front of the arms then lags.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from fluxvla_sim.aloha.arms import ARMS, DIM, HOME, TABLE, TwoArms
from fluxvla_sim.aloha.cube import CLOSED, HOME_OPENING, MAX_STEPS, OPEN, arm_ik
from fluxvla_sim.motion import (
    minimum_jerk,
    quaternion_product,
    quaternion_share,
    slow_noise,
    turn,
)

if TYPE_CHECKING:
    import numpy.typing as npt

    from fluxvla_sim.motion import ArmIK

    Vector = npt.NDArray[np.float64]

# Metres, world frame: the peg on the right arm's side, the socket on the left one's.
PEG_LOW, PEG_HIGH = (0.1, 0.4, 0.05), (0.2, 0.6, 0.05)
SOCKET_LOW, SOCKET_HIGH = (-0.2, 0.4, 0.05), (-0.1, 0.6, 0.05)
_PEG, _PIN = "red_peg", "pin"
_SOCKET = ("socket-1", "socket-2", "socket-3", "socket-4")


def sample_peg_and_socket(seed: int) -> npt.NDArray[np.float64]:
    """Both poses at the start, ``(14,)``, peg first: position in metres, quaternion wxyz."""
    rng, upright = np.random.RandomState(seed), [1.0, 0.0, 0.0, 0.0]
    peg = rng.uniform(PEG_LOW, PEG_HIGH)
    return np.concatenate([peg, upright, rng.uniform(SOCKET_LOW, SOCKET_HIGH), upright])


class InsertionScene(TwoArms):
    """The arms, a peg, and a socket with a pin inside that only a peg in it can touch."""

    file = "bimanual_viperx_insertion.xml"

    def reset(self, seed: int) -> None:
        self.reset_to(sample_peg_and_socket(seed))

    def reward(self) -> int:
        """gym-aloha's reward: 1 both touched, 2 both lifted, 3 they touch in the air, 4 inserted.

        As there, one named finger of each arm stands for its gripper.
        """
        peg = self.touching(_PEG)
        socket = set().union(*(self.touching(name) for name in _SOCKET))
        if self.geom[_PIN] in peg:
            return 4
        in_air = self.geom[TABLE] not in peg | socket
        if in_air and any(self.geom[name] in peg for name in _SOCKET):
            return 3
        if self.fingers["left"][0] in socket and self.fingers["right"][1] in peg:
            return 2 if in_air else 1
        return 0


@dataclass(frozen=True)
class InsertionFacts:
    """See :class:`fluxvla_sim.world.Facts`; the rewards are gym-aloha's."""

    steps: int = 0
    reward: int = 0
    best_reward: int = 0

    def after(self, scene: InsertionScene) -> InsertionFacts:
        """The facts after one more control step of ``scene``."""
        reward = scene.reward()
        return InsertionFacts(self.steps + 1, reward, max(self.best_reward, reward))


class Insertion:
    """gym-aloha's task: the peg touches the pin inside the socket (reward 4), at any moment."""

    name = "insertion"
    instruction = "put the peg into the socket"
    record_steps = 300

    def success(self, facts: InsertionFacts) -> bool:
        return facts.best_reward == 4

    def done(self, facts: InsertionFacts) -> bool:
        return self.success(facts)


MEET = np.array([0.0, 0.5, 0.18])  # where the two are brought together, metres, world frame
APART, TOGETHER = 0.18, 0.085  # distance of the two centres before and after, metres
OUTWARD = 0.02  # how far from its centre an object is grasped, away from the other one, metres

# Control steps until which: above the objects, down, grasped, lifted, lined up, inserted.
_ABOVE, _DOWN, _GRASPED, _LIFTED, _LINED_UP, _INSERTED = 60, 90, 132, 176, 200, 262
_CLOSE = (88, 132)
_EASE = 25  # steps over which the correction sets in
# Share of what is missing that is corrected in each step. Larger ones make the arms swing.
_GAIN, _TURN_GAIN = 0.08, 0.06
# Along the line the objects push each other once they touch: there a correction would press.
_TOUCHING = np.array([0.2, 1.0, 1.0])
_MOST = 0.05  # metres of correction


@dataclass(frozen=True)
class _Side:
    """One arm's part.

    Args:
        object: index of the first of its object's seven numbers.
        outward: sign of the x direction away from the other arm.
        grasp: height at which the object is grasped, metres: lower, and the fingers press on the
            table and cannot close.
        orientation: of the gripper, wxyz: reaching 60 degrees down along x.
        branch: joint angles near which the first waypoint's solution is sought.
    """

    object: int
    outward: float
    grasp: float
    orientation: Vector
    branch: Vector


_REACH = turn((0, 1, 0), 60)
_SIDES = {
    "left": _Side(7, -1.0, 0.022, _REACH, np.array([0.0, -0.3, 0.6, 0.0, 0.3, 0.0])),
    "right": _Side(
        0,
        1.0,
        0.02,
        quaternion_product(turn((0, 0, 1), 180), _REACH),
        np.array([0.0, -0.3, 0.6, 0.0, 0.3, 0.0]),
    ),
}


class InsertionExpert:
    """Plans 300 commands (6 s) for one placement of peg and socket."""

    def __init__(self, model: Any = None) -> None:
        self._scene = InsertionScene()
        self._ik = {arm: arm_ik(self._scene.model, arm) for arm in ARMS}

    def plan(self, task: str, objects: Vector) -> Vector:
        """``(300, 14)`` joint targets for the poses ``(14,)``, peg first, before the first step."""
        scene = self._scene
        scene.reset_to(objects)
        arms = [_Arm(_SIDES[arm], self._ik[arm], np.asarray(objects)) for arm in ARMS]
        actions = np.empty((MAX_STEPS, DIM))
        for step in range(MAX_STEPS):
            held = scene.objects
            actions[step] = np.concatenate([arm.command(step, held) for arm in arms])
            scene.step(actions[step])
        return actions


class _Arm:
    """Commands of one arm, step by step."""

    def __init__(self, side: _Side, ik: ArmIK, objects: Vector) -> None:
        self._side, self._ik = side, ik
        place = objects[side.object : side.object + 3]
        grasp = np.array([place[0] + side.outward * OUTWARD, place[1], side.grasp])
        above = np.array([*grasp[:2], 0.10])
        self._joints = HOME[:6].copy()
        goal, _ = ik.solve(side.branch, above, side.orientation)
        share = minimum_jerk(_ABOVE)[:, None]
        self._approach = HOME[:6] + share * (goal - HOME[:6])
        # (until, goal of the fingertips): straight from one to the next.
        self._way = ((_DOWN, grasp), (_GRASPED, grasp), (_LIFTED, self._tip(self._wanted(APART))))
        self._from, self._tips = above, above
        self._shift = np.zeros(3)
        self._turned = np.array([1.0, 0.0, 0.0, 0.0])

    def command(self, step: int, objects: Vector) -> Vector:
        """``(7,)`` joint targets for control step ``step``, given where the objects are now."""
        if step < _ABOVE:
            self._joints = self._approach[step]
        else:
            self._reach(*(self._straight(step) if step < _LIFTED else self._servo(step, objects)))
        return np.append(self._joints, _opening(step))

    def _reach(self, tip: Vector, orientation: Vector) -> None:
        self._joints, _ = self._ik.solve(self._joints, tip, orientation)

    def _straight(self, step: int) -> tuple[Vector, Vector]:
        begin, start = _ABOVE, self._from
        for until, goal in self._way:
            if step < until:
                share = minimum_jerk(until - begin)[step - begin]
                return start + share * (goal - start), self._side.orientation
            begin, start = until, goal
        raise AssertionError("the way ends with the lift")

    def _servo(self, step: int, objects: Vector) -> tuple[Vector, Vector]:
        side = self._side
        ease = min(1.0, (step - _LIFTED) / _EASE)
        closing = np.clip((step - _LINED_UP) / (_INSERTED - _LINED_UP), 0.0, 1.0)
        smooth = closing**3 * (10 - 15 * closing + 6 * closing**2)
        wanted = self._wanted(APART + smooth * (TOGETHER - APART))
        pose = objects[side.object : side.object + 7]
        missing = wanted - pose[:3]
        if closing > 0:
            missing = missing * _TOUCHING
        self._shift = np.clip(self._shift + _GAIN * ease * missing, -_MOST, _MOST)
        back = quaternion_share(pose[3:] * [1, -1, -1, -1], _TURN_GAIN * ease)
        self._turned = quaternion_product(back, self._turned)
        return self._tip(wanted) + self._shift, quaternion_product(self._turned, side.orientation)

    def _wanted(self, apart: float) -> Vector:
        """Where the object's centre should be when the two are ``apart``."""
        return MEET + [self._side.outward * apart / 2, 0.0, 0.0]

    def _tip(self, centre: Vector) -> Vector:
        """Where the fingertips are when they hold an object at ``centre`` as it was grasped."""
        return centre + [self._side.outward * OUTWARD, 0.0, 0.0]


def _opening(step: int) -> float:
    begin, end = _CLOSE
    if step < _ABOVE:
        return HOME_OPENING + float(minimum_jerk(_ABOVE)[step]) * (OPEN - HOME_OPENING)
    if step < begin:
        return OPEN
    return OPEN + float(minimum_jerk(end - begin)[min(step, end - 1) - begin]) * (CLOSED - OPEN)


def insertion_noise(rng: np.random.Generator) -> Vector:
    """``(300, 14)`` offsets of about unit size: slow, smaller from the grasp on, no grippers."""
    return slow_noise(rng, MAX_STEPS, DIM, ((_ABOVE, MAX_STEPS),), grippers=(6, 13))
