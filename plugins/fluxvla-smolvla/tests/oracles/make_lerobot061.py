"""What LeRobot 0.6.1 computes with a tiny SmolVLA: losses, gradients, actions, preprocessing.

    HF_HUB_OFFLINE=1 OMP_NUM_THREADS=1 PYTHONPATH=. PYTHON \
        plugins/fluxvla-smolvla/tests/oracles/make_lerobot061.py [FOLDER]

PYTHON is that of an environment with LeRobot 0.6.1 and transformers 5.5.4 (``nox -s oracles`` makes
it). FOLDER gets ``smolvla.safetensors`` (results) and the small files of what LeRobot's
``save_pretrained`` writes of the policy; its weights follow from their names by ``fill.weight``.

LeRobot asks the hub for the sizes of SmolVLM2 and for its tokenizer; here it is given small ones.

``bf16.`` is what it computes in bfloat16: losses and gradients by autocast, as it trains, and
actions with its vision-language model in bfloat16, as it loads that one from the hub.
"""

from __future__ import annotations

import importlib.metadata
import shutil
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import tokenizers
import torch
import transformers
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.smolvla import smolvlm_with_expert
from lerobot.policies.smolvla.configuration_smolvla import SmolVLAConfig
from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy
from lerobot.policies.smolvla.processor_smolvla import make_smolvla_pre_post_processors
from safetensors.torch import save_file
from transformers import SmolVLMConfig

from tests.oracles import fill

ENVIRONMENT = "lerobot061"
BACKBONE = "a tiny SmolVLM"
CAMERAS = {"front": (48, 80), "wrist": (60, 40)}
STATE, ACTION, HORIZON, WIDTH = 6, 5, 7, 32
SIDE = 64
TASKS = ["pick up the cube", "put it down, gently", "wave\n"]
KEPT = (
    "state_proj.bias",
    "action_in_proj.bias",
    "action_time_mlp_in.bias",
    "action_out_proj.weight",
    "lm_expert.layers.0.self_attn.k_proj.weight",
    "lm_expert.layers.1.self_attn.k_proj.weight",
    "lm_expert.layers.3.input_layernorm.weight",
    "text_model.layers.0.self_attn.k_proj.weight",
    "text_model.layers.2.post_attention_layernorm.weight",
    "vision_model.embeddings.patch_embedding.bias",
    "vision_model.encoder.layers.1.mlp.fc1.bias",
)
"""Endings of the names whose gradients are stored whole; the norms of all are, by sorted names."""


def tiny_backbone() -> SmolVLMConfig:
    return SmolVLMConfig(
        vision_config={
            "hidden_size": 64,
            "intermediate_size": 96,
            "num_hidden_layers": 2,
            "num_attention_heads": 1,
            "image_size": SIDE,
            "patch_size": 8,
        },
        text_config={
            "model_type": "llama",
            "hidden_size": 128,
            "intermediate_size": 160,
            "num_hidden_layers": 6,
            "num_attention_heads": 2,
            "num_key_value_heads": 1,
            "head_dim": 64,
            "vocab_size": 300,
            "rms_norm_eps": 1e-5,
        },
        scale_factor=2,
        tie_word_embeddings=False,
    )


def make_policy(**settings: object) -> SmolVLAPolicy:
    processor = SimpleNamespace(
        tokenizer=SimpleNamespace(fake_image_token_id=1, global_image_token_id=2)
    )
    smolvlm_with_expert.AutoConfig = SimpleNamespace(from_pretrained=lambda _: tiny_backbone())
    smolvlm_with_expert.AutoProcessor = SimpleNamespace(from_pretrained=lambda _: processor)
    config = SmolVLAConfig(
        input_features={
            "observation.state": PolicyFeature(FeatureType.STATE, (STATE,)),
            **{
                f"observation.images.{name}": PolicyFeature(FeatureType.VISUAL, (3, *shape))
                for name, shape in CAMERAS.items()
            },
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (ACTION,))},
        device="cpu",
        chunk_size=HORIZON,
        n_action_steps=HORIZON,
        num_steps=4,
        num_vlm_layers=4,
        resize_imgs_with_padding=(SIDE, SIDE),
        vlm_model_name=BACKBONE,
        **settings,
    )
    policy = SmolVLAPolicy(config)
    with torch.no_grad():
        for name, tensor in policy.state_dict().items():
            tensor.copy_(torch.from_numpy(fill.weight(name, tensor.shape)))
    return policy


def make_statistics() -> dict[str, dict[str, torch.Tensor]]:
    found = {}
    for key, width in (("observation.state", STATE), ("action", ACTION)):
        mean = fill.normal(f"{key} mean", (width,))
        std = fill.uniform(f"{key} std", (width,), 0.05, 2.0)
        found[key] = {"mean": torch.from_numpy(mean), "std": torch.from_numpy(std)}
    return found


def byte_tokenizer(folder: Path) -> None:
    """One token a byte, the same for everybody."""
    letters = sorted(tokenizers.pre_tokenizers.ByteLevel.alphabet())
    vocabulary = {"<pad>": 0, **{letter: 10 + i for i, letter in enumerate(letters)}}
    model = tokenizers.models.BPE(vocabulary, [])
    made = tokenizers.Tokenizer(model)
    made.pre_tokenizer = tokenizers.pre_tokenizers.ByteLevel(add_prefix_space=False)
    fast = transformers.PreTrainedTokenizerFast(tokenizer_object=made, pad_token="<pad>")
    fast.save_pretrained(folder)


