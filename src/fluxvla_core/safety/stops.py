"""What a safety rule raises; each names its rule for records and for the latch."""

from __future__ import annotations

from typing import ClassVar

from fluxvla_core.errors import SafetyStop


class RuleStop(SafetyStop):
    """A safety rule ended the motion; ``rule`` says which."""

    rule: ClassVar[str] = "safety"


class BadCommand(RuleStop):
    """A command could not be formed: not finite, of another shape, or from an impossible pose."""

    rule = "limits"


class BadFrame(RuleStop):
    """A reading is not what the embodiment describes."""

    rule = "frame"


class BadTiming(RuleStop):
    """A stream is stale, runs backwards, or is too far from the others."""

    rule = "freshness"


class BadChunk(RuleStop):
    """A policy's answer is no motion for this arm."""

    rule = "chunk"


class NotFollowing(RuleStop):
    """The arm is not where it is commanded to be."""

    rule = "tracking"


class Starved(RuleStop):
    """No chunk came in time."""

    rule = "starvation"
