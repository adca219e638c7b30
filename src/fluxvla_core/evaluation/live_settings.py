"""What a live evaluation may set; the rest of it is in ``live``, and heavier to import."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from fluxvla_core.errors import ConfigError

TAKEN = (
    "action_chunk",
    "action_filters",
    "chunk_joining",
    "execute_horizon",
    "gripper_threshold",
    "safety",
)
"""Keys of ``live``: those of an inference runner that say how a policy drives a robot."""


@dataclass(frozen=True)
class Live:
    """How episodes are run live.

    Args:
        options: arguments of ``BaseInferenceRunner``, of those in ``TAKEN``.
        folder: where each episode's record goes.
        video_fps: of the recorded videos; None records none.
    """

    options: Mapping[str, Any]
    folder: str
    video_fps: float | None = None


def live_options(live: bool | Mapping[str, Any]) -> dict[str, Any] | None:
    """The options of a live evaluation, None for a stepped one. What is usual in motion is the
    default: the newest chunk replaces the one before.

    Raises:
        ConfigError: there is no such option.
    """
    if live is False:
        return None
    given = {} if live is True else dict(live)
    unknown = sorted(set(given) - set(TAKEN))
    if unknown:
        raise ConfigError(f"takes no {', '.join(unknown)}; it takes {', '.join(TAKEN)}")
    return {"chunk_joining": "latest_only", **given}
