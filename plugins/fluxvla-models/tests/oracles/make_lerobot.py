"""What LeRobot's ACT and Diffusion Policy compute with weights and inputs that follow from names.

    nox -s oracles, or:
    PYTHONPATH=. $(python -m tools.oracle_env) plugins/fluxvla-models/tests/oracles/make_lerobot.py

For each case ``<case>.safetensors`` has the loss of a batch, some gradients, the actions and the
commands that follow from a raw image and joint state; its metadata has the names and shapes of
the policy's tensors. ``<case>/`` is what LeRobot saves of it, without the weights.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from unittest import mock

import diffusers
import lerobot
import numpy as np
import torch
from diffusers import DDIMScheduler, DDPMScheduler
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy
from lerobot.policies.factory import make_pre_post_processors
from safetensors.numpy import save_file

from tests.oracles import fill

ENVIRONMENT = "lerobot061"

BATCH, JOINTS = 3, 6
CAMERAS = ("front", "wrist")
GRADIENTS = {
    "act": (
        "model.vae_encoder.layers.0.self_attn.in_proj_weight",
        "model.vae_encoder_latent_output_proj.weight",
        "model.backbone.layer1.0.conv1.weight",
        "model.encoder.layers.0.linear1.weight",
        "model.decoder.layers.0.multihead_attn.in_proj_weight",
        "model.decoder_pos_embed.weight",
    ),
    "diffusion": (
        "diffusion.unet.down_modules.0.0.cond_encoder.1.weight",
        "diffusion.unet.mid_modules.0.conv1.block.0.weight",
        "diffusion.unet.up_modules.0.0.residual_conv.weight",
        "diffusion.unet.final_conv.1.weight",
    ),
}
SHOWN = 4096
"""So many numbers of a gradient are kept, evenly spaced."""


def features(
    size: tuple[int, int], cameras: tuple[str, ...]
) -> dict[str, dict[str, PolicyFeature]]:
    pictures = {
        f"observation.images.{name}": PolicyFeature(FeatureType.VISUAL, (3, *size))
        for name in cameras
    }
    state = PolicyFeature(FeatureType.STATE, (JOINTS,))
    return {
        "input_features": {"observation.state": state, **pictures},
        "output_features": {"action": PolicyFeature(FeatureType.ACTION, (JOINTS,))},
    }


def cases() -> dict[str, ACTConfig | DiffusionConfig]:
    act = {
        "device": "cpu",
        "chunk_size": 8,
        "n_action_steps": 5,
        "pretrained_backbone_weights": None,
        "dim_model": 32,
        "n_heads": 4,
        "dim_feedforward": 48,
        "n_encoder_layers": 2,
        "n_vae_encoder_layers": 2,
        "latent_dim": 6,
        "dropout": 0.0,
    }
    diffusion = {
        "device": "cpu",
        "n_obs_steps": 1,
        "horizon": 8,
        "n_action_steps": 5,
        "pretrained_backbone_weights": None,
        "use_group_norm": True,
        "spatial_softmax_num_keypoints": 8,
        "down_dims": (16, 32),
        "diffusion_step_embed_dim": 16,
        "num_inference_steps": 5,
        "crop_is_random": False,
    }
    two, one = features((72, 96), CAMERAS), features((72, 96), CAMERAS[:1])
    return {
        "lerobot_act": ACTConfig(**act, **two),
        "lerobot_act_pre_norm": ACTConfig(
            **{**act, "pre_norm": True, "n_decoder_layers": 2, "use_vae": False}, **one
        ),
        "lerobot_diffusion": DiffusionConfig(**diffusion, **two),
        "lerobot_diffusion_shared": DiffusionConfig(
            **{
                **diffusion,
                "noise_scheduler_type": "DDIM",
                "prediction_type": "sample",
                "use_separate_rgb_encoder_per_camera": False,
                "use_group_norm": False,
                "use_film_scale_modulation": False,
                "resize_shape": (80, 90),
                "crop_ratio": 0.9,
                "do_mask_loss_for_padding": True,
            },
            **two,
        ),
        "lerobot_diffusion_history": DiffusionConfig(**{**diffusion, "n_obs_steps": 2}, **one),
    }


def filled(name: str, shape: tuple[int, ...]) -> np.ndarray:
    """A weight by its name; a running variance is positive, and a norm's scale about 1, so that
    gradients are no rounding errors of what comes after it."""
    if name.endswith("running_var"):
        return fill.uniform(name, shape, 0.5, 1.5)
    scale = len(shape) == 1 and name.endswith(".weight")
    return fill.weight(name, shape) + np.float32(scale)


def statistics(config: ACTConfig | DiffusionConfig) -> dict[str, dict[str, torch.Tensor]]:
    found = {}
    for name in ("observation.state", "action"):
        mean = fill.normal(f"{name}.mean", (JOINTS,))
        std = fill.uniform(f"{name}.std", (JOINTS,), 0.2, 2.0)
        found[name] = {"mean": mean, "std": std, "min": mean - 3 * std, "max": mean + 2 * std}
    for name in config.image_features:
        mean = fill.uniform(f"{name}.mean", (3, 1, 1), 0.3, 0.6)
        std = fill.uniform(f"{name}.std", (3, 1, 1), 0.2, 0.3)
        found[name] = {"mean": mean, "std": std, "min": mean - 1, "max": mean + 1}
    return {
        name: {key: torch.from_numpy(value) for key, value in entry.items()}
        for name, entry in found.items()
    }


def batch_of(config: ACTConfig | DiffusionConfig, horizon: int) -> dict[str, torch.Tensor]:
    """Normalised; the second sample's chunk goes beyond the end of its episode."""
    steps = config.n_obs_steps
    history = () if isinstance(config, ACTConfig) else (steps,)
    padded = torch.zeros(BATCH, horizon, dtype=torch.bool)
    padded[1, horizon - 3 :] = True
    batch = {
        "observation.state": fill.normal("states", (BATCH, *history, JOINTS)),
        "action": fill.normal("actions", (BATCH, horizon, JOINTS)),
    }
    for name, feature in config.image_features.items():
        batch[name] = fill.normal(name, (BATCH, *history, *feature.shape))
    return {**{k: torch.from_numpy(v) for k, v in batch.items()}, "action_is_pad": padded}


