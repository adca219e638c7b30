"""Errors that say which safety rule they belong to, so that the arm is braked, not dropped.

An operator error as such means that the arm may not obey any more. These mean that what is known
about the robot is no longer good enough to act on; its commands still arrive.
"""

from __future__ import annotations

from typing import ClassVar

from fluxvla_core.errors import Faulted, NotReady


class Stale(NotReady):
    """A stream is silent, late, or too far from the others in time; it may recover."""

    rule: ClassVar[str] = "freshness"


class BadMessage(Faulted):
    """A message is not what the embodiment describes: names, sizes, encodings, numbers."""

    rule: ClassVar[str] = "frame"
