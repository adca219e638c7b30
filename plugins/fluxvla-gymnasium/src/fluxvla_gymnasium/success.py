"""When a Gymnasium task is done: Gymnasium itself has no word for it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fluxvla_core.errors import RunFailed

SUCCESS = ("info", "terminated")
_KEYS = ("is_success", "success")


def is_done(
    success: str,
    success_reward: float | None,
    reward: float,
    terminated: bool,
    info: Mapping[str, Any],
) -> bool:
    """Whether the task was done by a step.

    Args:
        success: ``info``: by its ``is_success`` or ``success``; ``terminated``: by the end.
        success_reward: instead: by a reward from this on.

    Raises:
        RunFailed: ``info`` has neither.
    """
    if success_reward is not None:
        return reward >= success_reward
    if success == "terminated":
        return terminated
    for key in _KEYS:
        if key in info:
            return bool(info[key])
    raise RunFailed(
        f"the environment does not say whether its task is done; its info has {sorted(info)}",
        next="set success = 'terminated', or success_reward = <a step's reward when it is done>",
    )
