"""Public API for simulation environments, evaluation runners and data collection.

An environment has tasks and steps a simulation; an evaluation runner runs episodes in it and counts
successes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from fluxvla_core import _lazy

if TYPE_CHECKING:
    from fluxvla_core.contracts.environment import Environment as Environment
    from fluxvla_core.contracts.environment import EnvironmentSpec as EnvironmentSpec
    from fluxvla_core.contracts.environment import Step as Step
    from fluxvla_core.contracts.environment import TaskSpec as TaskSpec
    from fluxvla_core.contracts.policy import Actor as Actor
    from fluxvla_core.evaluation.collect import Collection as Collection
    from fluxvla_core.evaluation.policies import PolicySource as PolicySource
    from fluxvla_core.evaluation.policies import make_policy as make_policy
    from fluxvla_core.evaluation.policies import match_policy as match_policy
    from fluxvla_core.evaluation.rollout import RolloutSettings as RolloutSettings
    from fluxvla_core.evaluation.rollout import run_episode as run_episode
    from fluxvla_core.evaluation.runner import EvalRunner as EvalRunner
    from fluxvla_core.evaluation.stepping import Diverged as Diverged

__getattr__, __dir__, __all__ = _lazy.attach(__name__)