def model_batch() -> dict[str, torch.Tensor]:
    """Inputs of the model itself; the second sample lacks a camera, two have shorter chunks."""
    size = 3
    lengths = np.array([9, 4, 12])
    batch = {
        f"observation.images.{name}": fill.uniform(f"batch {name}", (size, 3, SIDE, SIDE))
        for name in CAMERAS
    }
    shown = np.array([True, False, True])
    batch["observation.images.wrist_padding_mask"] = shown
    batch["observation.state"] = fill.normal("batch state", (size, STATE))
    batch["action"] = fill.normal("batch action", (size, HORIZON, ACTION))
    batch["action_is_pad"] = np.arange(HORIZON) >= np.array([[7], [5], [2]])
    batch["observation.language.tokens"] = fill.integers("batch tokens", (size, 12), 300)
    batch["observation.language.attention_mask"] = np.arange(12) < lengths[:, None]
    return {key: torch.from_numpy(value) for key, value in batch.items()}


def noise_of(size: int) -> torch.Tensor:
    return torch.from_numpy(fill.normal("noise", (size, HORIZON, WIDTH)))


def train_once(name: str, policy: SmolVLAPolicy, results: dict[str, torch.Tensor]) -> None:
    batch = model_batch()
    # A grid on which 1 - t is exact: the shortest period is 0.004.
    time = torch.tensor([3.0, 2500.0, 4000.0]) / 4096
    loss, _ = policy.forward(batch, noise_of(3), time)
    policy.zero_grad()
    loss.backward()
    each, _ = policy.forward(batch, noise_of(3), time, reduction="none")
    results[f"{name}.loss"], results[f"{name}.sample_losses"] = loss.detach(), each.detach()
    gradients = {n: p.grad for n, p in policy.named_parameters() if p.grad is not None}
    results[f"{name}.norms"] = torch.stack([gradients[n].norm() for n in sorted(gradients)])
    for parameter, gradient in gradients.items():
        if parameter.endswith(KEPT):
            results[f"{name}.gradient.{parameter}"] = gradient.clone()


def narrow(policy: SmolVLAPolicy) -> SmolVLAPolicy:
    """``policy`` with the vision-language model in bfloat16, and nothing else."""
    policy.model.vlm_with_expert.vlm.to(torch.bfloat16)
    return policy


def act(policy: SmolVLAPolicy, folder: Path, results: dict[str, torch.Tensor]) -> None:
    """Raw observations to joint commands, through LeRobot's processors."""
    lower = narrow(make_policy(empty_cameras=1).eval())
    byte_tokenizer(folder / "tokenizer")
    policy.config.vlm_model_name = str(folder / "tokenizer")
    before, after = make_smolvla_pre_post_processors(policy.config, make_statistics())
    policy.config.vlm_model_name = BACKBONE
    for number, task in enumerate(TASKS):
        pictures = {
            name: fill.integers(f"picture {name} {number}", (*shape, 3), 256).astype(np.uint8)
            for name, shape in CAMERAS.items()
        }
        if number == 2:
            del pictures["wrist"]
        observation = {
            f"observation.images.{name}": torch.from_numpy(picture).permute(2, 0, 1) / 255
            for name, picture in pictures.items()
        }
        state = fill.normal(f"state {number}", (STATE,))
        prepared = before(
            {**observation, "observation.state": torch.from_numpy(state), "task": task}
        )
        images, masks = policy.prepare_images(prepared)
        results[f"act.{number}.tokens"] = prepared["observation.language.tokens"][0]
        results[f"act.{number}.states"] = policy.prepare_state(prepared)[0]
        results[f"act.{number}.img_masks"] = torch.cat(masks)
        if number == 0:
            results["act.0.images"] = torch.cat(images)[:, :, ::2, ::2]
        actions = policy.predict_action_chunk(prepared, noise_of(1))
        results[f"act.{number}.normalized"] = actions[0]
        results[f"act.{number}.actions"] = after(actions)[0]
        actions = lower.predict_action_chunk(prepared, noise_of(1))
        results[f"bf16.act.{number}.actions"] = after(actions)[0].float()
    save_folder(policy, folder, before, after)


def save_folder(policy: SmolVLAPolicy, folder: Path, before: object, after: object) -> None:
    before.steps[3].tokenizer_name = BACKBONE
    saved = folder / "saved"
    policy.save_pretrained(saved)
    before.save_pretrained(saved)
    after.save_pretrained(saved)


def main() -> None:
    torch.set_num_threads(1)
    golden = Path(__file__).parent.parent / "golden"
    out = Path(sys.argv[1]) if len(sys.argv) > 1 else golden
    results: dict[str, torch.Tensor] = {}
    train_once("expert", make_policy(), results)
    whole = make_policy(train_expert_only=False, freeze_vision_encoder=False)
    train_once("whole", whole, results)
    lower: dict[str, torch.Tensor] = {}
    with torch.autocast("cpu", torch.bfloat16):
        train_once("whole", whole, lower)
    results |= {f"bf16.{name}": lower[name].float() for name in ("whole.loss", "whole.norms")}
    sparse = make_policy(attention_mode="self_attn", num_expert_layers=2)
    train_once("sparse", sparse, results)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        act(make_policy(empty_cameras=1).eval(), folder, results)
        for file in (folder / "saved").iterdir():
            if file.name != "model.safetensors":
                shutil.copyfile(file, out / file.name)
    versions = {n: importlib.metadata.version(n) for n in ("lerobot", "transformers", "torch")}
    contiguous = {name: tensor.contiguous() for name, tensor in results.items()}
    save_file(contiguous, out / "smolvla.safetensors", metadata=versions)


if __name__ == "__main__":
    main()
