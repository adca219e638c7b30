"""FluxVLA: train Vision-Language-Action policies and run them on robots.

Importing this package runs nothing; each name below is imported when it is first used.
"""

from __future__ import annotations

import importlib
from typing import Any

from fluxvla_core.registries import ROWS

__version__ = "0.1.0"

_EXPORTS: dict[str, str] = {
    **{row.constant: "fluxvla_core.plugins.registry" for row in ROWS},
    **{row.builder: "fluxvla_core.build" for row in ROWS if row.builder},
    "ActionFilter": "fluxvla_core.contracts.robot",
    "Actor": "fluxvla_core.contracts.policy",
    "BaseInferenceRunner": "fluxvla_core.robot.runner",
    "BaseTrainRunner": "fluxvla_core.training.base_runner",
    "Camera": "fluxvla_core.spec",
    "Collator": "fluxvla_core.contracts.training",
    "Command": "fluxvla_core.contracts.runner",
    "Continuation": "fluxvla_core.contracts.policy",
    "Dataset": "fluxvla_core.contracts.training",
    "EmbodimentSpec": "fluxvla_core.spec",
    "Environment": "fluxvla_core.contracts.environment",
    "EnvironmentSpec": "fluxvla_core.contracts.environment",
    "FluxError": "fluxvla_core.errors",
    "Frame": "fluxvla_core.contracts.frame",
    "Hook": "fluxvla_core.contracts.runner",
    "InferenceDataset": "fluxvla_core.contracts.training",
    "Joint": "fluxvla_core.spec",
    "Metric": "fluxvla_core.contracts.training",
    "Observation": "fluxvla_core.contracts.frame",
    "Operator": "fluxvla_core.contracts.robot",
    "Optimizer": "fluxvla_core.contracts.training",
    "Policy": "fluxvla_core.contracts.policy",
    "RandomTransform": "fluxvla_core.contracts.training",
    "Registry": "fluxvla_core.plugins.registry",
    "RunContext": "fluxvla_core.build",
    "Runner": "fluxvla_core.contracts.runner",
    "Step": "fluxvla_core.contracts.environment",
    "TaskSpec": "fluxvla_core.contracts.environment",
    "Tokenizer": "fluxvla_core.contracts.training",
    "TrainRunner": "fluxvla_core.contracts.runner",
    "Transform": "fluxvla_core.contracts.training",
    "VLA": "fluxvla_core.contracts.training",
    "load_policy": "fluxvla_core.policies.loading",
}

__all__ = [*sorted(_EXPORTS), "__version__"]


def __getattr__(name: str) -> Any:
    module = _EXPORTS.get(name)
    if module is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(module), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_EXPORTS})
