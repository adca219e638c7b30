r"""Limited jerk: the mean of the last few commands that keep velocity and acceleration limits.

Let ``u`` be commands, one each ``dt``, that keep a joint's limits: ``lower <= u <= upper``, the
speed ``(u - u_before) / dt`` within ``V``, its change within ``A dt``. Sent is the mean of the last
``N`` of them, ``p_k = (u_k + ... + u_{k-N+1}) / N``.

**Claim.** ``p`` keeps the same limits, and its jerk is at most ``2 A / (N dt)``. *Proof.* Position,
speed and acceleration of ``p`` are the means of those of ``N`` commands ``u``, and a mean of
numbers of an interval is in it. From one period to the next, the mean of the accelerations gains
the newest and loses the oldest of them: it changes by ``(a_k - a_{k-N}) / N``, at most ``2 A / N``;
over ``dt`` that is the jerk. ∎

**Braking.** As ``u`` comes to rest within its limits from wherever it is (``limits`` proves
it) and then stays, ``N - 1`` periods later ``p`` is the mean of ``N`` equal numbers: it is at rest
in the same place. On the way there the claim holds for every ``p``. So braking never needs room
that there is not, and the limits of position, velocity, acceleration and jerk are all kept.

``N = ceil(2 A / (J dt))`` keeps ``J``; a joint for which that is 1 is not touched. The price is
time: ``p`` follows ``u`` ``(N - 1) / 2`` periods late, about ``A / J``. From rest to rest over a
long way the least time is ``A / J`` longer with limited jerk than without; here it is twice that,
because ``u`` may turn from ``A`` to ``-A`` at once.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from fluxvla_core.errors import ConfigError
from fluxvla_core.spec import Joint

Array = npt.NDArray[np.float64]
# Commands that come later than this are no use to a policy that looks at what they did.
_LONGEST_S = 1.0


class Smoothing:
    """The last positions of every joint, as many as its jerk limit needs, and their mean.

    Args:
        joints: in the order of the commands.
        acceleration: ``(D,)`` that the positions keep.
        period: seconds from command to command.

    Raises:
        ConfigError: a joint would have to be smoothed over more than a second.
    """

    def __init__(self, joints: Sequence[Joint], acceleration: Array, period: float) -> None:
        counts = [
            1 if j.jerk is None else max(int(np.ceil(2.0 * a / (j.jerk * period))), 1)
            for j, a in zip(joints, acceleration, strict=True)
        ]
        for joint, count in zip(joints, counts, strict=True):
            if count * period > max(_LONGEST_S, 2.0 * period):
                raise ConfigError(
                    f"{joint.name}: a jerk of at most {joint.jerk:g} {joint.unit}/s^3 takes "
                    f"{count * period:.3g} s to turn from one acceleration to the other",
                    cause="the limit is far below the acceleration limit of "
                    f"{joint.acceleration:g} {joint.unit}/s^2",
                    next="look at its unit, or lower safety.acceleration_scale",
                )
        self.length = max(counts, default=1)
        self._counts: Array = np.array(counts, dtype=np.float64)
        inside = np.arange(self.length)[:, None] < self._counts
        self._weights: Array = inside / self._counts
        # Newest first, ``(length, D)``.
        self._rows: Array = np.zeros((self.length, len(counts)))

    def start(self, pose: Array, step: Array) -> Array:
        """Be at the mean ``(D,)`` pose, after a steady motion of ``(D,)`` step a period.

        Returns:
            ``(D,)`` the newest position: the mean is late where there was motion.
        """
        newest: Array = pose + step * (self._counts - 1.0) / 2.0
        self._rows = newest - step * np.arange(self.length)[:, None]
        return newest

    def halt(self, joints: npt.NDArray[np.bool_], pose: Array) -> None:
        """Reset the marked joints: they have rested at the ``(D,)`` pose."""
        self._rows = np.where(joints, pose, self._rows)

    def add(self, newest: Array) -> Array:
        """``(D,)`` the mean with the newest position in it."""
        if self.length == 1:
            self._rows = newest[None]
            return newest
        self._rows = np.vstack([newest, self._rows[:-1]])
        # From the newest on: where all are equal, the mean is that number to the last bit.
        mean: Array = newest + (self._weights * (self._rows - newest)).sum(axis=0)
        return mean

    @property
    def at_rest(self) -> bool:
        """Whether all positions that count are the same."""
        return not (self._weights * (self._rows - self._rows[0])).any()

    def snapshot(self) -> Array:
        """The state that the next command depends on; for ``restore``."""
        return self._rows.copy()

    def restore(self, rows: Array) -> None:
        """Go back to a ``snapshot``."""
        self._rows = rows.copy()
