"""From a policy's keyframes to the commands of a robot that runs faster: linear in time.

A policy's chunk holds targets at ``rate_hz`` (10 Hz is common), a robot takes commands at
``control_hz`` (50 Hz for ALOHA). Keyframe ``j`` is to be reached ``(j + 1) / rate_hz`` seconds
after the observation; before it, the arm is where ``previous`` says.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def interpolate(
    previous: npt.ArrayLike, chunk: npt.ArrayLike, rate_hz: float, control_hz: float
) -> Array:
    """Commands at ``control_hz`` along straight lines from ``previous`` through all keyframes.

    Args:
        previous: ``(D,)`` where the arm is commanded to be at the observation.
        chunk: ``(T, D)`` targets, one every ``1 / rate_hz`` seconds.
        rate_hz: keyframes a second.
        control_hz: commands a second.

    Returns:
        ``(N, D)`` float64; command ``k`` is for ``(k + 1) / control_hz`` seconds after the
        observation, and ``N = floor(T * control_hz / rate_hz)``, at least 1 when ``T`` is.

    Raises:
        ValueError: shapes do not fit, or a rate is not positive.
    """
    keyframes = np.asarray(chunk, dtype=np.float64)
    if rate_hz <= 0 or control_hz <= 0:
        raise ValueError(f"rates must be positive, got {rate_hz} Hz and {control_hz} Hz")
    if keyframes.ndim != 2:
        raise ValueError(f"a chunk has shape (T, D), got {keyframes.shape}")
    # The small term keeps 3 keyframes at 10 Hz from becoming 14 commands at 50 Hz.
    count = int(np.floor(len(keyframes) * control_hz / rate_hz + 1e-6))
    count = max(count, min(len(keyframes), 1))
    return sample(previous, keyframes, rate_hz, (np.arange(count) + 1.0) / control_hz)


def sample(
    previous: npt.ArrayLike, chunk: npt.ArrayLike, rate_hz: float, elapsed: npt.ArrayLike
) -> Array:
    """Where the lines through ``previous`` and the keyframes are after ``elapsed`` seconds.

    Before 0 it is ``previous``, after the last keyframe the last keyframe.

    Args:
        previous: ``(D,)``.
        chunk: ``(T, D)``.
        rate_hz: keyframes a second.
        elapsed: ``(N,)`` seconds since the observation.

    Returns:
        ``(N, D)`` float64.

    Raises:
        ValueError: shapes do not fit.
    """
    start = np.asarray(previous, dtype=np.float64)
    keyframes = np.asarray(chunk, dtype=np.float64)
    if start.ndim != 1 or keyframes.ndim != 2 or keyframes.shape[1] != start.shape[0]:
        raise ValueError(
            f"previous of shape (D,) and chunk of shape (T, D) are needed, "
            f"got {start.shape} and {keyframes.shape}"
        )
    knots = np.concatenate([start[None], keyframes])
    position = np.clip(np.asarray(elapsed, dtype=np.float64) * rate_hz, 0.0, len(keyframes))
    before = np.minimum(position.astype(np.int64), max(len(keyframes) - 1, 0))
    share = (position - before)[:, None]
    after = np.minimum(before + 1, len(keyframes))
    points: Array = knots[before] * (1.0 - share) + knots[after] * share
    return points
