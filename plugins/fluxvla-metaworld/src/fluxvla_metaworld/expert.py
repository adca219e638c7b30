"""Meta-World's scripted experts as a policy: one for each task, known to succeed.

They show that an evaluation measures what it says: their success through it must be the one that
Meta-World's own tests ask of them.
"""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import numpy.typing as npt

from fluxvla_core.errors import ConfigError
from fluxvla_core.models import Policy
from fluxvla_metaworld.environment import CONTROL_HZ, MetaWorldEnvironment, metaworld_spec

if TYPE_CHECKING:
    from fluxvla_core.models import Observation


class MetaWorldExpert(Policy):
    """The expert of whatever task its environment is in; it sees where things truly are."""

    api: ClassVar[str] = "1.0"
    cameras: ClassVar[tuple[str, ...]] = ()
    action_rate_hz: ClassVar[float] = CONTROL_HZ
    horizon: ClassVar[int] = 1

    def __init__(self) -> None:
        self.embodiment = metaworld_spec(())
        self._environment: MetaWorldEnvironment | None = None
        self._expert: Any = None

    def enter(self, environment: Any) -> None:
        """Say where it acts.

        Raises:
            ConfigError: that is not Meta-World.
        """
        if not isinstance(environment, MetaWorldEnvironment):
            raise ConfigError(
                f"Meta-World's experts act in MetaWorldEnvironment only, "
                f"not in {type(environment).__name__}"
            )
        self._environment = environment

    def reset(self, seed: int) -> None:
        self._expert = None

    def predict_action(self, observation: Observation) -> npt.NDArray[np.float64]:
        """``(1, 4)``, cut to the action's range, as Meta-World would cut it.

        Raises:
            ConfigError: ``enter`` was not called.
        """
        from metaworld.policies import ENV_POLICY_MAP

        if self._environment is None:
            raise ConfigError("MetaWorldExpert does not know its environment: call enter() first")
        if self._expert is None:
            self._expert = ENV_POLICY_MAP[self._environment.task]()
        with warnings.catch_warnings():
            # It says in every step that the environment will cut its actions.
            warnings.simplefilter("ignore")
            action = self._expert.get_action(self._environment.privileged)
        return np.clip(np.asarray(action, dtype=np.float64), -1.0, 1.0)[None]
