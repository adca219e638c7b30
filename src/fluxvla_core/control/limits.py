r"""Limits of commands, applied last: position, velocity, acceleration (``smoothing``: jerk).

``CommandLimiter`` turns any finite sequence of wanted targets into commands that keep, joint by
joint and for every command ``p`` with its speed ``v = (p - p_before) / dt``:

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

A joint that is commanded by its speed (kind ``velocity``: a mobile base) goes through the same
steps one derivative up: its command ``p`` is the speed, kept within ``lower`` and ``upper``, and
``|p - p_before| <= A dt``. Nothing limits the change of that but ``jerk``, so that the speed is
reached and left at full acceleration. What brakes an arm brings such a joint to 0: there it rests,
and nowhere else.

Joints that state a ``jerk`` limit ``J`` are smoothed after that: what is sent is the mean of the
last ``N`` such commands, which also keeps ``|a - a_before| <= J dt``; ``smoothing`` proves
it, and that such an arm comes to rest within all limits too. A motion that keeps the limits is sent
``(N - 1) / 2`` periods late then.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fluxvla_core.control.safety import BadCommand
from fluxvla_core.control.smoothing import Smoothing
from fluxvla_core.errors import ConfigError
from fluxvla_core.spec import EmbodimentSpec

Array = npt.NDArray[np.float64]

# Limits are kept a millionth inside, so that a robot that recomputes speeds from the positions that
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
    stop before a limit), ``acceleration``, or ``jerk``. Values are in the joint's unit.
    """

    joint: str
    wanted: float
    given: float
    reason: str


