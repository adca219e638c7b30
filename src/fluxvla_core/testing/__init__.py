"""Conformance kits: subclass one in a plugin's tests and know that the plugin is right."""

from __future__ import annotations

import sys
from pathlib import Path
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

if "pytest" in sys.modules:
    import pytest

    # Assertions of the kits then show their values, besides their messages.
    pytest.register_assert_rewrite(
        *(f"{__name__}.{p.stem}" for p in Path(__file__).parent.glob("*.py"))
    )

__getattr__, __dir__, __all__ = _lazy.attach(__name__)
