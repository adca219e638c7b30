"""Checks of what comes in: readings, before a policy may act on them, and the policy's chunks.

A reading is complete, well formed, fresh, and of one moment; a chunk is a motion for this arm.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.frame import STATE, Frame
from fluxvla_core.robot.safety_settings import SafetySettings
from fluxvla_core.robot.stops import BadChunk, BadFrame, BadTiming
from fluxvla_core.spec.embodiment import EmbodimentSpec

Array = npt.NDArray[np.float64]
# How much further beyond its limits a gripper may be wanted: pressing is how policies hold things.
GRIPPER_EXCESS = 4.0
# A stamp may be this far in the future: the reading was taken while its age was computed.
AHEAD_S = 0.005


def as_frame(value: Any, source: str) -> Frame:
    """``value`` if it has what a frame has.

    Args:
        value: what ``source`` gave, for example ``Arm.get_frame()``.

    Raises:
        BadFrame: it is something else; names ``source``.
    """
    fields = ("state", "images", "stamps")
    if not all(hasattr(value, field) for field in fields):
        raise BadFrame(
            f"{source} gave a {type(value).__name__}, not a Frame",
            cause="a Frame has state, images and stamps; where there is no reading yet, "
            "get_frame() raises NotReady",
            next="see docs/writing-a-plugin.md for an example",
        )
    for field in fields[1:]:
        found = getattr(value, field)
        if not isinstance(found, Mapping):
            raise BadFrame(f"{field} of what {source} gave is a {type(found).__name__}, not a dict")
    frame: Frame = value
    return frame


def as_state(value: Any, embodiment: EmbodimentSpec, source: str) -> npt.NDArray[np.float64]:
    """``(state_dim,)`` float64 of what ``source`` gave.

    Raises:
        BadFrame: it is no array of numbers, has another shape, or is not finite.
    """
    return _as_vector(value, embodiment.state_names, embodiment.name, source)


def as_action(value: Any, embodiment: EmbodimentSpec, source: str) -> npt.NDArray[np.float64]:
    """``(dim,)`` float64 of what ``source`` gave.

    Raises:
        BadFrame: it is no array of numbers, has another shape, or is not finite.
    """
    return _as_vector(value, embodiment.joint_names, embodiment.name, source)


def as_number(value: Any, source: str) -> float:
    """A finite number that ``source`` gave.

    Raises:
        BadFrame: it is none.
    """
    if not is_number(value) or not math.isfinite(value):
        raise BadFrame(f"{source} is {value!r}, not a finite number")
    return float(value)


def is_number(value: Any) -> bool:
    """Whether ``value`` is a real number, numpy's among them; a truth value is none."""
    return isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)


def _as_vector(
    value: Any, names: tuple[str, ...], robot: str, source: str
) -> npt.NDArray[np.float64]:
    try:
        found = np.asarray(value)
    except ValueError:  # rows of different lengths
        found = np.empty(0, dtype=object)
    if found.dtype.kind not in "fiu":
        raise BadFrame(f"{source} is no array of numbers, but a {type(value).__name__}")
    if found.shape != (len(names),):
        raise BadFrame(f"{source} has shape {found.shape}; {robot} has ({len(names)},)")
    bad = [name for name, ok in zip(names, np.isfinite(found), strict=True) if not ok]
    if bad:
        raise BadFrame(f"{source} is not finite for {', '.join(bad)}")
    return found.astype(np.float64)


