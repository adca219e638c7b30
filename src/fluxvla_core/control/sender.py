"""The one path from a target to a command that is sent: filters, limits, latch, control tick.

``CommandPipeline`` forms commands, for a robot and for a stepped environment alike;
``CommandSender`` sends them on a robot at its control rate. What sends each one may be a runner's
own loop around ``rate.sleep()``: ``CommandRate`` is the rate that it is given.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.robot import Clock
from fluxvla_core.control.clock import Rate
from fluxvla_core.control.limits import Clamp, CommandLimiter
from fluxvla_core.control.safety import BadCommand, Latch
from fluxvla_core.control.tracking import TrackingWatch
from fluxvla_core.errors import ConfigError
from fluxvla_core.spec import EmbodimentSpec, Joint

Array = npt.NDArray[np.float64]
Filter = Callable[[Array], Array]
ExecuteActions = Callable[[Array, Rate], None]
"""Sends ``(N, D)`` commands, one at each tick of the rate: a runner's ``_execute_actions``."""
OnSent = Callable[["SentCommand | None", float, float], None]
# How long an arm is led to where it is held, at most. No arm's limits are as low as that.
_LEAD_S = 3.0
_THERE = 1e-9  # from a pose that is moved to, in the joints' units


@dataclass(frozen=True)
class SentCommand:
    """One command that was sent: the planned ``(D,)`` target and the command made of it.

    ``held``: there was no target, so the arm brakes or stays.
    """

    target: Array
    command: Array
    clamps: tuple[Clamp, ...]
    held: bool = False


class PassThrough:
    """No limits, for actions that are no joint targets: commands are the targets.

    What such an environment does with a value beyond its limits is up to it; it is recorded.

    Args:
        embodiment: gives the limits that the values are compared with.
    """

    def __init__(self, embodiment: EmbodimentSpec) -> None:
        self.embodiment = embodiment
        self._lower: Array = np.array([joint.lower for joint in embodiment.joints])
        self._upper: Array = np.array([joint.upper for joint in embodiment.joints])

    def run(self, wanted: npt.ArrayLike, speed: float = 1.0) -> tuple[Array, list[list[Clamp]]]:
        """``(N, D)`` targets as they are, and a ``Clamp`` for each value beyond its limits."""
        rows = np.asarray(wanted, dtype=np.float64)
        slack = 1e-6 * (self._upper - self._lower)
        beyond = (rows > self._upper + slack) | (rows < self._lower - slack)
        return rows, [self._noted(row, found) for row, found in zip(rows, beyond, strict=True)]

    def _noted(self, row: Array, beyond: npt.NDArray[np.bool_]) -> list[Clamp]:
        names = self.embodiment.joint_names
        values = [(names[index], float(row[index])) for index in np.flatnonzero(beyond)]
        return [Clamp(name, value, value, "position") for name, value in values]


class CommandPipeline:
    """Makes commands of targets: action filters in their order, then the limits, always last.

    Args:
        limiter: the robot's limits, or ``PassThrough`` where actions are no joint targets.
        filters: ``(D,)`` -> ``(D,)`` callables; what a config's ``action_filters`` named.
    """

    def __init__(
        self, limiter: CommandLimiter | PassThrough, filters: Sequence[Filter] = ()
    ) -> None:
        self._limiter = limiter
        self._filters = tuple(filters)

    def form(self, targets: npt.ArrayLike, speed: float = 1.0) -> tuple[Array, list[list[Clamp]]]:
        """``(N, D)`` commands of ``(N, D)`` targets, and what of each was clamped.

        Raises:
            BadCommand: a target is not finite or of another shape.
        """
        return self.limited(self.filtered(targets), speed)

    def filtered(self, targets: npt.ArrayLike) -> Array:
        """``(N, D)`` targets after the filters.

        Raises:
            BadCommand: a filter made an action of another shape.
        """
        return np.array([self._filter(row) for row in np.asarray(targets, dtype=np.float64)])

    def limited(
        self, targets: npt.ArrayLike, speed: float = 1.0
    ) -> tuple[Array, list[list[Clamp]]]:
        """``(N, D)`` filtered targets within the limits; ``speed`` as ``CommandLimiter`` has it."""
        return self._limiter.run(targets, speed)

    def _filter(self, row: Array) -> Array:
        embodiment = self._limiter.embodiment
        for apply in self._filters:
            row = np.asarray(apply(row.copy()), dtype=np.float64)
            if row.shape != (embodiment.dim,):
                raise BadCommand(
                    f"action filter {type(apply).__name__} made an action of shape {row.shape}; "
                    f"{embodiment.name} takes ({embodiment.dim},)"
                )
        return row


