"""Tiny policies that LeRobot itself makes and saves, and what a robot sees."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.policies.tdmpc.configuration_tdmpc import TDMPCConfig
from lerobot.policies.vqbet.configuration_vqbet import VQBeTConfig

from fluxvla_core import Camera, EmbodimentSpec, Joint
from tests.oracles import fill

SIZE = (72, 96)
JOINTS = tuple(f"j{i}" for i in range(6))
CAMERAS = ("front", "wrist")
ROBOT = EmbodimentSpec(
    "arm",
    tuple(Joint(name, "rad", -9.0, 9.0, 9.0, 90.0) for name in JOINTS),
    tuple(Camera(name, *SIZE) for name in CAMERAS),
    10.0,
)
ACT = {
    "chunk_size": 8,
    "n_action_steps": 5,
    "pretrained_backbone_weights": None,
    "dim_model": 32,
    "n_heads": 4,
    "dim_feedforward": 48,
    "n_encoder_layers": 2,
    "n_vae_encoder_layers": 2,
    "latent_dim": 6,
}
DIFFUSION = {
    "horizon": 8,
    "n_action_steps": 5,
    "pretrained_backbone_weights": None,
    "spatial_softmax_num_keypoints": 8,
    "down_dims": (16, 32),
    "diffusion_step_embed_dim": 16,
    "num_inference_steps": 3,
    "crop_shape": (64, 80),
    "crop_is_random": False,
    "noise_scheduler_type": "DDIM",
}
VQBET = {
    "pretrained_backbone_weights": None,
    "crop_shape": (64, 80),
    "crop_is_random": False,
    "spatial_softmax_num_keypoints": 8,
    "n_obs_steps": 2,
    "n_action_pred_token": 2,
    "action_chunk_size": 3,
    "gpt_n_layer": 1,
    "gpt_n_head": 2,
    "gpt_hidden_dim": 32,
    "gpt_input_dim": 32,
    "gpt_output_dim": 32,
    "vqvae_n_embed": 4,
    "vqvae_embedding_dim": 16,
    "vqvae_enc_hidden_dim": 16,
}
TDMPC = {
    "horizon": 2,
    "n_action_steps": 1,
    "cem_iterations": 1,
    "n_gaussian_samples": 8,
    "n_elites": 4,
    "n_pi_samples": 2,
    "image_encoder_hidden_dim": 8,
    "state_encoder_hidden_dim": 8,
    "latent_dim": 8,
    "mlp_dim": 8,
}
KINDS = {
    "act": (ACTConfig, ACT),
    "diffusion": (DiffusionConfig, DIFFUSION),
    "tdmpc": (TDMPCConfig, TDMPC),
    "vqbet": (VQBeTConfig, VQBET),
}


def feature_of(camera: str) -> str:
    """LeRobot's name of a camera; that of PushT's only one, which TD-MPC insists on, has no s."""
    return "observation.image" if camera == "image" else f"observation.images.{camera}"


def save(
    folder: Path,
    kind: str = "act",
    cameras: tuple[str, ...] = CAMERAS,
    joints: int = len(JOINTS),
    size: tuple[int, int] = SIZE,
    mean: np.ndarray | None = None,
    spread: float = 1.0,
    **settings: object,
) -> Path:
    """Make a policy with random weights and save it as LeRobot's training does.

    Args:
        mean, spread: of the state and the actions in its training data.
    """
    made_by, usual = KINDS[kind]
    config = made_by(
        device="cpu",
        input_features={
            "observation.state": PolicyFeature(FeatureType.STATE, (joints,)),
            **{feature_of(name): PolicyFeature(FeatureType.VISUAL, (3, *size)) for name in cameras},
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (joints,))},
        **{**usual, **settings},
    )
    torch.manual_seed(0)
    policy = get_policy_class(kind)(config)
    processors = make_pre_post_processors(config, dataset_stats=statistics(config, mean, spread))
    for part in (policy, *processors):
        part.save_pretrained(folder)
    return folder


def statistics(
    config: ACTConfig | DiffusionConfig, mean: np.ndarray | None = None, spread: float = 1.0
) -> dict[str, dict[str, torch.Tensor]]:
    """Of its training data: feature -> name -> numbers."""
    found: dict[str, dict[str, np.ndarray]] = {}
    for name in ("observation.state", "action"):
        feature = {**config.input_features, **config.output_features}[name]
        middle = fill.normal(f"{name}.mean", feature.shape) if mean is None else mean
        std = spread * fill.uniform(f"{name}.std", feature.shape, 0.2, 1.0)
        found[name] = {
            "mean": middle,
            "std": std,
            "min": middle - 3 * std,
            "max": middle + 3 * std,
        }
    for name in config.image_features:
        numbers = {"mean": 0.4, "std": 0.2, "min": 0.0, "max": 1.0}
        found[name] = {key: np.full((3, 1, 1), value) for key, value in numbers.items()}
    return {
        name: {key: torch.from_numpy(np.float32(value)) for key, value in entry.items()}
        for name, entry in found.items()
    }


def observation(
    number: int, cameras: tuple[str, ...] = CAMERAS, size: tuple[int, int] = SIZE
) -> dict:
    """What a robot sees."""
    return {
        "images": {
            name: fill.integers(f"{name} {number}", (*size, 3), 256).astype(np.uint8)
            for name in cameras
        },
        "qpos": fill.normal(f"state {number}", (len(JOINTS),)),
        "task_description": "pick up the cube",
    }


def features(seen: dict) -> dict[str, np.ndarray]:
    """The same as LeRobot's robots have it."""
    images = {feature_of(name): image.copy() for name, image in seen["images"].items()}
    return {**images, "observation.state": seen["qpos"].copy()}
