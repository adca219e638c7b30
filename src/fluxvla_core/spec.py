"""Embodiment specs: joints, units, limits and cameras of a robot, for dataset, policy and robot.

Pure data without numpy or torch, so that a config check, a robot's onboard computer and a server
hello can read it without anything installed. Lengths are metres, angles radians, times seconds.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from functools import cached_property
from numbers import Integral
from typing import Any

from fluxvla_core.errors import SpecMismatch
from fluxvla_core.untrusted import checked

VELOCITY = "velocity"
JOINT_KINDS = ("revolute", "prismatic", "gripper", VELOCITY)
UNITS = ("rad", "m", "normalized")
SPEED_UNITS = ("m/s", "rad/s")
"""Units of joints of kind ``velocity``."""
ACTION_MODES = ("absolute", "delta")
# A joint of such a unit or kind is commanded by its speed.
_SPEED_UNITS = re.compile(r".+/\s*s(ec)?(ond)?s?|rpm|hz", re.IGNORECASE)
_SPEED_KINDS = ("base", "continuous", "floating", "planar", "speed", "wheel")
# So is one with such a word in its name, or with two words of these pairs.
_SPEED_WORDS = {"rpm", "speed", "speeds", "twist", "vel", "vels", "velocity", "velocities"}
_SPEED_WORDS |= {"vx", "vy", "vz", "vyaw", "vtheta", "wheel", "wheels", "cmdvel"}
_SPEED_PAIRS = (
    ({"base", "chassis", "mobile"}, {"angular", "drive", "forward", "lateral", "linear", "turn"}),
    ({"angular", "linear"}, {"x", "y", "z"}),
)
NO_SPEEDS = (
    "a mobile base, or another joint that is commanded by its speed, has kind 'velocity' and unit "
    "'m/s' or 'rad/s': any other joint is held by repeating its last command, and a speed that is "
    "repeated rolls on"
)
LARGEST_SIDE = 16384
"""Pixels of an image's side: four times what robots' cameras have."""
ROTATIONS = ("none", "axis_angle", "quaternion_wxyz", "quaternion_xyzw", "euler_xyz", "rotation_6d")


@dataclass(frozen=True)
class Joint:
    """One controlled degree of freedom.

    Args:
        name: the joint's name in messages and logs, for example ``left_waist``.
        unit: ``rad``, ``m``, or ``normalized`` (grippers scaled to a range of their own); ``m/s``
            or ``rad/s`` of kind ``velocity``.
        lower, upper: position limits, in ``unit``; of kind ``velocity`` limits of the speed.
        velocity: largest speed, in ``unit``/s; of kind ``velocity`` the larger of its two limits,
            in ``unit``.
        acceleration: largest acceleration, in ``unit``/s^2; of kind ``velocity`` in ``unit``/s.
        kind: ``revolute``, ``prismatic``, ``gripper``, or ``velocity``: an axis of a mobile base,
            or another joint that is commanded by its speed (see :meth:`base`). To hold it is to
            bring it to 0.
        open, closed: a gripper's values at its ends; together they state its polarity.
        jerk: largest change of acceleration, in ``unit``/s^3 (of kind ``velocity`` in
            ``unit``/s^2), where the maker states one; None does not limit it. Left out of
            ``to_dict`` then, as descriptions from before it have it.
    """

    name: str
    unit: str
    lower: float
    upper: float
    velocity: float
    acceleration: float
    kind: str = "revolute"
    open: float | None = None
    closed: float | None = None
    jerk: float | None = None

    def __post_init__(self) -> None:
        if self.kind in _SPEED_KINDS:
            raise ValueError(f"joint {self.name}: kind {self.kind!r} is a speed's; {NO_SPEEDS}")
        if self.kind not in JOINT_KINDS:
            raise ValueError(f"joint {self.name}: kind {self.kind!r} is not one of {JOINT_KINDS}")
        if self.by_speed:
            self._check_speed()
        elif _SPEED_UNITS.fullmatch(self.unit):
            raise ValueError(f"joint {self.name}: unit {self.unit!r} is a speed's; {NO_SPEEDS}")
        elif self.unit not in UNITS:
            raise ValueError(f"joint {self.name}: unit {self.unit!r} is not one of {UNITS}")
        numbers = (self.lower, self.upper, self.velocity, self.acceleration)
        if not all(math.isfinite(n) for n in numbers):
            raise ValueError(f"joint {self.name}: limits must be finite, got {numbers}")
        if not self.lower < self.upper:
            raise ValueError(f"joint {self.name}: lower {self.lower} is not below {self.upper}")
        ends = [end for end in (self.open, self.closed) if end is not None]
        if not all(math.isfinite(end) for end in ends):
            raise ValueError(f"joint {self.name}: open and closed must be finite, got {ends}")
        if self.velocity <= 0 or self.acceleration <= 0:
            raise ValueError(f"joint {self.name}: velocity and acceleration must be positive")
        if self.jerk is not None and not (math.isfinite(self.jerk) and self.jerk > 0):
            raise ValueError(f"joint {self.name}: jerk must be positive, got {self.jerk}")
        if self.kind == "gripper" and (self.open is None or self.closed is None):
            raise ValueError(f"gripper {self.name}: open and closed state its polarity; give both")

    def _check_speed(self) -> None:
        if self.unit not in SPEED_UNITS:
            raise ValueError(
                f"joint {self.name}: kind {VELOCITY!r} has unit m/s or rad/s, not {self.unit!r}"
            )
        if not self.lower <= 0.0 <= self.upper:
            raise ValueError(
                f"joint {self.name}: a speed of 0 is not in [{self.lower}, {self.upper}], and it "
                "could not be held"
            )
        if self.velocity != max(-self.lower, self.upper):
            raise ValueError(
                f"joint {self.name}: velocity {self.velocity} is not the larger of its limits "
                f"{self.lower} and {self.upper}; Joint.base(...) fills it in"
            )

    @classmethod
    def base(
        cls,
        name: str,
        unit: str,
        speed: float,
        acceleration: float,
        jerk: float | None = None,
        backward: float | None = None,
    ) -> Joint:
        """An axis of a mobile base, or another joint that is commanded by its speed.

        Args:
            name: for example ``base_forward`` or ``base_turn``.
            unit: ``m/s`` or ``rad/s``.
            speed: largest speed, in ``unit``.
            acceleration: largest change of the speed, in ``unit``/s.
            jerk: largest change of the acceleration, in ``unit``/s^2.
            backward: largest speed in the other direction; ``speed`` by default.
        """
        back = speed if backward is None else backward
        return cls(
            name, unit, -back, speed, max(back, speed), acceleration, kind=VELOCITY, jerk=jerk
        )

    @property
    def by_speed(self) -> bool:
        """Whether its command is a speed."""
        return self.kind == VELOCITY

    @property
    def slew_rate(self) -> float:
        """How fast its command may change, in ``unit``/s."""
        return self.acceleration if self.by_speed else self.velocity


@dataclass(frozen=True)
class Camera:
    """One image stream: arrays of shape ``(height, width, 3)``, uint8, in ``encoding`` order.

    One of ``encoding`` ``mono8`` has no colours: all three channels are alike.
    """

    name: str
    height: int
    width: int
    encoding: str = "rgb8"

    def __post_init__(self) -> None:
        sides: tuple[Any, ...] = (self.height, self.width)  # a file may say anything
        for side in sides:
            whole = isinstance(side, Integral) and not isinstance(side, bool)
            if not whole or not 1 <= side <= LARGEST_SIDE:
                raise ValueError(
                    f"camera {self.name}: height and width are whole numbers from 1 to "
                    f"{LARGEST_SIDE}, got {self.height!r} and {self.width!r}"
                )


@dataclass(frozen=True)
class EmbodimentSpec:
    """A robot as a policy sees it: names, units and limits of its joints, cameras, rate.

    Args:
        name: for people, for example ``aloha``.
        joints: order of the action vector, and of the state unless ``state_joints`` is given.
        cameras: order of the images.
        rate_hz: how many commands a second the robot takes.
        action_mode: ``absolute`` joint targets, or ``delta`` from the present position.
        frame: the frame that Cartesian values are in; ``joint`` when there are none.
        rotation: how Cartesian rotations are written; ``none`` when there are none.
        source: where the limits come from (datasheet, URDF, model file).
        state_joints: the state's own joints, when they differ from the action's.
    """

    name: str
    joints: tuple[Joint, ...]
    cameras: tuple[Camera, ...]
    rate_hz: float
    action_mode: str = "absolute"
    frame: str = "joint"
    rotation: str = "none"
    source: str = ""
    state_joints: tuple[Joint, ...] | None = None

    def __post_init__(self) -> None:
        if self.action_mode not in ACTION_MODES:
            raise ValueError(f"action_mode {self.action_mode!r} is not one of {ACTION_MODES}")
        if self.rotation not in ROTATIONS:
            raise ValueError(f"rotation {self.rotation!r} is not one of {ROTATIONS}")
        if not (math.isfinite(self.rate_hz) and self.rate_hz > 0):
            raise ValueError(f"rate_hz must be positive, got {self.rate_hz}")
        for what, names in (("joint", self.joint_names), ("camera", self.camera_names)):
            twice = sorted({n for n in names if names.count(n) > 1})
            if twice:
                raise ValueError(f"{what} names must be unique; twice: {', '.join(twice)}")

    @property
    def dim(self) -> int:
        """Length of the action vector."""
        return len(self.joints)

    @property
    def state_dim(self) -> int:
        """Length of the state vector."""
        return len(self.state_joints or self.joints)

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        return tuple(j.name for j in self.joints)

    @cached_property
    def state_names(self) -> tuple[str, ...]:
        return tuple(j.name for j in self.state_joints or self.joints)

    @cached_property
    def camera_names(self) -> tuple[str, ...]:
        return tuple(c.name for c in self.cameras)

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON values; ``from_dict`` is the inverse."""
        values = asdict(self)
        for joint in (*values["joints"], *(values["state_joints"] or ())):
            # Who knows no jerk limits can still read a robot that has none.
            if joint["jerk"] is None:
                del joint["jerk"]
        return values

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> EmbodimentSpec:
        """Build from plain JSON values.

        Raises:
            SpecMismatch: a key is unknown or missing, or a value is out of its range.
        """
        try:
            made = checked(data, cls, SpecMismatch, "")
        except SpecMismatch as error:
            raise SpecMismatch(f"this is not an embodiment spec: {error.what}") from error
        tables = [*data["joints"], *(data.get("state_joints") or ())]
        for kind, found in ((cls, [data]), (Joint, tables), (Camera, data["cameras"])):
            _refuse_unknown(kind, found)
        return made