class CommandRate(Rate):
    """A rate whose ``sleep()`` also reports the tick, so that any loop around it is supervised.

    Args:
        hz, clock, lead_s: as ``Rate`` has them.
        on_tick: called after each wait; what it raises leaves ``sleep()``.
    """

    def __init__(self, hz: float, clock: Clock, lead_s: float, on_tick: Callable[[], None]) -> None:
        super().__init__(hz, clock, lead_s)
        self._on_tick = on_tick

    def sleep(self) -> float:
        late = super().sleep()
        self._on_tick()
        return late


class CommandSender:
    """Sends commands for targets to a robot; only an operator's ``stop`` does so, too.

    A ``CommandPipeline`` makes commands of targets. They are handed to ``execute_actions``, which
    sends each and waits with ``rate.sleep()``; at that tick ``on_sent`` is called with the
    command.

    Args:
        execute_actions: called with ``(N, D)`` commands and ``rate``.
        rate_hz: commands a second.
        clock: the robot's.
        limiter: started before anything is sent.
        latch: while it is tripped only ``brake``, ``send_hold`` and ``rest_at`` send.
        filters: ``(D,)`` -> ``(D,)`` callables; what a config's ``action_filters`` named.
        on_sent: called at each tick with what was sent (None for a tick without a command), when
            the arm had it at the latest (of commands that a loop without ticks sends, when it had
            the first), and how late the tick was, in seconds.
        speed: tells, before each command, the share of the velocity limits that it may use, in
            (0, 1]: a robot that a person slowed down. None where there is no such thing.
        one_by_one: make each command when its turn comes, and hand it over alone: filters
            that take long then make no command late but their own.
        lead_s: how long before its deadline a command is made ready, as ``Rate`` has it.
    """

    def __init__(
        self,
        execute_actions: ExecuteActions,
        rate_hz: float,
        clock: Clock,
        limiter: CommandLimiter,
        latch: Latch,
        filters: Sequence[Filter] = (),
        on_sent: OnSent | None = None,
        speed: Callable[[], float] | None = None,
        one_by_one: bool = False,
        lead_s: float = 0.0,
    ) -> None:
        self.rate = CommandRate(rate_hz, clock, lead_s, self._report_sent)
        self.limiter = limiter
        self.latch = latch
        self._execute_actions = execute_actions
        self._pipeline = CommandPipeline(limiter, filters)
        self._on_sent = on_sent or (lambda sent, sent_at, late_s: None)
        self._speed = speed
        self._one_by_one = one_by_one or speed is not None
        self._rows: deque[SentCommand] = deque()
        # Commands of a call that were sent, the one that is being sent among them.
        self._sent_count = 0

    def send_targets(
        self, targets: npt.ArrayLike, filtered: bool = True, most: float = 1.0
    ) -> None:
        """Send one command for each row of ``(N, D)`` targets.

        Args:
            targets: the positions to go to.
            filtered: through the filters.
            most: share of the velocity limits, in (0, 1], that no command goes beyond, however much
                the robot allows.

        Raises:
            SafetyStop: the latch is tripped, or a target is not finite or of another shape.
        """
        self.latch.check()
        wanted = np.asarray(targets, dtype=np.float64)
        count = 1 if self._one_by_one else max(len(wanted), 1)
        for row in range(0, len(wanted), count):
            rows = wanted[row : row + count]
            shaped = self._pipeline.filtered(rows) if filtered else rows
            share = most if self._speed is None else min(self._speed(), most)
            self._send_limited(rows, shaped, share)

    def _send_limited(self, wanted: Array, shaped: Array, speed: float) -> None:
        before = self.limiter.snapshot()
        self._sent_count = 0
        try:
            commands, clamps = self._pipeline.limited(shaped, speed)
            self._send(wanted, commands, clamps)
        finally:
            self._rows.clear()
            if self._sent_count < len(shaped):
                self.limiter.restore(before)
                self.limiter.run(shaped[: self._sent_count], speed)

    def move_along(self, way: Array, most: float) -> None:
        """Move along ``(N, D)`` targets, past the filters, and arrive at the last of them.

        Args:
            way: within the position limits; of ``ramp``.
            most: share of the velocity limits, in (0, 1], that no command goes beyond.

        Raises:
            SafetyStop: the latch is tripped.
        """
        self.send_targets(way, filtered=False, most=most)
        # An arm that a person slowed down is not there yet; let go, it does not make up for it.
        while len(way) and np.abs(self.limiter.last - way[-1]).max() > _THERE:
            self.send_targets(way[-1:], filtered=False, most=most)

    def hold(self) -> None:
        """Send one command of the shortest stop, or the last command again when at rest."""
        self.latch.check()
        self.send_hold()

    def brake(self) -> None:
        """Come to rest; also while the latch is tripped."""
        for _ in range(self.limiter.longest_stop):
            if self.limiter.at_rest:
                return
            self.send_hold()

    def send_hold(self) -> None:
        """Send one command as :meth:`hold` does; also while the latch is tripped."""
        before = self.limiter.last
        self._send(before[None], self.limiter.brake()[None], [[]], held=True)

    def rest_at(self, goal: Array, most: int) -> None:
        """Come to rest at the ``(D,)`` goal, or where the limits let it; also while tripped.

        Args:
            goal: the position to go to.
            most: commands after which the arm brakes, wherever it is.
        """
        reachable = np.clip(goal, self.limiter.lower, self.limiter.upper)
        share = 1.0 if self._speed is None else self._speed()
        for _ in range(most):
            if self.limiter.at_rest and bool((self.limiter.last == reachable).all()):
                return
            command = self.limiter.settle(reachable, share)
            self._send(reachable[None], command[None], [[]], held=True)
        self.brake()

    def _send(
        self,
        wanted: Array,
        commands: Array,
        clamps: Sequence[Sequence[Clamp]],
        held: bool = False,
    ) -> None:
        rows = zip(wanted, commands, clamps, strict=True)
        self._rows = deque(SentCommand(t, c, tuple(found), held) for t, c, found in rows)
        handed = commands.copy()
        handed.flags.writeable = False
        ticks, sent_at = self.rate.ticks, self.rate.clock.now()
        self._sent_count = 1
        self._execute_actions(handed, self.rate)
        if self.rate.ticks == ticks:
            # A loop with ticks of its own: what it was given, it has sent.
            self._sent_count = len(commands)
            while self._rows:
                self._on_sent(self._rows.popleft(), sent_at, self.rate.late_s)
        self._sent_count = len(commands) - len(self._rows)

    def _report_sent(self) -> None:
        rate, sent = self.rate, self._rows.popleft() if self._rows else None
        self._on_sent(sent, rate.clock.now(), rate.late_s)
        self._sent_count += 1


