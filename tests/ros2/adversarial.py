"""Arms, policies and filters that do whatever hypothesis says, for ``test_limits_property``.

An arm may lag behind its commands, overshoot them, droop, press on what its jaw holds, be slowed
down by a person, be pushed in the middle of an episode and between two, and lie about all of it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from hypothesis import strategies as st

from fluxvla_core import Frame
from fluxvla_core.contracts.policy import Continuation
from fluxvla_core.control.clock import SimulatedClock
from fluxvla_core.control.filters import LowPass, SnapGripper
from fluxvla_core.control.joiners import METHODS
from fluxvla_core.control.tracking import HOLD_REACH
from fluxvla_core.ros2.stop_motion import PATIENCE_S, braking_commands, hold_target
from fluxvla_core.spec import Camera, EmbodimentSpec, Joint

ARM = EmbodimentSpec(
    "arm",
    (
        Joint("shoulder", "rad", -1.0, 1.5, 2.0, 10.0),
        Joint("slide", "m", 0.0, 0.4, 0.5, 3.0, kind="prismatic"),
        Joint("jaw", "normalized", 0.0, 1.0, 2.28, 30.0, kind="gripper", open=1.0, closed=0.0),
    ),
    (Camera("front", 8, 8),),
    50.0,
)
LOWER, UPPER = np.array([(j.lower, j.upper) for j in ARM.joints]).T
HOME = np.array([0.1, 0.2, 0.5])
REACH = np.array([HOLD_REACH[j.kind] for j in ARM.joints])
DROOP = np.array([0.04, 0.004, 0.0])
# What the jaw holds keeps it from closing further.
HELD = 0.3
CHUNKS = 40
# No rule but the limits is in the way of these.
LIMITS_ALONE = {"jump_s": 1e12, "excess": 1e12, "tracking_error": 1e12}
LIMITS_AND_TRACKING = {"jump_s": 1e12, "excess": 1e12}


class Arm:
    """Goes to each command, on a clock of its own; lies about itself when told to.

    Args:
        send: takes each command on its way.
        case: of ``SETTINGS``.
    """

    api = "1.0"
    embodiment = ARM

    def __init__(self, send: Callable[[np.ndarray], None], case: Mapping[str, Any]) -> None:
        self.send = send
        self.case = case
        self.clock = SimulatedClock()
        self.pose = HOME.copy()
        self.last: np.ndarray | None = None
        self.before: np.ndarray | None = None
        self.was = HOME.copy()
        self.moving = False
        self.sent = 0
        self.lie: tuple[str, float] | None = None

    def connect(self) -> None:
        self.lie = None

    def get_frame(self) -> Frame:
        kind, amount = self.lie or ("", 0.0)
        now, state, image = self.clock.now(), self.pose.copy(), np.zeros((8, 8, 3), np.uint8)
        stamps = {"state": now, "front": now}
        if kind == "noise":
            state += amount * 1e-3
        elif kind == "elsewhere":
            state += amount
        elif kind == "nan":
            state[int(abs(amount)) % 3] = np.nan
        elif kind == "short":
            state = state[:2]
        elif kind == "image":
            image = np.zeros((4, 8, 3), np.uint8)
        elif kind == "stamps":
            stamps["front"] += amount
        return Frame(state, {} if kind == "blind" else {"front": image}, stamps)

    def send_action(self, action: np.ndarray) -> None:
        first, self.moving = not self.moving, True
        self._follow(action)
        if first:
            # The one before was a stop's: as ``Motion`` has it, no motion of this episode's.
            self.before = None

    def _follow(self, action: np.ndarray) -> None:
        self.send(action)
        self.before, self.last = self.last, np.array(action)
        self.sent += 1
        self.was = self.pose.copy()
        rest = self.last - self.case["droop"] * DROOP
        rest[2] = max(rest[2], HELD if self.case["droop"] else 0.0)
        pose = self.pose + self.case["follows"] * (rest - self.pose)
        # It overshoots into its end stops at most.
        self.pose = np.clip(pose, LOWER - DROOP, UPPER + DROOP)
        self.clock.advance(1 / ARM.rate_hz)

    def stop(self) -> None:
        """As ``RosOperator`` does it, on this arm's clock."""
        if not self.moving:
            return
        self.moving = False
        last = self.last
        before = last if self.before is None else self.before
        moved = (self.pose - self.was) * PATIENCE_S * ARM.rate_hz
        target = hold_target(ARM, last, self.pose, moved)
        for command in braking_commands(ARM, last, before, 1 / ARM.rate_hz, target):
            self._follow(command)

    def close(self) -> None:
        """Nothing was opened."""

    def pushed(self, way: float) -> None:
        """Somebody moves it, within its limits."""
        if way:
            self.pose[:2] = np.clip(self.pose + way, LOWER, UPPER)[:2]

    def beginning(self) -> np.ndarray:
        """From where the next episode has to set off: what holds it, but for what was moved."""
        if self.last is None:
            return self.pose.copy()
        stayed = np.abs(self.pose - self.last) <= REACH
        kept = stayed if self.case["tells"] else np.inf == REACH
        return np.where(kept, self.last, np.clip(self.pose, LOWER, UPPER))