def _refuse_unknown(kind: type, tables: Iterable[Mapping[str, Any]]) -> None:
    names = {f.name for f in fields(kind)}
    unknown = sorted({str(key) for table in tables for key in table} - names)
    if unknown:
        raise SpecMismatch(
            f"this is not an embodiment spec: {kind.__name__} takes no "
            f"{', '.join(map(repr, unknown[:8]))}"
        )


def speeds(spec: EmbodimentSpec) -> list[str]:
    """Names of the action's joints that, by their names, are speeds without being of that kind.

    Simulated environments and datasets may have such joints; a robot's are refused.
    """
    return [joint.name for joint in spec.joints if not joint.by_speed and _is_speed(joint.name)]


def _is_speed(name: str) -> bool:
    words = {word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+", name)}
    return bool(words & _SPEED_WORDS) or any(words & a and words & b for a, b in _SPEED_PAIRS)


def differences(a: EmbodimentSpec, b: EmbodimentSpec) -> list[str]:
    """Every difference that changes what a number means; limits and camera sizes may differ.

    Limits belong to the robot that moves, and images are resized by the policy's own
    transforms, so neither is compared.
    """
    found: list[str] = []

    def compare(what: str, left: object, right: object) -> None:
        if left != right:
            found.append(f"{what}: {left} / {right}")

    compare("joints and their order", list(a.joint_names), list(b.joint_names))
    compare("state joints and their order", list(a.state_names), list(b.state_names))
    compare("action mode", a.action_mode, b.action_mode)
    compare("frame", a.frame, b.frame)
    compare("rotation", a.rotation, b.rotation)
    for left, right in zip(a.joints, b.joints, strict=False):
        if left.name == right.name:
            compare(f"unit of {left.name}", left.unit, right.unit)
            compare(f"kind of {left.name}", left.kind, right.kind)
            ends = ((left.open, left.closed), (right.open, right.closed))
            compare(f"open/closed of gripper {left.name}", *ends)
    return found


def check_match(
    a: EmbodimentSpec,
    b: EmbodimentSpec,
    who_a: str,
    who_b: str,
    cameras: Iterable[str] | None = None,
) -> None:
    """Raise an error when ``a`` and ``b`` mean different things by the same numbers.

    Args:
        cameras: names that ``a`` needs and ``b`` must have; all of ``a``'s by default.

    Raises:
        SpecMismatch: names both sides and every difference.
    """
    found = differences(a, b)
    needed = a.camera_names if cameras is None else tuple(cameras)
    missing = [name for name in needed if name not in b.camera_names]
    if missing:
        found.append(f"cameras: {', '.join(missing)} missing; there are {list(b.camera_names)}")
    if found:
        lines = "\n".join(f"    {line}" for line in found)
        raise SpecMismatch(
            f"{who_a} ({a.name}) and {who_b} ({b.name}) do not fit together:\n{lines}",
            cause="they were made for different robots or conventions",
            next="use a checkpoint trained for this robot, or fix the spec that is wrong",
        )