def spread(values: torch.Tensor) -> np.ndarray:
    flat = values.detach().flatten().numpy()
    return np.ascontiguousarray(flat[:: -(-len(flat) // SHOWN)])


def seen(config: ACTConfig | DiffusionConfig, step: int | None = None) -> dict[str, torch.Tensor]:
    """A raw observation, of a step of an episode if it is given."""
    at = "raw" if step is None else f"raw {step}"
    found = {"observation.state": torch.from_numpy(fill.normal(f"{at} state", (JOINTS,)))}
    for name, feature in config.image_features.items():
        pixels = fill.integers(f"{at} {name}", (*feature.shape[1:], 3), 256).astype(np.uint8)
        found[name] = torch.from_numpy(pixels).permute(2, 0, 1).float() / 255
    return found


def made(case: str, config: ACTConfig | DiffusionConfig, folder: Path) -> None:
    act = isinstance(config, ACTConfig)
    policy = (ACTPolicy if act else DiffusionPolicy)(config)
    state = policy.state_dict()
    constants = ("vae_encoder_pos_enc", "pos_grid", "num_batches_tracked")
    for name, tensor in state.items():
        if not name.endswith(constants):
            tensor.copy_(torch.from_numpy(filled(name, tuple(tensor.shape))))
    horizon = config.chunk_size if act else config.horizon
    batch = batch_of(config, horizon)
    arrays: dict[str, np.ndarray] = {}

    policy.train()
    for module in policy.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            module.eval()
    latent = torch.from_numpy(
        fill.normal("latent_noise", (BATCH, getattr(config, "latent_dim", 1)))
    )
    eps = torch.from_numpy(fill.normal("noise", (BATCH, horizon, JOINTS)))
    steps = torch.from_numpy(fill.integers("timesteps", (BATCH,), 100))
    with (
        mock.patch("torch.randn_like", return_value=latent),
        mock.patch("torch.randn", return_value=eps),
        mock.patch("torch.randint", return_value=steps),
    ):
        loss, parts = policy.forward(dict(batch))
    loss.backward()
    arrays["loss"] = loss.detach().numpy().reshape(1)
    for key, value in (parts or {}).items():
        arrays[key] = np.array([value], np.float32)
    gradients = {name: p.grad for name, p in policy.named_parameters()}
    for name in GRADIENTS["act" if act else "diffusion"]:
        if name in gradients:
            arrays[f"gradient {name}"] = spread(gradients[name])

    policy.eval()
    asked = {k: v for k, v in batch.items() if k.startswith("observation")}
    added = iter([])

    def following(*args: object, **more: object) -> torch.Tensor:
        return next(added)

    def noises(rows: int) -> list[torch.Tensor]:
        drawn = fill.normal("step_noise", (BATCH, config.num_inference_steps - 1, horizon, JOINTS))
        return [torch.from_numpy(drawn[:rows, i].copy()) for i in range(drawn.shape[1])]

    with mock.patch("diffusers.schedulers.scheduling_ddpm.randn_tensor", following):
        if act:
            arrays["actions"] = policy.predict_action_chunk(asked).numpy()
        else:
            added = iter(noises(BATCH))
            arrays["actions"] = policy.predict_action_chunk(asked, noise=eps).numpy()

        before, after = make_pre_post_processors(config, dataset_stats=statistics(config))
        ready = before(seen(config))
        if act:
            chunk = policy.predict_action_chunk(ready)
            arrays["commands"] = after(chunk)[0].numpy()
        elif config.n_obs_steps == 1:
            added = iter(noises(1))
            ready = {k: v[:, None] if k in config.input_features else v for k, v in ready.items()}
            chunk = policy.predict_action_chunk(ready, noise=eps[:1])
            arrays["commands"] = after(chunk)[0].numpy()
        else:
            # An episode of two chunks, asked at every step as LeRobot's evaluation does.
            used = config.n_action_steps
            added, rows = iter([*noises(1), *noises(1)]), []
            for step in range(2 * used):
                chosen = policy.select_action(before(seen(config, step)), noise=eps[:1])
                rows.append(after(chosen)[0].numpy())
            arrays["commands"] = np.stack(rows)

    saved = folder / case
    saved.mkdir(parents=True, exist_ok=True)
    config._save_pretrained(saved)
    before.save_pretrained(saved)
    after.save_pretrained(saved)
    (saved / "README.md").unlink(missing_ok=True)
    shapes = {name: list(tensor.shape) for name, tensor in state.items()}
    save(arrays, folder / f"{case}.safetensors", names=json.dumps(shapes))


def schedulers(folder: Path) -> None:
    """Every kind of schedule of diffusers that a policy may be trained with, step by step."""
    arrays: dict[str, np.ndarray] = {}
    x = torch.from_numpy(fill.normal("x", (2, 4, 3)))
    output = torch.from_numpy(fill.normal("output", (2, 4, 3)))
    noise = torch.from_numpy(fill.normal("added", (2, 4, 3)))
    for kind, made_by in (("DDPM", DDPMScheduler), ("DDIM", DDIMScheduler)):
        for beta_schedule in ("linear", "scaled_linear", "squaredcos_cap_v2"):
            for prediction in ("epsilon", "sample"):
                for clip in (True, False):
                    scheduler = made_by(
                        num_train_timesteps=100,
                        beta_schedule=beta_schedule,
                        prediction_type=prediction,
                        clip_sample=clip,
                    )
                    scheduler.set_timesteps(7)
                    key = f"{kind} {beta_schedule} {prediction} {clip}"
                    found = []
                    with mock.patch(
                        "diffusers.schedulers.scheduling_ddpm.randn_tensor", return_value=noise
                    ):
                        for step in scheduler.timesteps:
                            found.append(scheduler.step(output, step, x).prev_sample)
                    arrays[f"{key} timesteps"] = scheduler.timesteps.numpy()
                    arrays[f"{key} steps"] = torch.stack(found).numpy()
                    noisy = scheduler.add_noise(x, noise, torch.tensor([3, 97]))
                    arrays[f"{key} noisy"] = noisy.numpy()
    save(arrays, folder / "diffusers_schedulers.safetensors")


def save(arrays: dict[str, np.ndarray], path: Path, **more: str) -> None:
    versions = {
        "lerobot": lerobot.__version__,
        "diffusers": diffusers.__version__,
        "torch": torch.__version__,
    }
    save_file({k: np.ascontiguousarray(v) for k, v in arrays.items()}, path, {**versions, **more})


def main() -> None:
    torch.set_num_threads(1)
    torch.manual_seed(0)
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parents[1] / "golden")
    folder.mkdir(parents=True, exist_ok=True)
    schedulers(folder)
    for case, config in cases().items():
        made(case, config, folder)


if __name__ == "__main__":
    main()
