"""When a Gymnasium task is done: Gymnasium itself has no word for it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from fluxvla_core.errors import ConfigError

KEYS = ("is_success", "success")
SUCCESS = ("info", "terminated", "truncated")


@dataclass(frozen=True)
class Judge:
    """How success is told.

    Args:
        by: ``info``: by its ``is_success`` or ``success``; ``terminated``: by the end;
            ``truncated``: by lasting until the time is up.
        reward: instead: by a step's reward from this on.
        total: instead: by a return, the sum of rewards, from this on.

    Raises:
        ConfigError: there is no such way, or there are two.
    """

    by: str = "info"
    reward: float | None = None
    total: float | None = None

    def __post_init__(self) -> None:
        if self.by not in SUCCESS:
            raise ConfigError(f"success {self.by!r} is none of {', '.join(SUCCESS)}")
        if self.reward is not None and self.total is not None:
            raise ConfigError("success_reward and success_return are two ways: give one of them")

    @property
    def needs_info(self) -> bool:
        """Whether ``info`` must say it."""
        return self.by == "info" and self.reward is None and self.total is None

    def done(
        self, reward: float, total: float, terminated: bool, lasted: bool, info: Mapping[str, Any]
    ) -> bool:
        """Whether the task was done by a step.

        Args:
            total: rewards so far, this one included.
            lasted: the time was up with this step.
        """
        if self.reward is not None:
            return reward >= self.reward
        if self.total is not None:
            return total >= self.total
        if self.by == "terminated":
            return terminated
        if self.by == "truncated":
            return lasted and not terminated
        return any(bool(info[key]) for key in KEYS if key in info)


def told(info: Mapping[str, Any]) -> bool:
    """Whether ``info`` says if the task is done."""
    return any(key in info for key in KEYS)
