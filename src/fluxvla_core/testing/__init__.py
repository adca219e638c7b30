"""Conformance kits: subclass one in a plugin's tests and know that the plugin is right."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fluxvla_core import _lazy

if TYPE_CHECKING:
    from fluxvla_core.testing.environment import EnvironmentConformance as EnvironmentConformance
    from fluxvla_core.testing.operator import OperatorConformance as OperatorConformance
    from fluxvla_core.testing.train_runner import TrainRunnerConformance as TrainRunnerConformance

__getattr__, __dir__, __all__ = _lazy.attach(
    __name__,
    {
        "fluxvla_core.testing.environment": ["EnvironmentConformance"],
        "fluxvla_core.testing.operator": ["OperatorConformance"],
        "fluxvla_core.testing.train_runner": ["TrainRunnerConformance"],
    },
)