def come_to_rest(
    sender: CommandSender,
    tracking: TrackingWatch,
    state: Callable[[], Array | None],
    blocked: bool,
    patience_s: float,
) -> None:
    """Brake, and hold each blocked joint where it is; also while the latch is tripped.

    A joint that does not obey is not braked, which would push on whatever blocks it: its command
    halts at once and goes back from there to where the joint is.

    Args:
        sender: the sender of the motion, which has begun.
        tracking: knows which joints follow.
        state: reads where the arm is, ``(state_dim,)``; None where that is not known.
        blocked: whether joints that are too far from their commands do not obey.
        patience_s: how long a joint that lags may take to come to its last command by itself.
    """
    limiter = sender.limiter
    most = int(_LEAD_S / limiter.period)
    found = state()
    found = tracking.seen if found is None else found
    if not blocked or found is None:
        sender.brake()
    else:
        off = ~tracking.follows(limiter.last, found)
        limiter.halt(off)
        sender.rest_at(np.where(off, tracking.positions(found), limiter.rest()), most)
    for _ in range(int(patience_s / limiter.period)):
        found = state()
        if found is None or tracking.settled(limiter.last, found).all():
            return
        sender.send_hold()
    found = state()
    if found is not None:
        stayed = tracking.settled(limiter.last, found)
        sender.rest_at(np.where(stayed, limiter.last, tracking.positions(found)), most)


def ramp(limiter: CommandLimiter, pose: npt.ArrayLike, speed: float) -> Array:
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
    # Less than a float's rounding is no motion, and dividing by it could overflow.
    moving = np.abs(way) > np.finfo(np.float64).eps
    if not moving.any():
        return np.empty((0, len(way)))
    distance = np.abs(way[moving])
    pace = float(np.min(limiter.velocity[moving] * speed / distance))
    push = float(np.min(limiter.acceleration[moving] / distance))
    share = Joint("share", "normalized", 0.0, 1.0, pace, push)
    driver = CommandLimiter(
        EmbodimentSpec("way", (share,), (), 1.0 / limiter.period), limiter.period
    )
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
        if joint.by_speed and value != 0.0:
            raise ConfigError(
                f"prepare_pose has {joint.name} move at {value:g} {joint.unit}; in a pose it rests",
                next=f"0 for {joint.name}",
            )
        if not joint.lower <= value <= joint.upper:
            raise ConfigError(
                f"prepare_pose puts {joint.name} at {value:g}, outside its limits "
                f"[{joint.lower:.4g}, {joint.upper:.4g}] {joint.unit}"
            )
    return target
