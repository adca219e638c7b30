"""Why a motion is stopped: the rules, the errors that name them, and the latch that holds it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import ClassVar

from fluxvla_core.errors import FluxError, OperatorError, SafetyStop


class Rule(StrEnum):
    """The reason of a stop, as records and results have it."""

    LIMITS = "limits"
    FRAME = "frame"
    FRESHNESS = "freshness"
    CHUNK = "chunk"
    TRACKING = "tracking"
    STARVATION = "starvation"
    POLICY = "policy"
    """The policy raised an error."""
    OPERATOR = "operator"
    """The operator raised an error."""
    EXECUTE = "execute"
    """The runner's own sending raised an error."""
    RUN = "run"
    """Anything else raised an error: a hook, a filter, the runner."""
    INTERRUPT = "interrupt"
    """A signal; the latch is not tripped."""


class RuleStop(SafetyStop):
    """A safety rule ended the motion; ``rule`` says which."""

    rule: ClassVar[str] = "safety"


class BadCommand(RuleStop):
    """A command could not be formed: not finite, of another shape, or from an impossible pose."""

    rule = Rule.LIMITS


class BadFrame(RuleStop):
    """A reading is not what the embodiment describes."""

    rule = Rule.FRAME


class BadTiming(RuleStop):
    """A stream is stale, runs backwards, or is too far from the others."""

    rule = Rule.FRESHNESS


class BadChunk(RuleStop):
    """A policy's answer is no motion for this arm."""

    rule = Rule.CHUNK


class NotFollowing(RuleStop):
    """The arm is not where it is commanded to be."""

    rule = Rule.TRACKING


class Starved(RuleStop):
    """No chunk came in time."""

    rule = Rule.STARVATION


def rule_of(error: BaseException, otherwise: Rule = Rule.RUN) -> str:
    """The rule that an error belongs to: its own ``rule``, or ``operator`` for an operator's.

    Args:
        error: what ended a motion.
        otherwise: for an error that says nothing.
    """
    rule: str | None = getattr(error, "rule", None)
    if rule is not None:
        return str(rule)
    return Rule.OPERATOR if isinstance(error, OperatorError) else otherwise


@dataclass(frozen=True)
class Trip:
    """Why a motion ended: which rule, what it saw, and when (seconds on the loop's clock)."""

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
