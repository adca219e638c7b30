"""Public API for models and policies: building a model family, loading a trained policy, reading
checkpoints of other projects."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fluxvla_core import _lazy

if TYPE_CHECKING:
    from fluxvla_core.build import build_head_from_cfg as build_head_from_cfg
    from fluxvla_core.build import build_llm_backbone_from_cfg as build_llm_backbone_from_cfg
    from fluxvla_core.build import build_projector_from_cfg as build_projector_from_cfg
    from fluxvla_core.build import build_vision_backbone_from_cfg as build_vision_backbone_from_cfg
    from fluxvla_core.build import build_vlm_backbone_from_cfg as build_vlm_backbone_from_cfg
    from fluxvla_core.checkpoints.foreign import check_settings as check_settings
    from fluxvla_core.checkpoints.foreign import chosen_robot as chosen_robot
    from fluxvla_core.checkpoints.foreign import foreign_folder as foreign_folder
    from fluxvla_core.checkpoints.foreign import renamed as renamed
    from fluxvla_core.checkpoints.foreign import safetensors_in as safetensors_in
    from fluxvla_core.checkpoints.foreign import torch_table as torch_table
    from fluxvla_core.checkpoints.foreign import without_cameras as without_cameras
    from fluxvla_core.checkpoints.shards import Stored as Stored
    from fluxvla_core.contracts.checkpoint_format import CheckpointFormat as CheckpointFormat
    from fluxvla_core.contracts.checkpoint_format import ForeignCheckpoint as ForeignCheckpoint
    from fluxvla_core.contracts.frame import Observation as Observation
    from fluxvla_core.contracts.policy import Policy as Policy
    from fluxvla_core.contracts.training import VLA as VLA
    from fluxvla_core.contracts.training import InputSizes as InputSizes
    from fluxvla_core.contracts.training import PartWeights as PartWeights
    from fluxvla_core.data.pretrained import model_folder as model_folder
    from fluxvla_core.data.pretrained import resolve_model_path as resolve_model_path
    from fluxvla_core.policies.loading import load_policy as load_policy
    from fluxvla_core.training.export import embodiment_in as embodiment_in
    from fluxvla_core.training.model import built_without_memory as built_without_memory
    from fluxvla_core.training.model import has_values as has_values
    from fluxvla_core.training.model import weights_follow as weights_follow

__getattr__, __dir__, __all__ = _lazy.attach(__name__)
