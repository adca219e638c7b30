"""FluxVLA: train Vision-Language-Action policies and run them on robots.

Importing this package runs nothing; each name below is imported when it is first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from fluxvla_core import _lazy

if TYPE_CHECKING:
    from fluxvla_core.build import RunContext as RunContext
    from fluxvla_core.build import build_action_filter_from_cfg as build_action_filter_from_cfg
    from fluxvla_core.build import build_collator_from_cfg as build_collator_from_cfg
    from fluxvla_core.build import build_dataset_from_cfg as build_dataset_from_cfg
    from fluxvla_core.build import build_environment_from_cfg as build_environment_from_cfg
    from fluxvla_core.build import build_head_from_cfg as build_head_from_cfg
    from fluxvla_core.build import build_llm_backbone_from_cfg as build_llm_backbone_from_cfg
    from fluxvla_core.build import build_metric_from_cfg as build_metric_from_cfg
    from fluxvla_core.build import build_operator_from_cfg as build_operator_from_cfg
    from fluxvla_core.build import build_optimizer_from_cfg as build_optimizer_from_cfg
    from fluxvla_core.build import build_policy_from_cfg as build_policy_from_cfg
    from fluxvla_core.build import build_processor_from_cfg as build_processor_from_cfg
    from fluxvla_core.build import build_projector_from_cfg as build_projector_from_cfg
    from fluxvla_core.build import build_runner_from_cfg as build_runner_from_cfg
    from fluxvla_core.build import build_tokenizer_from_cfg as build_tokenizer_from_cfg
    from fluxvla_core.build import build_transform_from_cfg as build_transform_from_cfg
    from fluxvla_core.build import build_vision_backbone_from_cfg as build_vision_backbone_from_cfg
    from fluxvla_core.build import build_vla_from_cfg as build_vla_from_cfg
    from fluxvla_core.build import build_vlm_backbone_from_cfg as build_vlm_backbone_from_cfg
    from fluxvla_core.contracts.environment import Environment as Environment
    from fluxvla_core.contracts.environment import EnvironmentSpec as EnvironmentSpec
    from fluxvla_core.contracts.environment import Step as Step
    from fluxvla_core.contracts.environment import TaskSpec as TaskSpec
    from fluxvla_core.contracts.frame import Frame as Frame
    from fluxvla_core.contracts.frame import Observation as Observation
    from fluxvla_core.contracts.policy import Actor as Actor
    from fluxvla_core.contracts.policy import Continuation as Continuation
    from fluxvla_core.contracts.policy import Policy as Policy
    from fluxvla_core.contracts.robot import ActionFilter as ActionFilter
    from fluxvla_core.contracts.robot import Operator as Operator
    from fluxvla_core.contracts.runner import Command as Command
    from fluxvla_core.contracts.runner import Hook as Hook
    from fluxvla_core.contracts.runner import Runner as Runner
    from fluxvla_core.contracts.runner import TrainRunner as TrainRunner
    from fluxvla_core.contracts.training import VLA as VLA
    from fluxvla_core.contracts.training import Collator as Collator
    from fluxvla_core.contracts.training import Dataset as Dataset
    from fluxvla_core.contracts.training import InferenceDataset as InferenceDataset
    from fluxvla_core.contracts.training import Metric as Metric
    from fluxvla_core.contracts.training import Optimizer as Optimizer
    from fluxvla_core.contracts.training import RandomTransform as RandomTransform
    from fluxvla_core.contracts.training import Tokenizer as Tokenizer
    from fluxvla_core.contracts.training import Transform as Transform
    from fluxvla_core.errors import FluxError as FluxError
    from fluxvla_core.plugins.registry import ACTION_FILTERS as ACTION_FILTERS
    from fluxvla_core.plugins.registry import CHECKPOINT_FORMATS as CHECKPOINT_FORMATS
    from fluxvla_core.plugins.registry import COLLATORS as COLLATORS
    from fluxvla_core.plugins.registry import COMMANDS as COMMANDS
    from fluxvla_core.plugins.registry import DATASETS as DATASETS
    from fluxvla_core.plugins.registry import ENVIRONMENTS as ENVIRONMENTS
    from fluxvla_core.plugins.registry import HEADS as HEADS
    from fluxvla_core.plugins.registry import HOOKS as HOOKS
    from fluxvla_core.plugins.registry import LLM_BACKBONES as LLM_BACKBONES
    from fluxvla_core.plugins.registry import METRICS as METRICS
    from fluxvla_core.plugins.registry import OPERATORS as OPERATORS
    from fluxvla_core.plugins.registry import OPTIMIZERS as OPTIMIZERS
    from fluxvla_core.plugins.registry import POLICIES as POLICIES
    from fluxvla_core.plugins.registry import PROCESSORS as PROCESSORS
    from fluxvla_core.plugins.registry import PROJECTORS as PROJECTORS
    from fluxvla_core.plugins.registry import RUNNERS as RUNNERS
    from fluxvla_core.plugins.registry import TOKENIZERS as TOKENIZERS
    from fluxvla_core.plugins.registry import TRANSFORMS as TRANSFORMS
    from fluxvla_core.plugins.registry import VISION_BACKBONES as VISION_BACKBONES
    from fluxvla_core.plugins.registry import VLAS as VLAS
    from fluxvla_core.plugins.registry import VLM_BACKBONES as VLM_BACKBONES
    from fluxvla_core.plugins.registry import Registry as Registry
    from fluxvla_core.policies.loading import load_policy as load_policy
    from fluxvla_core.robot.runner import BaseInferenceRunner as BaseInferenceRunner
    from fluxvla_core.spec import Camera as Camera
    from fluxvla_core.spec import EmbodimentSpec as EmbodimentSpec
    from fluxvla_core.spec import Joint as Joint
    from fluxvla_core.training.base_runner import BaseTrainRunner as BaseTrainRunner

__version__ = "0.1.0"
__getattr__, __dir__, _names = _lazy.attach(__name__)
__all__ = [*_names, "__version__"]