class CommandLimiter:
    """Keeps commands within an embodiment's limits; see the module's text for what and why.

    Args:
        embodiment: gives the limits of its joints.
        period: seconds from command to command.
        velocity_scale, acceleration_scale: share of the embodiment's limits to use, in (0, 1].

    Raises:
        ConfigError: a scale is out of (0, 1], the embodiment takes deltas, not positions, or a
            jerk limit is so small that commands would come more than a second late.
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
        # Joints whose command is a speed; what is called speed below is its change then.
        self._by_speed = np.array([j.by_speed for j in joints])
        shares = np.where(self._by_speed, velocity_scale, 1.0)
        self.lower: Array = np.array([j.lower for j in joints]) * shares
        self.upper: Array = np.array([j.upper for j in joints]) * shares
        rates = np.array([j.slew_rate for j in joints]) * (1 - MARGIN)
        self.velocity: Array = rates * np.where(self._by_speed, acceleration_scale, velocity_scale)
        steps = np.array([j.acceleration for j in joints]) * period
        steps = steps * acceleration_scale * (1 - MARGIN)
        self._smoothing = Smoothing(joints, steps / period, period)
        # From full acceleration to full deceleration in one period.
        self._step: Array = np.where(self._by_speed, 2.0 * self.velocity, steps)
        self._planned: Array = self._step * (1 - MARGIN)
        # The last command, and what it is the mean of: the last position before smoothing.
        self._last: Array | None = None
        self._raw: Array = np.zeros(len(joints))
        self._speed: Array = np.zeros(len(joints))
        self._target: Array = np.zeros(len(joints))

    @property
    def last(self) -> Array:
        """``(D,)`` the last command (a copy), or where ``start`` found the arm."""
        self._started()
        assert self._last is not None
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
    def longest_stop(self) -> int:
        """How many commands braking takes, at most."""
        ways = np.where(
            self._by_speed,
            np.maximum(-self.lower, self.upper) / self.velocity,
            self.velocity / self.acceleration,
        )
        return int(np.max(ways) / self.period) + 2 + self._smoothing.length

    @property
    def at_rest(self) -> bool:
        """Whether the last two commands were the same, and so will be those of braking."""
        return not self._moving and self._smoothing.at_rest

    def start(self, measured: npt.ArrayLike) -> None:
        """Begin from where the arm is, at rest.

        Args:
            measured: ``(D,)`` position of every action joint, speed of those commanded by it.

        Raises:
            BadCommand: a joint is not finite, or further beyond its limits than backlash explains;
                or a mobile base is rolling.
        """
        pose = self._checked(measured, "the measured pose")
        self._refuse_rolling(pose)
        pose = np.where(self._by_speed, 0.0, pose)
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
        self._begin(np.clip(pose, self.lower, self.upper), np.zeros_like(pose))

    def resume(self, last: npt.ArrayLike, before: npt.ArrayLike, seconds: float) -> None:
        """Continue from commands that were sent already.

        Args:
            last: ``(D,)`` the last command, within the position limits.
            before: ``(D,)`` the one before it.
            seconds: how long before it.
        """
        pose = self._checked(last, "the last command")
        speed = (pose - self._checked(before, "the command before the last")) / seconds
        self._begin(pose, np.clip(speed, -self.velocity, self.velocity))

    def halt(self, joints: npt.NDArray[np.bool_]) -> None:
        """Bring the ``(D,)`` joints that are marked to rest at their last command, at once.

        For joints that do not obey: to brake one that is blocked would be to push on.
        """
        joints = joints & ~self._by_speed
        self._raw = np.where(joints, self.last, self._raw)
        self._target = np.where(joints, self.last, self._target)
        self._speed = np.where(joints, 0.0, self._speed)
        self._smoothing.halt(joints, self.last)

    def rest(self) -> Array:
        """``(D,)`` where the arm comes to rest if it brakes now."""
        now = self.snapshot()
        while self._moving:
            self.brake()
        pose = self._raw.copy()
        self.restore(now)
        return pose

    def settle(self, goal: Array, speed: float = 1.0) -> Array:
        """``(D,)`` the next command on the way to rest at ``goal``; ``speed`` as ``step`` has it.

        ``step`` follows a motion; here ``goal`` is none, however far from the last target it is.
        Joints that are commanded by their speed go to 0.
        """
        self._target = np.where(self._by_speed, 0.0, np.clip(goal, self.lower, self.upper))
        return self.step(self._target, speed)[0]

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
        target = self._checked(wanted, "the command")
        self._started()
        before = self._raw
        # The share is of a speed, also where that is the command.
        share = np.where(self._by_speed, speed, 1.0)
        reachable = np.clip(target, self.lower * share, self.upper * share)
        raw, braked = self._advance(before, reachable, speed)
        self._target = reachable
        self._speed = (raw - before) / self.period
        given = self._smoothed(raw)
        return given.copy(), self._clamps(before, target, reachable, raw, given, braked)

    def snapshot(self) -> tuple[Array, ...]:
        """The state that the next command depends on; for ``restore``."""
        smoothing = self._smoothing.snapshot()
        return self.last, self._raw.copy(), self._speed.copy(), self._target.copy(), smoothing

    def restore(self, snapshot: tuple[Array, ...]) -> None:
        """Go back to a ``snapshot``: what was formed since was never sent."""
        last, raw, speed, target, smoothing = (each.copy() for each in snapshot)
        self._last, self._raw, self._speed, self._target = last, raw, speed, target
        self._smoothing.restore(smoothing)

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
        self._started()
        before = self._raw
        slower = np.sign(self._speed) * np.maximum(np.abs(self._speed) - self._planned, 0.0)
        # Creeping on by rounding alone would never count as rest.
        slower[np.abs(slower) < self._step * 1e-9] = 0.0
        raw = np.clip(before + slower * self.period, self.lower, self.upper)
        self._speed = np.where(slower == 0.0, 0.0, (raw - before) / self.period)
        left = np.maximum(np.abs(before) - self.velocity * self.period, 0.0)
        raw = np.where(self._by_speed, np.sign(before) * left, raw)
        self._speed = np.where(self._by_speed, (raw - before) / self.period, self._speed)
        self._target = raw
        return self._smoothed(raw).copy()

    @property
    def _moving(self) -> bool:
        """Whether what is smoothed is not at rest."""
        return bool(self._speed.any() or self._raw[self._by_speed].any())

    def _refuse_rolling(self, pose: Array) -> None:
        rolling = self._by_speed & (np.abs(pose) > START_SHARE * (self.upper - self.lower))
        for index in np.flatnonzero(rolling):
            joint = self.embodiment.joints[index]
            raise BadCommand(
                f"{joint.name} moves at {pose[index]:.4g} {joint.unit}; an episode begins at rest",
                cause="somebody drives the base, or it rolls by itself",
                next="bring it to rest, then start again",
            )

    def _begin(self, pose: Array, speed: Array) -> None:
        """Be at ``(D,)`` pose, at a speed that was steady."""
        self._raw = np.clip(
            self._smoothing.start(pose, speed * self.period), self.lower, self.upper
        )
        self._speed, self._target, self._last = speed, self._raw.copy(), pose.copy()

    def _started(self) -> None:
        if self._last is None:
            raise BadCommand("no command can be formed before the limiter was started")

    def _smoothed(self, raw: Array) -> Array:
        self._raw = raw
        # A mean is between what it is made of; rounding alone could put it beyond.
        self._last = np.clip(self._smoothing.add(raw), self.lower, self.upper)
        return self._last

    def _advance(
        self, before: Array, target: Array, speed: float
    ) -> tuple[Array, npt.NDArray[np.bool_]]:
        dt, step, planned = self.period, self._step, self._planned
        # Where the wanted motion is heading; a jump is no motion that could be followed. One at
        # full speed is, also where rounding puts it beyond.
        drift = (target - self._target) / dt
        drift = np.where(np.abs(drift) <= self.velocity * (1 + MARGIN), drift, 0.0)
        gap = target - before - drift * dt
        wish = drift + np.sign(gap) * braking_speed(np.abs(gap), planned, dt)
        # A smaller share of the speed than before is reached by braking, not at once.
        share = np.where(self._by_speed, 1.0, speed)
        top = np.maximum(self.velocity * share, np.abs(self._speed) - step)
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
        raw: Array,
        given: Array,
        braked: npt.NDArray[np.bool_],
    ) -> list[Clamp]:
        found = []
        for index in np.flatnonzero(np.abs(given - target) > SAME):
            pace = abs(reachable[index] - before[index]) / self.period
            if self._by_speed[index]:
                reason = "velocity" if target[index] != reachable[index] else "acceleration"
                if target[index] == reachable[index] and abs(raw[index] - target[index]) <= SAME:
                    reason = "jerk"
            elif target[index] != reachable[index]:
                reason = "position"
            elif abs(raw[index] - target[index]) <= SAME:
                reason = "jerk"
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
        finite = np.isfinite(array)
        if not finite.all():
            bad = [name for name, ok in zip(names, finite, strict=True) if not ok]
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