def check_frame(frame: Frame, embodiment: EmbodimentSpec, cameras: Iterable[str]) -> None:
    """Refuse a frame that is not what the embodiment describes.

    Args:
        frame: as ``Operator.get_frame`` returns it.
        embodiment: whose state and cameras are expected.
        cameras: the names of those that are needed.

    Raises:
        BadFrame: state of another shape or not finite; a camera missing; a picture that is not
            ``(height, width, 3)`` uint8 of the camera's size.
    """
    as_state(frame.state, embodiment, "the robot's state")
    sizes = {camera.name: (camera.height, camera.width, 3) for camera in embodiment.cameras}
    for name in cameras:
        image = frame.images.get(name)
        if image is None:
            raise BadFrame(
                f"camera {name} gave no picture", cause="it is not connected, or has another name"
            )
        if not isinstance(image, np.ndarray):
            raise BadFrame(f"camera {name} gives a {type(image).__name__}, not an array")
        if image.dtype != np.uint8 or image.shape != sizes.get(name, image.shape):
            raise BadFrame(
                f"camera {name} gives {image.shape} {image.dtype}, "
                f"the embodiment says {sizes.get(name)} uint8",
                cause="the camera's mode was changed, or the spec is of another camera",
            )


class FreshnessGate:
    """Receipt age and skew of the streams of an observation, and that none runs backwards.

    Args:
        max_age_s: how old the newest reading of any stream may be.
        max_skew_s: how far the streams may be apart.
    """

    def __init__(self, max_age_s: float, max_skew_s: float) -> None:
        self.max_age_s = max_age_s
        self.max_skew_s = max_skew_s
        self._newest: dict[str, float] = {}

    def reset(self) -> None:
        """Forget what was seen: the operator was connected anew."""
        self._newest.clear()

    def check(self, stamps: Mapping[str, float], cameras: Iterable[str], now: float) -> float:
        """Admit one observation.

        Args:
            stamps: stream -> receipt time, on the clock that ``now`` is of.
            cameras: the streams that are needed besides the state.
            now: seconds.

        Returns:
            The age of its oldest stream, in seconds.

        Raises:
            BadTiming: a stamp is missing, not finite, too old, in the future, older than the one
                before it, or too far from the others.
        """
        ages: dict[str, float] = {}
        for stream in (STATE, *cameras):
            stamp = stamps.get(stream)
            if stamp is None or not is_number(stamp) or not math.isfinite(stamp):
                raise BadTiming(f"stream {stream} has no receipt stamp")
            age = now - stamp
            if age < -AHEAD_S:
                raise BadTiming(
                    f"stream {stream} is stamped {-age:.3f} s in the future",
                    cause="stamps must be receipt times on the operator's own clock",
                )
            before = self._newest.get(stream)
            if before is not None and stamp < before:
                raise BadTiming(f"stream {stream} went back in time by {before - stamp:.3f} s")
            if age > self.max_age_s:
                raise BadTiming(
                    f"stream {stream} is stale: its newest reading is {age:.2f} s old, "
                    f"safety.max_age_s is {self.max_age_s:g}",
                    cause="the camera or the driver froze, or the network lost it",
                )
            ages[stream] = age
        oldest, newest = max(ages, key=ages.__getitem__), min(ages, key=ages.__getitem__)
        skew = ages[oldest] - ages[newest]
        if skew > self.max_skew_s:
            raise BadTiming(
                f"streams {oldest} and {newest} are {skew:.2f} s apart, "
                f"safety.max_skew_s is {self.max_skew_s:g}",
                cause="one of them is delayed or slower than the other",
            )
        self._newest.update({stream: stamps[stream] for stream in ages})
        return ages[oldest]


