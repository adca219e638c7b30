"""``URInferenceRunner``: a policy on one Universal Robots arm with a gripper."""

from __future__ import annotations

from typing import ClassVar

from fluxvla_core.operators import BaseInferenceRunner


class URInferenceRunner(BaseInferenceRunner):
    """Runs a policy on a UR arm, or on any operator whose embodiment the policy was trained for.

    Everything is ``BaseInferenceRunner``'s: ``prepare_pose``, ``execute_horizon``,
    ``gripper_threshold`` and the rest. No pose is built in.
    """

    api: ClassVar[str] = "1.0"
