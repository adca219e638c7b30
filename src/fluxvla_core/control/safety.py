"""Safety rules: their thresholds, the errors that name them, and the latch that stops motion."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from enum import Enum
from typing import Any, ClassVar

from fluxvla_core.errors import ConfigError, FluxError, SafetyStop, nearest


@dataclass(frozen=True)
class SafetySettings:
    """Thresholds of every rule. There is no switch that turns a rule off.

    Args:
        velocity_scale, acceleration_scale: share of the embodiment's limits to use, in (0, 1].
        ramp_scale: share of the velocity limit on the way to the start pose, in (0, 1].
        max_age_s: how old the oldest stream of an observation may be when the policy is queried.
            Not the operator's ``max_age_s``: how long a stream may be silent, at every command.
        max_skew_s: how far the receipt times of an observation's streams may be apart. Not the
            operator's ``max_skew_s``: how far the header stamps of a frame's messages may be apart.
        tracking_error: how far a joint may stay behind its command, in rad (prismatic joints:
            in m, a tenth of it). Grippers are exempt: holding something is their purpose.
        tracking_time_s: for how long.
        jump_s: a chunk that asks a joint to be further away than it could go in this time at full
            speed is no motion, and stops.
        excess: a chunk that lies further beyond a position limit than this share of the joint's
            range stops; less is clamped. Grippers may be wanted four times as far beyond.
        starvation_s: how long the arm may hold and wait for the next chunk while it runs.
        silence_s: on a robot that a process of its own commands: how long the main process, with
            the policy, may not run while the arm moves.
        first_chunk_s: how long the first answer of a policy may take (it may have to warm up), and
            any answer in a simulation whose time stands still meanwhile.
    """

    velocity_scale: float = 1.0
    acceleration_scale: float = 1.0
    ramp_scale: float = 0.25
    max_age_s: float = 0.5
    max_skew_s: float = 0.25
    tracking_error: float = 0.3
    tracking_time_s: float = 0.25
    jump_s: float = 1.0
    excess: float = 0.25
    starvation_s: float = 2.0
    silence_s: float = 0.2
    first_chunk_s: float = 120.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            number = isinstance(value, (int, float)) and not isinstance(value, bool)
            if not number or not math.isfinite(value) or value <= 0:
                raise ConfigError(f"safety.{name} must be a positive number, got {value!r}")
            if name.endswith("_scale") and value > 1:
                raise ConfigError(
                    f"safety.{name} must be above 0 and at most 1, got {value}",
                    cause="a scale uses a share of the robot's limits; it cannot lift them",
                )

    @classmethod
    def of(cls, value: Mapping[str, Any] | SafetySettings | None) -> SafetySettings:
        """Settings from a config's ``safety=dict(…)``; None means the defaults.

        Raises:
            ConfigError: a key is unknown (with the nearest one), or a value is out of its range.
        """
        if value is None:
            return cls()
        if isinstance(value, SafetySettings):
            return value
        if not isinstance(value, Mapping):
            raise ConfigError(f"safety must be a table, got {value!r}")
        names = [field.name for field in fields(cls)]
        for key in value:
            if key not in names:
                near = nearest(str(key), names)
                hint = f"; did you mean {near}?" if near else f"; there are {', '.join(names)}"
                raise ConfigError(f"safety has no setting {key!r}{hint}")
        return cls(**value)


class Rule(str, Enum):
    """The reason of a stop, as records and results have it."""

    __str__ = str.__str__  # its value, also in Python 3.10, which has no StrEnum

    LIMITS = "limits"
    FRAME = "frame"
    FRESHNESS = "freshness"
    CHUNK = "chunk"
    TRACKING = "tracking"
    STARVATION = "starvation"
    FILTER = "filter"
    """An action filter was late, one command after the other."""
    POLICY = "policy"
    """The policy raised an error."""
    OPERATOR = "operator"
    """The operator raised an error."""
    EXECUTE = "execute"
    """The runner's own sending raised an error."""
    RUN = "run"
    """Anything else raised an error: a hook, a filter, the runner."""
    MAIN_PROCESS = "main process"
    """The main process does not run; the control process stops the arm."""
    CONTROL_PROCESS = "control process"
    """The control process is dead, or hangs; the main process stops the arm."""
    INTERRUPT = "interrupt"
    """A signal; the latch is not tripped."""


class RuleStop(SafetyStop):
    """A safety rule ended the motion; ``rule`` says which."""

    rule: ClassVar[str] = "safety"


class BadCommand(RuleStop):
    """A command could not be formed: not finite, of another shape, or from an impossible pose."""

    rule = Rule.LIMITS


class BadFrame(RuleStop):
    """A frame is not what the embodiment describes."""

    rule = Rule.FRAME


class BadTiming(RuleStop):
    """A stream is stale, runs backwards, or is too far from the others."""

    rule = Rule.FRESHNESS


class BadChunk(RuleStop):
    """A policy's chunk is refused: not finite, of a wrong shape, or it jumps."""

    rule = Rule.CHUNK


class NotFollowing(RuleStop):
    """The arm is not where it is commanded to be."""

    rule = Rule.TRACKING


class Starved(RuleStop):
    """No chunk came in time."""

    rule = Rule.STARVATION


class FilterLate(RuleStop):
    """An action filter does not return in time."""

    rule = Rule.FILTER


def rule_of(error: BaseException, otherwise: Rule = Rule.RUN) -> str:
    """The rule that an error belongs to: its own ``rule``, if it has one.

    Args:
        error: what ended a motion.
        otherwise: for an error that says nothing.
    """
    own = error.rule if isinstance(error, FluxError) else ""
    return str(own or otherwise)


@dataclass(frozen=True)
class Trip:
    """The cause of a stop: which rule, what it saw, and when (seconds on the loop's clock)."""

    rule: str
    what: str
    at: float


class Latch:
    """Once tripped, nothing moves until ``rearm`` is called; every trip is kept.

    Args:
        now: the loop's clock.
    """

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self._open: Trip | None = None
        self.trips: list[Trip] = []

    @property
    def tripped(self) -> Trip | None:
        """The trip that holds the robot, or None."""
        return self._open

    def trip(self, rule: str, error: FluxError | str) -> Trip:
        """Record a trip and hold the robot."""
        what = error.what if isinstance(error, FluxError) else error
        found = Trip(rule, what, self._now())
        self.trips.append(found)
        self._open = self._open or found
        return found

    def check(self) -> None:
        """Refuse to move on while tripped.

        Raises:
            SafetyStop: names the first trip since the last re-arming.
        """
        if self._open is not None:
            raise SafetyStop(
                f"stopped by rule {self._open.rule}: {self._open.what}",
                next="look at the robot, remove the cause, then re-arm",
            )

    def rearm(self) -> None:
        """Allow motion again; what was recorded stays."""
        self._open = None