class Readable:
    """Tells where it is at any time."""

    def get_state(self):
        return self.pose.copy()


class Telling:
    """Knows what holds it."""

    @property
    def last_action(self):
        return self.last


class Slowed:
    """A person moves the speed slider, every few commands."""

    @property
    def speed_scaling(self):
        shares = self.case["shares"]
        return shares[self.sent // 7 % len(shares)]


def arm_of(send: Callable[[np.ndarray], None], case: Mapping[str, Any]) -> Arm:
    """An arm that has what the case says, and lacks the rest."""
    more = (
        *[Readable] * case["readable"],
        *[Telling] * case["tells"],
        *[Slowed] * bool(case["shares"]),
    )
    return type("Arm", (*more, Arm), {})(send, case)


class Adversary:
    """Plays a script of moves, one for each chunk; ends the episode after the last."""

    embodiment = ARM
    horizon = 4

    def __init__(self, arm: Arm, script: list[tuple[str, float, float, str]], rate: float) -> None:
        self.arm = arm
        self.script = script
        self.action_rate_hz = rate
        self.played = 0
        self.continued = 0
        self.pushes = 0

    @property
    def over(self) -> bool:
        return self.played == len(self.script)

    def reset(self, seed: int) -> None:
        self.arm.lie = None

    def predict_action(self, observation: dict[str, Any]) -> np.ndarray:
        if self.over:
            raise ValueError("the script is over")
        kind, a, b, lie = self.script[self.played]
        self.played += 1
        self.arm.lie = (lie, b) if lie else None
        if lie == "pushed":
            self.arm.pushed(float(np.clip(b, -0.25, 0.25)))
            self.pushes += 1
        return chunk_of(kind, a, b, np.asarray(observation["qpos"], dtype=np.float64))

    def continue_action(self, observation: dict[str, Any], rest: Continuation) -> np.ndarray:
        """Agrees with what is over by then, and with nothing else."""
        chunk = self.predict_action(observation)
        if chunk.shape != rest.actions.shape:
            return chunk
        self.continued += rest.frozen > 0
        return np.where(rest.weights[:, None] == 1.0, rest.actions, chunk)


def chunk_of(kind: str, a: float, b: float, pose: np.ndarray) -> np.ndarray:
    """``(4, 3)`` actions, or what somebody took for it."""
    steps = np.arange(1, 5)[:, None]
    way = np.array([a, b, a - b])
    if kind == "far":
        return pose + steps * way
    if kind == "spike":
        return pose + np.where(steps == 2, way, 0.0)
    if kind == "to and fro":
        return np.where(steps % 2, LOWER, UPPER) + 1e-3 * way
    if kind == "sweep":
        return np.linspace(LOWER - abs(a), UPPER + abs(b), 4)
    if kind == "near":
        return pose + steps * way * 1e-3
    if kind == "huge":
        return np.full((4, 3), np.copysign(1e300, a))
    if kind == "nan":
        return np.where(steps == 3, np.nan, pose + 0 * steps)
    if kind == "shape":
        return np.zeros((4, 2))
    return np.repeat(pose[None], 4, axis=0)


def hold_against_limits(path: np.ndarray, start: np.ndarray, halts: bool) -> None:
    """Positions, speeds and accelerations of ``(N, 3)`` commands, from rest at ``start`` to rest.

    ``halts``: joints that do not obey may halt at once, which must not push them on.
    """
    if not len(path):
        return
    assert np.isfinite(path).all()
    whole = np.vstack([start, start, path])
    speed = np.diff(whole, axis=0) * ARM.rate_hz
    push = np.diff(speed, axis=0) * ARM.rate_hz
    for column, joint in enumerate(ARM.joints):
        assert path[:, column].min() >= joint.lower, joint.name
        assert path[:, column].max() <= joint.upper, joint.name
        assert np.abs(speed[:, column]).max() <= joint.velocity, joint.name
        beyond = np.flatnonzero(np.abs(push[:, column]) > joint.acceleration)
        assert beyond.size <= halts, joint.name
        for halt in beyond:
            assert abs(speed[halt + 1, column]) <= joint.acceleration / ARM.rate_hz, joint.name
        assert abs(speed[-1, column]) <= joint.acceleration / ARM.rate_hz, joint.name


class Shaken:
    """A filter that is worse than any policy."""

    def __init__(self) -> None:
        self.side = 1.0

    def __call__(self, action: np.ndarray) -> np.ndarray:
        self.side = -self.side
        return action + 0.1 * self.side


FILTERS: Mapping[str, Callable[[], list[Any]]] = {
    "none": list,
    "smooth": lambda: [LowPass(0.3), SnapGripper(0.2)],
    "shaken": lambda: [Shaken()],
}
MOVES = ["far", "spike", "to and fro", "sweep", "near", "huge", "rest"]
LIES = ["", "", "", "noise", "pushed"]
AMOUNTS = st.floats(-50.0, 50.0, allow_nan=False) | st.floats(-0.2, 0.2, allow_nan=False)
# Nine in ten go on; what ends an episode (and begins the next) comes between them.
GOOD = st.tuples(st.sampled_from(MOVES), AMOUNTS, AMOUNTS, st.sampled_from(LIES))
ENDING = st.tuples(
    st.sampled_from([*MOVES, "nan", "shape"]),
    AMOUNTS,
    AMOUNTS,
    st.sampled_from(["", "elsewhere", "nan", "short", "image", "stamps", "blind"]),
)
MOVE = st.integers(0, 9).flatmap(lambda n: ENDING if n == 0 else GOOD)
SCRIPTS = st.lists(MOVE, min_size=CHUNKS, max_size=CHUNKS)
POSES = st.tuples(*(st.floats(j.lower, j.upper) for j in ARM.joints))
SHARES = st.lists(st.sampled_from([0.0, 0.1, 0.3, 1.0]), max_size=3).map(lambda s: s and [*s, 1.0])
SETTINGS = st.fixed_dictionaries(
    {
        "safety": st.sampled_from([LIMITS_ALONE, LIMITS_AND_TRACKING, {}]),
        "execute_horizon": st.sampled_from([1, 2, 4, None]),
        "rate": st.sampled_from([25.0, 10.0]),
        "joining": st.sampled_from([*METHODS, "rtc"]),
        "latency": st.sampled_from([0.0, 0.0, 0.06, 0.3]),
        "filters": st.sampled_from(["none", "none", *FILTERS]),
        "start_pose": st.none() | POSES,
        "shares": st.just([]) | SHARES,
        "follows": st.sampled_from([1.0, 0.5, 0.08, 2.0]),
        "readable": st.booleans(),
        "droop": st.sampled_from([0.0, 1.0]),
        "tells": st.booleans(),
        # What somebody does to the arm after each stop.
        "pushes": st.lists(st.sampled_from([0.0, 0.0, 0.1, -0.5]), min_size=1, max_size=3),
    }
)

# Between them, every setting that hypothesis may leave out of a few examples: which ones it makes
# depends on what else the process has imported.
_MIXED = [("sweep", 0.1, 0.1, ""), ("near", 0.1, -0.2, "noise"), ("far", 0.3, 0.2, "pushed")]
_SCRIPT = [*([*_MIXED, ("rest", 0.0, 0.0, "")] * 9), ("nan", 0.0, 0.0, ""), *_MIXED]
EXAMPLES: list[tuple[list[tuple[str, float, float, str]], dict[str, Any]]] = [
    (
        _SCRIPT,
        {
            "safety": LIMITS_ALONE,
            "execute_horizon": None,
            "rate": 25.0,
            "joining": "rtc",
            "latency": 0.06,
            "filters": "smooth",
            "start_pose": None,
            "shares": [],
            "follows": 0.5,
            "readable": True,
            "droop": 1.0,
            "tells": True,
            "pushes": [-0.5],
        },
    ),
    (
        _SCRIPT,
        {
            "safety": {"jump_s": 1e12, "excess": 1e12, "tracking_error": 0.01},
            "execute_horizon": None,
            "rate": 25.0,
            "joining": "synchronous",
            "latency": 0.0,
            "filters": "shaken",
            "start_pose": (0.5, 0.1, 0.2),
            "shares": [0.3, 1.0],
            "follows": 2.0,
            "readable": True,
            "droop": 0.0,
            "tells": False,
            "pushes": [-0.5],
        },
    ),
]
