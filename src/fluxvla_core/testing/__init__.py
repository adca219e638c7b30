"""Conformance kits: subclass one in a plugin's tests and know that the plugin is right."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from fluxvla_core import _lazy

if TYPE_CHECKING:
    from fluxvla_core.testing.action_filter import (
        ActionFilterConformance as ActionFilterConformance,
    )
    from fluxvla_core.testing.dataset import DatasetConformance as DatasetConformance
    from fluxvla_core.testing.environment import EnvironmentConformance as EnvironmentConformance
    from fluxvla_core.testing.eval_runner import EvalRunnerConformance as EvalRunnerConformance
    from fluxvla_core.testing.execution import ExecutionConformance as ExecutionConformance
    from fluxvla_core.testing.hook import HookConformance as HookConformance
    from fluxvla_core.testing.inference_runner import (
        InferenceRunnerConformance as InferenceRunnerConformance,
    )
    from fluxvla_core.testing.metric import MetricConformance as MetricConformance
    from fluxvla_core.testing.model import ModelConformance as ModelConformance
    from fluxvla_core.testing.operator import OperatorConformance as OperatorConformance
    from fluxvla_core.testing.policy import PolicyConformance as PolicyConformance
    from fluxvla_core.testing.stand_ins import StandInPolicy as StandInPolicy
    from fluxvla_core.testing.stand_ins import StandInRobot as StandInRobot
    from fluxvla_core.testing.train_runner import TrainRunnerConformance as TrainRunnerConformance
    from fluxvla_core.testing.transform import TransformConformance as TransformConformance

_KITS = {
    "fluxvla_core.testing.action_filter": ["ActionFilterConformance"],
    "fluxvla_core.testing.dataset": ["DatasetConformance"],
    "fluxvla_core.testing.environment": ["EnvironmentConformance"],
    "fluxvla_core.testing.execution": ["ExecutionConformance"],
    "fluxvla_core.testing.eval_runner": ["EvalRunnerConformance"],
    "fluxvla_core.testing.hook": ["HookConformance"],
    "fluxvla_core.testing.inference_runner": ["InferenceRunnerConformance"],
    "fluxvla_core.testing.metric": ["MetricConformance"],
    "fluxvla_core.testing.model": ["ModelConformance"],
    "fluxvla_core.testing.operator": ["OperatorConformance"],
    "fluxvla_core.testing.policy": ["PolicyConformance"],
    "fluxvla_core.testing.stand_ins": ["StandInPolicy", "StandInRobot"],
    "fluxvla_core.testing.train_runner": ["TrainRunnerConformance"],
    "fluxvla_core.testing.transform": ["TransformConformance"],
}
if "pytest" in sys.modules:
    import pytest

    # Assertions of the kits then show their values, besides what they say.
    _shared = ("fluxvla_core.testing._conformance", "fluxvla_core.testing._operator_parts")
    pytest.register_assert_rewrite(*_shared, *_KITS)

__getattr__, __dir__, __all__ = _lazy.attach(__name__, _KITS)
