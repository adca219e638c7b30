"""The one way from a target to a command that is sent: filters, limits, latch, beat."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fluxvla_core.control.rate import Rate
from fluxvla_core.safety.limits import Clamp, Limiter
from fluxvla_core.safety.stops import BadCommand
from fluxvla_core.safety.trips import Latch

Array = npt.NDArray[np.float64]
Filter = Callable[[Array], Array]
Execute = Callable[[Array, Rate], None]


@dataclass(frozen=True)
class Sent:
    """One command that was sent: ``(D,)`` target as it was planned, and command as it was sent.

    ``held``: there was no target, so the arm brakes or stays.
    """

    target: Array
    command: Array
    clamps: tuple[Clamp, ...]
    held: bool = False


class CommandPath:
    """Plays targets on a robot; nothing else in a run sends commands.

    Each target passes the filters in their order, then the limiter, which is always last. The
    commands are handed to ``execute`` (a runner's ``_execute_actions``), which sends each and waits
    with ``rate.sleep()``; at that beat ``on_sent`` is told which command it was.

    Args:
        execute: called with ``(N, D)`` commands and the rate.
        rate: its ``on_beat`` is taken over.
        limiter: started before anything is played.
        latch: while it is tripped only ``brake`` sends.
        filters: ``(D,)`` -> ``(D,)`` callables; what a config's ``action_filters`` named.
        on_sent: called after each beat with what was sent, None for a beat without a command.
        speed: tells, before each command, the share of the velocity limits that it may use, in
            (0, 1]: a robot that a person slowed down. None where there is no such thing.
    """

    def __init__(
        self,
        execute: Execute,
        rate: Rate,
        limiter: Limiter,
        latch: Latch,
        filters: Sequence[Filter] = (),
        on_sent: Callable[[Sent | None], None] | None = None,
        speed: Callable[[], float] | None = None,
    ) -> None:
        self.rate = rate
        self.limiter = limiter
        self.latch = latch
        self._execute = execute
        self._filters = tuple(filters)
        self._on_sent = on_sent or (lambda sent: None)
        self._speed = speed
        self._rows: deque[Sent] = deque()
        # When the arm had the command that ``on_sent`` is told of, at the latest; of those that a
        # loop with a beat of its own plays, when the first was.
        self.sent_at = 0.0
        # Commands of a call that were sent, the one that is being sent among them.
        self._played = 0
        rate.on_beat = self._beat

    def play(self, targets: npt.ArrayLike, filtered: bool = True, most: float = 1.0) -> None:
        """Send one command for each row of ``(N, D)`` targets.

        Args:
            targets: where to go.
            filtered: through the filters.
            most: share of the velocity limits, in (0, 1], that no command goes beyond, however much
                the robot allows.

        Raises:
            SafetyStop: the latch is tripped, or a target is not finite or of another shape.
        """
        self.latch.check()
        wanted = np.asarray(targets, dtype=np.float64)
        shaped = np.array([self._filtered(row) for row in wanted]) if filtered else wanted
        if self._speed is None:
            self._play(wanted, shaped, most)
            return
        for row in range(len(wanted)):
            share = min(self._speed(), most)
            self._play(wanted[row : row + 1], shaped[row : row + 1], share)

    def _play(self, wanted: Array, shaped: Array, speed: float) -> None:
        before = self.limiter.snapshot()
        self._played = 0
        try:
            commands, clamps = self.limiter.run(shaped, speed)
            self._send(wanted, commands, clamps)
        finally:
            self._rows.clear()
            if self._played < len(shaped):
                self.limiter.restore(before)
                self.limiter.run(shaped[: self._played], speed)

    def hold(self) -> None:
        """Send one command of the shortest stop, or the last command again when at rest."""
        self.latch.check()
        self._send_brake()

    def brake(self, most: int) -> None:
        """Come to rest, in at most ``most`` commands; also while the latch is tripped."""
        for _ in range(most):
            if self.limiter.at_rest:
                return
            self._send_brake()

    def _send_brake(self) -> None:
        before = self.limiter.last
        self._send(before[None], self.limiter.brake()[None], [[]], held=True)

    def _send(
        self,
        wanted: Array,
        commands: Array,
        clamps: Sequence[Sequence[Clamp]],
        held: bool = False,
    ) -> None:
        rows = zip(wanted, commands, clamps, strict=True)
        self._rows = deque(Sent(t, c, tuple(found), held) for t, c, found in rows)
        handed = commands.copy()
        handed.flags.writeable = False
        beats, self.sent_at = self.rate.beats, self.rate.clock.now()
        self._played = 1
        self._execute(handed, self.rate)
        if self.rate.beats == beats:
            # A loop with a beat of its own: what it was given, it has played.
            self._played = len(commands)
            while self._rows:
                self._on_sent(self._rows.popleft())
        self._played = len(commands) - len(self._rows)

    def _beat(self) -> None:
        self.sent_at = self.rate.clock.now()
        self._on_sent(self._rows.popleft() if self._rows else None)
        self._played += 1

    def _filtered(self, row: Array) -> Array:
        for apply in self._filters:
            row = np.asarray(apply(row.copy()), dtype=np.float64)
            if row.shape != (self.limiter.embodiment.dim,):
                raise BadCommand(
                    f"action filter {type(apply).__name__} made an action of shape {row.shape}; "
                    f"{self.limiter.embodiment.name} takes ({self.limiter.embodiment.dim},)"
                )
        return row
