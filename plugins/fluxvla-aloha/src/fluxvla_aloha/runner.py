"""``AlohaInferenceRunner``: a policy on two arms with grippers, and the same in real time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from fluxvla_core.operators import BaseInferenceRunner


class AlohaInferenceRunner(BaseInferenceRunner):
    """Runs a policy on an ALOHA, or on any operator whose embodiment the policy was trained for.

    Everything is ``BaseInferenceRunner``'s: ``prepare_pose`` (``start_pose`` of
    ``fluxvla_aloha.embodiment`` has one for each kind of arms), ``execute_horizon``,
    ``gripper_threshold`` and the rest.
    """

    api: ClassVar[str] = "1.0"


class AlohaRTCInferenceRunner(AlohaInferenceRunner):
    """``AlohaInferenceRunner`` with real-time chunking, for policies that can continue a chunk.

    Args:
        chunk_joining: as ``BaseInferenceRunner`` takes it.
        **kwargs: as ``BaseInferenceRunner`` takes them.
    """

    api: ClassVar[str] = "1.0"

    def __init__(
        self, chunk_joining: str | Mapping[str, Any] | None = "rtc", **kwargs: Any
    ) -> None:
        super().__init__(chunk_joining=chunk_joining, **kwargs)
