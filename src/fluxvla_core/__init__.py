"""FluxVLA: train Vision-Language-Action policies and run them on robots.

Importing this package runs nothing; each name below is imported when it is first used.
"""

from __future__ import annotations

import importlib
from typing import Any

__version__ = "0.1.0"

_EXPORTS: dict[str, str] = {
    "ACTION_FILTERS": "fluxvla_core.plugins.registry",
    "COLLATORS": "fluxvla_core.plugins.registry",
    "COMMANDS": "fluxvla_core.plugins.registry",
    "DATASETS": "fluxvla_core.plugins.registry",
    "ENVIRONMENTS": "fluxvla_core.plugins.registry",
    "HEADS": "fluxvla_core.plugins.registry",
    "HOOKS": "fluxvla_core.plugins.registry",
    "LLM_BACKBONES": "fluxvla_core.plugins.registry",
    "METRICS": "fluxvla_core.plugins.registry",
    "OPERATORS": "fluxvla_core.plugins.registry",
    "OPTIMIZERS": "fluxvla_core.plugins.registry",
    "POLICIES": "fluxvla_core.plugins.registry",
    "PROCESSORS": "fluxvla_core.plugins.registry",
    "PROJECTORS": "fluxvla_core.plugins.registry",
    "RUNNERS": "fluxvla_core.plugins.registry",
    "TOKENIZERS": "fluxvla_core.plugins.registry",
    "TRANSFORMS": "fluxvla_core.plugins.registry",
    "VISION_BACKBONES": "fluxvla_core.plugins.registry",
    "VLAS": "fluxvla_core.plugins.registry",
    "VLM_BACKBONES": "fluxvla_core.plugins.registry",
    "BaseInferenceRunner": "fluxvla_core.infer.base_runner",
    "BaseTrainRunner": "fluxvla_core.train.base_runner",
    "Camera": "fluxvla_core.spec.embodiment",
    "EmbodimentSpec": "fluxvla_core.spec.embodiment",
    "EnvironmentSpec": "fluxvla_core.contracts.environment",
    "FluxError": "fluxvla_core.errors",
    "Frame": "fluxvla_core.contracts.frame",
    "Joint": "fluxvla_core.spec.embodiment",
    "Registry": "fluxvla_core.plugins.registry",
    "RunContext": "fluxvla_core.build",
    "Step": "fluxvla_core.contracts.environment",
    "TaskSpec": "fluxvla_core.contracts.environment",
    "build_action_filter_from_cfg": "fluxvla_core.build",
    "build_collator_from_cfg": "fluxvla_core.build",
    "build_dataset_from_cfg": "fluxvla_core.build",
    "build_environment_from_cfg": "fluxvla_core.build",
    "build_head_from_cfg": "fluxvla_core.build",
    "build_llm_backbone_from_cfg": "fluxvla_core.build",
    "build_metric_from_cfg": "fluxvla_core.build",
    "build_operator_from_cfg": "fluxvla_core.build",
    "build_optimizer_from_cfg": "fluxvla_core.build",
    "build_policy_from_cfg": "fluxvla_core.build",
    "build_processor_from_cfg": "fluxvla_core.build",
    "build_projector_from_cfg": "fluxvla_core.build",
    "build_runner_from_cfg": "fluxvla_core.build",
    "build_tokenizer_from_cfg": "fluxvla_core.build",
    "build_transform_from_cfg": "fluxvla_core.build",
    "build_vision_backbone_from_cfg": "fluxvla_core.build",
    "build_vla_from_cfg": "fluxvla_core.build",
    "build_vlm_backbone_from_cfg": "fluxvla_core.build",
    "load_policy": "fluxvla_core.infer.local_policy",
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