def check_chunk(
    chunk: npt.ArrayLike,
    embodiment: EmbodimentSpec,
    rate_hz: float,
    settings: SafetySettings,
) -> Array:
    """Refuse a chunk that is no motion; what is merely too fast or too far is left to the limits.

    Whether the arm gets to its beginning is for ``check_beginning``.

    Args:
        chunk: ``(T, dim)`` keyframes from a policy.
        embodiment: whose joints they are for.
        rate_hz: keyframes a second.
        settings: ``jump_s`` and ``excess``.

    Returns:
        ``(T, dim)`` float64.

    Raises:
        BadChunk: another shape, empty, a value that is not finite, far beyond a position limit,
            or a jump that no motion explains.
    """
    try:
        found = np.asarray(chunk)
        if found.dtype.kind not in "fiu":
            raise TypeError(f"it is a {type(chunk).__name__} of {found.dtype}")
        keyframes = found.astype(np.float64, copy=False)
    except (TypeError, ValueError) as error:
        raise BadChunk(f"the policy's chunk is no array of numbers: {error}") from error
    dim = embodiment.dim
    if keyframes.ndim != 2 or keyframes.shape[1] != dim or len(keyframes) == 0:
        raise BadChunk(
            f"the policy's chunk has shape {keyframes.shape}; {embodiment.name} takes (T, {dim})"
        )
    names = embodiment.joint_names
    problem = not_finite(keyframes, names)
    if problem is not None:
        raise BadChunk(
            problem,
            cause="the policy diverged, or an input that it was given is not finite",
        )
    joints = embodiment.joints
    lower, upper = np.array([(j.lower, j.upper) for j in joints]).T
    allowed = np.array(
        [settings.excess * (GRIPPER_EXCESS if j.kind == "gripper" else 1.0) for j in joints]
    )
    excess = np.maximum(lower - keyframes, keyframes - upper) / (upper - lower) / allowed
    row, column = np.unravel_index(np.argmax(excess), excess.shape)
    if excess[row, column] > 1.0:
        joint = joints[column]
        raise BadChunk(
            f"keyframe {row} wants {joint.name} at {keyframes[row, column]:.4g}, far beyond its "
            f"limits [{joint.lower:.4g}, {joint.upper:.4g}] {joint.unit}",
            cause="the policy's units or statistics are not this robot's",
        )
    _check_jumps(np.clip(keyframes, lower, upper), 1, embodiment, rate_hz, settings)
    return keyframes


def check_beginning(
    keyframes: Array,
    embodiment: EmbodimentSpec,
    last: Array,
    rate_hz: float,
    settings: SafetySettings,
) -> None:
    """Refuse a chunk whose first keyframe is too far from where the arm is commanded to be.

    Args:
        keyframes: ``(T, dim)`` that ``check_chunk`` let through.
        embodiment: whose joints they are for.
        last: ``(dim,)`` the command that the arm has now.
        rate_hz: keyframes a second.
        settings: ``jump_s``.

    Raises:
        BadChunk: no motion explains the jump.
    """
    lower, upper = np.array([(j.lower, j.upper) for j in embodiment.joints]).T
    way = np.array([last, np.clip(keyframes[0], lower, upper)])
    _check_jumps(way, 0, embodiment, rate_hz, settings)


def _check_jumps(
    way: Array, first: int, embodiment: EmbodimentSpec, rate_hz: float, settings: SafetySettings
) -> None:
    """Of the points ``(N, dim)`` of a way, the second of which is keyframe ``first``."""
    moves = np.diff(way, axis=0)
    # Each keyframe has its own period to move in; jump_s comes on top.
    seconds = np.abs(moves) / np.array([j.velocity for j in embodiment.joints]) - 1.0 / rate_hz
    if not (seconds > settings.jump_s).any():
        return
    row, column = np.unravel_index(np.argmax(seconds), seconds.shape)
    raise BadChunk(
        f"keyframe {row + first} wants {embodiment.joint_names[column]} to jump by "
        f"{moves[row, column]:.4g}; at full speed that takes {seconds[row, column]:.2f} s more "
        "than there are",
        cause="the policy is not for the pose that the arm is in, or it diverged",
        next="move the arm to the start pose first; safety.jump_s sets what is allowed",
    )


def not_finite(chunk: Array, joints: Sequence[str]) -> str | None:
    """What of a policy's chunk ``(T, dim)`` is not finite, in words; None if all of it is."""
    bad = np.argwhere(~np.isfinite(chunk))
    if not bad.size:
        return None
    row, column = bad[0]
    value = chunk[row, column]
    return f"the policy's chunk is not finite: keyframe {row}, {joints[column]} is {value}"
