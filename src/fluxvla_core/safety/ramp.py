"""A straight way to a pose, slow and within limits: how every episode gets to its start."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fluxvla_core.errors import ConfigError
from fluxvla_core.safety.limits import Limiter
from fluxvla_core.spec.embodiment import EmbodimentSpec, Joint

Array = npt.NDArray[np.float64]


def ramp(limiter: Limiter, pose: npt.ArrayLike, speed: float) -> Array:
    """Targets from where the limiter is to ``pose``: all joints set off and arrive together.

    The way is a straight line in joint space, so that it is the same every time. The share of it
    that is done is driven like a joint of its own, from 0 to 1, with the speed and acceleration
    that the joint with the longest way allows; every joint then keeps its limits.

    Args:
        limiter: started and at rest; it is not changed.
        pose: ``(D,)`` within the position limits.
        speed: share of the velocity limits, in (0, 1].

    Returns:
        ``(N, D)`` targets, the last one ``pose``; ``N`` is 0 when the arm is there.

    Raises:
        ConfigError: the pose has another shape, is not finite, or is beyond a position limit.
    """
    target = check_pose(pose, limiter.embodiment)
    start = limiter.last
    way = target - start
    moving = way != 0.0
    if not moving.any():
        return np.empty((0, len(way)))
    distance = np.abs(way[moving])
    pace = float(np.min(limiter.velocity[moving] * speed / distance))
    push = float(np.min(limiter.acceleration[moving] / distance))
    share = Joint("share", "normalized", 0.0, 1.0, pace, push)
    driver = Limiter(EmbodimentSpec("way", (share,), (), 1.0 / limiter.period), limiter.period)
    driver.start([0.0])
    rows = []
    done = 0.0
    while done < 1.0:
        done = float(driver.step([1.0])[0][0])
        rows.append(target if done == 1.0 else start + way * done)
    return np.array(rows)


def check_pose(pose: npt.ArrayLike, embodiment: EmbodimentSpec) -> Array:
    """``pose`` as ``(dim,)`` float64.

    Raises:
        ConfigError: another shape, not finite, or beyond a position limit.
    """
    target = np.asarray(pose, dtype=np.float64)
    names = embodiment.joint_names
    if target.shape != (len(names),):
        raise ConfigError(
            f"prepare_pose has {target.size} values, {embodiment.name} has {len(names)} joints: "
            f"{', '.join(names)}"
        )
    for joint, value in zip(embodiment.joints, target, strict=True):
        if not joint.lower <= value <= joint.upper:
            raise ConfigError(
                f"prepare_pose puts {joint.name} at {value:g}, outside its limits "
                f"[{joint.lower:.4g}, {joint.upper:.4g}] {joint.unit}"
            )
    return target
