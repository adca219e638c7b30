"""``AlohaInferenceRunner``: a policy on two arms with grippers."""

from __future__ import annotations

from typing import Any, ClassVar

from fluxvla_core.control.filters import SnapGripper
from fluxvla_core.infer.base_runner import BaseInferenceRunner


class AlohaInferenceRunner(BaseInferenceRunner):
    """Runs a policy on an ALOHA, or on any operator whose embodiment the policy was trained for.

    Everything is ``BaseInferenceRunner``'s: ``prepare_pose`` (``fluxvla_aloha.embodiment`` has
    ``START_POSE``), ``execute_horizon``, ``async_execution`` and the rest.

    Args:
        gripper_threshold: gripper targets nearer to closed than this close the gripper wholly, so
            that it presses on what it holds; in the gripper's unit. None leaves them as they are.
        **kwargs: as ``BaseInferenceRunner`` takes them.
    """

    api: ClassVar[str] = "1.0"

    def __init__(self, gripper_threshold: float | None = None, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.gripper_threshold = gripper_threshold
        if gripper_threshold is not None:
            # After the config's own filters, right before the limits.
            self.action_filters += SnapGripper.of(self.embodiment, gripper_threshold)
