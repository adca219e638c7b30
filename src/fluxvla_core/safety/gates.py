"""What a reading must be before a policy may act on it: complete, well formed, fresh, together."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from fluxvla_core.contracts.frame import STATE, Frame
from fluxvla_core.safety.stops import BadFrame, BadTiming
from fluxvla_core.spec.embodiment import EmbodimentSpec

# A stamp may be this far in the future: the reading was taken while its age was computed.
AHEAD_S = 0.005


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
    names = embodiment.state_names
    state = np.asarray(frame.state)
    if state.shape != (len(names),):
        raise BadFrame(
            f"the robot's state has shape {state.shape}; {embodiment.name} has ({len(names)},)"
        )
    bad = [name for name, ok in zip(names, np.isfinite(state), strict=True) if not ok]
    if bad:
        raise BadFrame(f"the robot's state is not finite for {', '.join(bad)}")
    sizes = {camera.name: (camera.height, camera.width, 3) for camera in embodiment.cameras}
    for name in cameras:
        image = frame.images.get(name)
        if image is None:
            raise BadFrame(
                f"camera {name} gave no picture", cause="it is not connected, or has another name"
            )
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
            if stamp is None or not np.isfinite(stamp):
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
