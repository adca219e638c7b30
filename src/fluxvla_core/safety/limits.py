r"""The last thing between a policy and a robot: position, velocity and acceleration limits.

``Limiter`` turns any finite sequence of wanted targets into commands that keep, joint by joint and
for every command ``p`` with its speed ``v = (p - p_before) / dt``:

    lower <= p <= upper        |v| <= V        |v - v_before| <= A dt

Clamping the position alone cannot do that: an arm that reaches its limit at speed would have to
stop within one period. So a command is admitted only if, braking as hard as ``A`` allows from then
on, the arm still comes to rest before the limit. Write ``a = A dt`` (the change of speed in one
period) and ``d = upper - p_before`` (the room left). Commanding speed ``v >= 0`` now, then
``v - a``, ``v - 2a``, … down to rest covers, with ``n = floor(v / a)``,

    S(v) = dt * sum_{i=0..n} (v - i a) = dt * ((n + 1) v - a n (n + 1) / 2).

``S`` is continuous, piecewise linear and strictly increasing, so ``S(v) <= d`` has the exact
solution ``v <= b(d)``: with ``n`` the largest integer for which ``dt a n (n + 1) / 2 <= d``,

    b(d) = (d / dt + a n (n + 1) / 2) / (n + 1).

The speed sent is the wanted one, clipped to ``[lo, hi]``:

    hi = min( V, v_before + a,  b(upper - p_before))
    lo = max(-V, v_before - a, -b(p_before - lower))

**Claim.** If the arm starts at rest within its limits, ``lo <= hi`` in every period, for whatever
is wanted. *Proof.* Call a state safe if ``p + S(v - a) <= upper`` for ``v > 0`` (and mirrored for
``v < 0``): full braking from now on stays inside. At rest within the limits is safe. In a safe
state with ``v > 0``, braking to ``w = max(v - a, 0)`` satisfies every bound: ``|w| <= V``, it is
within ``a`` of ``v``, ``S(w) <= upper - p`` is the definition of safe, and ``-b(...) <= 0 <= w``.
So the interval is not empty. And whatever speed ``v'`` in it is sent, ``S(v') <= upper - p``
gives ``p' + S(v' - a) = p + S(v') <= upper``: the next state is safe. Induction. ∎

With rounded numbers each period leaves ``S`` an error of the order of one unit in the last place
of ``p``, and over a long braking these would add up. So ``b`` reckons with a slightly smaller ``a``
than the one allowed: the difference takes up each period's rounding in the next.

Targets are tracked without overshoot as far as the limits allow: relative to the wanted motion
the same ``b`` bounds the closing speed, so a step is followed in the least time and a ramp without
lag.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fluxvla_core.errors import ConfigError
from fluxvla_core.safety.stops import BadCommand
from fluxvla_core.spec.embodiment import EmbodimentSpec

Array = npt.NDArray[np.float64]

# Limits are kept a millionth inside, so that whoever recomputes speeds from the positions that
# were sent finds them within the limits in spite of rounding.
MARGIN = 1e-6
# How far beyond a limit a joint may be measured at the start (encoder offset, backlash): a share
# of its range, at most this much in its own unit.
START_SHARE = 0.05
START_SLACK = 0.05
# A command that rounding alone keeps from what was wanted, in the joint's unit, is what was wanted.
SAME = 1e-13


@dataclass(frozen=True)
class Clamp:
    """One joint of one command that was not sent as wanted.

    ``reason`` is the first rule that the wanted value breaks: ``position`` (it lies beyond a
    limit), ``velocity`` (it is too far for one period), ``braking`` (going there, the arm could not
    stop before a limit) or ``acceleration``. Values are in the joint's unit.
    """

    joint: str
    wanted: float
    given: float
    reason: str


class Limiter:
    """Keeps commands within an embodiment's limits; see the module's text for what and why.

    Args:
        embodiment: whose joints limit.
        period: seconds from command to command.
        velocity_scale, acceleration_scale: share of the embodiment's limits to use, in (0, 1].

    Raises:
        ConfigError: a scale is out of (0, 1], or the embodiment takes deltas, not positions.
    """

    def __init__(
        self,
        embodiment: EmbodimentSpec,
        period: float,
        velocity_scale: float = 1.0,
        acceleration_scale: float = 1.0,
    ) -> None:
        if embodiment.action_mode != "absolute":
            raise ConfigError(
                f"{embodiment.name} takes {embodiment.action_mode} actions; "
                "limits can only be kept for absolute joint targets",
                next="give the operator absolute targets and let it form the deltas",
            )
        scales = {"velocity_scale": velocity_scale, "acceleration_scale": acceleration_scale}
        for name, scale in scales.items():
            if not 0 < scale <= 1:
                raise ConfigError(f"safety.{name} must be above 0 and at most 1, got {scale}")
        if not period > 0:
            raise ConfigError(f"the period between commands must be positive, got {period}")
        joints = embodiment.joints
        self.embodiment = embodiment
        self.period = period
        self.lower: Array = np.array([j.lower for j in joints])
        self.upper: Array = np.array([j.upper for j in joints])
        speeds = np.array([j.velocity for j in joints])
        self.velocity: Array = speeds * velocity_scale * (1 - MARGIN)
        steps = np.array([j.acceleration for j in joints]) * period
        self._step: Array = steps * acceleration_scale * (1 - MARGIN)
        self._planned: Array = self._step * (1 - MARGIN)
        self._last: Array | None = None
        self._speed: Array = np.zeros(len(joints))
        self._target: Array = np.zeros(len(joints))

    @property
    def last(self) -> Array:
        """``(D,)`` the last command (a copy), or where ``start`` found the arm."""
        if self._last is None:
            raise BadCommand("no command can be formed before the limiter was started")
        return self._last.copy()

    @property
    def started(self) -> bool:
        """Whether it knows where the arm is."""
        return self._last is not None

    @property
    def acceleration(self) -> Array:
        """``(D,)`` largest acceleration that a command may ask for."""
        return self._planned / self.period

    @property
    def at_rest(self) -> bool:
        """Whether the last two commands were the same."""
        return not self._speed.any()

    def start(self, measured: npt.ArrayLike) -> None:
        """Begin from where the arm is, at rest.

        Args:
            measured: ``(D,)`` position of every action joint.

        Raises:
            BadCommand: a joint is not finite, or further beyond its limits than backlash explains.
        """
        pose = self._checked(measured, "the measured pose")
        excess = np.maximum(self.lower - pose, pose - self.upper)
        slack = np.minimum(START_SHARE * (self.upper - self.lower), START_SLACK)
        for index in np.flatnonzero(excess > slack):
            joint = self.embodiment.joints[index]
            raise BadCommand(
                f"{joint.name} is at {pose[index]:.4g}, outside its limits "
                f"[{joint.lower:.4g}, {joint.upper:.4g}] {joint.unit}",
                cause="the joint was moved by hand, or its zero or unit is not what the spec says",
                next="bring the joint back within its limits, then start again",
            )
        self._last = np.clip(pose, self.lower, self.upper)
        self._speed = np.zeros_like(pose)
        self._target = self._last.copy()

    def step(self, wanted: npt.ArrayLike, speed: float = 1.0) -> tuple[Array, list[Clamp]]:
        """The next command, as near to ``wanted`` as the limits allow.

        Args:
            wanted: ``(D,)`` target, in the embodiment's units.
            speed: share of the velocity limit to use for this command, in (0, 1].

        Returns:
            ``(D,)`` command, and one ``Clamp`` for each joint that differs from ``wanted``.

        Raises:
            BadCommand: ``wanted`` has another shape or is not finite; nothing changes then.
        """
        before = self.last
        target = self._checked(wanted, "the command")
        reachable = np.clip(target, self.lower, self.upper)
        given, braked = self._advance(before, reachable, speed)
        clamps = self._clamps(before, target, reachable, given, braked)
        self._target = reachable
        self._speed = (given - before) / self.period
        self._last = given
        return given.copy(), clamps

    def snapshot(self) -> tuple[Array, Array, Array]:
        """What the next command depends on; for ``restore``."""
        return self.last, self._speed.copy(), self._target.copy()

    def restore(self, snapshot: tuple[Array, Array, Array]) -> None:
        """Go back to a ``snapshot``: what was formed since was never sent."""
        last, speed, target = snapshot
        self._last, self._speed, self._target = last.copy(), speed.copy(), target.copy()

    def run(self, wanted: npt.ArrayLike, speed: float = 1.0) -> tuple[Array, list[list[Clamp]]]:
        """``step`` for each row of ``(N, D)``; all rows are checked before the first is used."""
        rows = np.asarray(wanted, dtype=np.float64)
        for row in rows:
            self._checked(row, "the command")
        commands = np.empty_like(rows)
        clamps = []
        for index, row in enumerate(rows):
            commands[index], found = self.step(row, speed)
            clamps.append(found)
        return commands, clamps

    def brake(self) -> Array:
        """The next command of the shortest stop: ``(D,)``, closer to rest, then the same again."""
        before = self.last
        slower = np.sign(self._speed) * np.maximum(np.abs(self._speed) - self._planned, 0.0)
        # Creeping on by rounding alone would never count as rest.
        slower[np.abs(slower) < self._step * 1e-9] = 0.0
        given = np.clip(before + slower * self.period, self.lower, self.upper)
        self._speed = np.where(slower == 0.0, 0.0, (given - before) / self.period)
        self._target = self._last = given
        return given.copy()

    def _advance(
        self, before: Array, target: Array, speed: float
    ) -> tuple[Array, npt.NDArray[np.bool_]]:
        dt, step, planned = self.period, self._step, self._planned
        # Where the wanted motion is heading; a jump is no motion that could be followed.
        drift = (target - self._target) / dt
        drift = np.where(np.abs(drift) <= self.velocity, drift, 0.0)
        gap = target - before - drift * dt
        wish = drift + np.sign(gap) * braking_speed(np.abs(gap), planned, dt)
        # A smaller share of the speed than before is reached by braking, not at once.
        top = np.maximum(self.velocity * speed, np.abs(self._speed) - step)
        low = np.maximum(-top, self._speed - step)
        high = np.minimum(top, self._speed + step)
        floor = -braking_speed(before - self.lower, planned, dt)
        ceiling = braking_speed(self.upper - before, planned, dt)
        braked = (wish < floor) | (wish > ceiling)
        low, high = np.maximum(low, floor), np.minimum(high, ceiling)
        given = before + np.clip(wish, low, high) * dt
        # Rounding alone could put a command beyond its limit; this moves it by that much at most.
        given = np.clip(given, self.lower, self.upper)
        # An unhindered command passes unchanged, to the last bit, where that too is admitted.
        direct = (target - before) / dt
        exact = (np.abs(given - target) <= SAME) & (low <= direct) & (direct <= high)
        return np.where(exact, target, given), braked

    def _clamps(
        self,
        before: Array,
        target: Array,
        reachable: Array,
        given: Array,
        braked: npt.NDArray[np.bool_],
    ) -> list[Clamp]:
        found = []
        for index in np.flatnonzero(np.abs(given - target) > SAME):
            pace = abs(reachable[index] - before[index]) / self.period
            if target[index] != reachable[index]:
                reason = "position"
            elif pace > self.velocity[index]:
                reason = "velocity"
            elif braked[index]:
                reason = "braking"
            else:
                reason = "acceleration"
            name = self.embodiment.joints[index].name
            found.append(Clamp(name, float(target[index]), float(given[index]), reason))
        return found

    def _checked(self, values: npt.ArrayLike, what: str) -> Array:
        array = np.asarray(values, dtype=np.float64)
        names = self.embodiment.joint_names
        if array.shape != (len(names),):
            raise BadCommand(
                f"{what} has shape {array.shape}; {self.embodiment.name} takes ({len(names)},)"
            )
        bad = [name for name, ok in zip(names, np.isfinite(array), strict=True) if not ok]
        if bad:
            raise BadCommand(f"{what} is not finite for {', '.join(bad)}")
        return array


def braking_speed(room: Array, step: Array, period: float) -> Array:
    """The largest speed to command now from which the arm still stops within ``room``: ``b(d)``.

    Args:
        room: ``(D,)`` distance left, in the joints' units; below 0 counts as 0.
        step: ``(D,)`` largest change of speed in one period.
        period: seconds from command to command.

    Returns:
        ``(D,)`` speeds, 0 where there is no room.
    """
    reach = np.maximum(room, 0.0) / period
    steps = np.floor((np.sqrt(1.0 + 8.0 * reach / step) - 1.0) / 2.0)
    speed: Array = (reach + step * steps * (steps + 1.0) / 2.0) / (steps + 1.0)
    return speed


def count_clamps(rows: Sequence[Sequence[Clamp]]) -> dict[str, dict[str, int]]:
    """joint -> reason -> how many commands."""
    counts: dict[str, dict[str, int]] = {}
    for row in rows:
        for clamp in row:
            reasons = counts.setdefault(clamp.joint, {})
            reasons[clamp.reason] = reasons.get(clamp.reason, 0) + 1
    return counts
