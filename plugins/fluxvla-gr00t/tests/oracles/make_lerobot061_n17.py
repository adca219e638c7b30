"""What LeRobot 0.6.1's GR00T N1.7 makes of weights and inputs that our tiny model gets too.

Run from the repository's root in an environment with LeRobot 0.6.1 and transformers 5.5.4:

    HF_HUB_OFFLINE=1 PYTHONPATH=. python plugins/fluxvla-gr00t/tests/oracles/make_lerobot061_n17.py

It writes tests/golden/lerobot061_n17.safetensors. Sizes and inputs are those of
tests/gr00t_sizes.py and tests/test_gr00t_parity.py.

It computes in float64 and stores float32: two processors' float32 differ by up to 1e-5 of a
gradient, and so would a file that was computed in float32. ``bf16.`` is what it gives in float32
with autocast to bfloat16.
"""

from __future__ import annotations

import sys
from importlib.metadata import version
from pathlib import Path
from unittest import mock

import torch
from lerobot.policies.groot import groot_n1_7
from safetensors.torch import save_file
from transformers import Qwen2VLImageProcessor, Qwen3VLConfig
from transformers.feature_extraction_utils import BatchFeature

from tests.oracles import fill

ENVIRONMENT = "lerobot061"
PLACE = 90
GRADIENTS = (
    "action_head.state_encoder.layer1.W",
    "action_head.action_encoder.W2.W",
    "action_head.action_decoder.layer2.b",
    "action_head.model.transformer_blocks.2.attn1.to_v.weight",
    "action_head.model.transformer_blocks.3.norm1.linear.weight",
    "action_head.vl_self_attention.transformer_blocks.1.ff.net.2.weight",
    "action_head.position_embedding.weight",
    "backbone.model.model.language_model.layers.1.self_attn.q_proj.weight",
    "backbone.model.model.language_model.embed_tokens.weight",
    "backbone.model.model.visual.blocks.1.attn.qkv.weight",
    "backbone.model.model.visual.deepstack_merger_list.1.linear_fc2.bias",
    "backbone.model.model.visual.patch_embed.proj.weight",
)


def tiny_backbone() -> Qwen3VLConfig:
    """The tiny Qwen3-VL."""
    return Qwen3VLConfig(
        image_token_id=PLACE,
        video_token_id=PLACE + 1,
        vision_start_token_id=PLACE + 2,
        vision_end_token_id=PLACE + 3,
        tie_word_embeddings=True,
        text_config={
            "head_dim": 8,
            "hidden_size": 16,
            "intermediate_size": 24,
            "num_attention_heads": 4,
            "num_hidden_layers": 5,
            "num_key_value_heads": 2,
            "rms_norm_eps": 1e-6,
            "rope_scaling": {
                "mrope_interleaved": True,
                "mrope_section": [2, 1, 1],
                "rope_type": "default",
            },
            "rope_theta": 5000000,
            "vocab_size": 100,
            "tie_word_embeddings": True,
        },
        vision_config={
            "deepstack_visual_indexes": [0, 2],
            "depth": 4,
            "hidden_size": 16,
            "intermediate_size": 20,
            "num_heads": 2,
            "num_position_embeddings": 16,
            "out_hidden_size": 16,
            "patch_size": 4,
            "spatial_merge_size": 2,
            "temporal_patch_size": 2,
        },
    )


def tiny_model() -> torch.nn.Module:
    """The tiny GR00T N1.7, filled."""
    config = groot_n1_7.GR00TN17Config(
        backbone_embedding_dim=16,
        select_layer=3,
        tune_llm=True,
        tune_visual=True,
        max_state_dim=7,
        max_action_dim=5,
        action_horizon=6,
        hidden_size=12,
        input_embedding_dim=16,
        max_seq_len=10,
        max_num_embodiments=3,
        diffusion_model_cfg={
            "positional_embeddings": None,
            "num_layers": 8,
            "num_attention_heads": 2,
            "attention_head_dim": 8,
            "norm_type": "ada_norm",
            "dropout": 0.2,
            "final_dropout": True,
            "output_dim": 12,
            "interleave_self_attention": True,
        },
        vl_self_attention_cfg={
            "positional_embeddings": None,
            "num_layers": 2,
            "num_attention_heads": 2,
            "attention_head_dim": 8,
            "dropout": 0.2,
            "final_dropout": True,
        },
    )
    with mock.patch.object(groot_n1_7, "_cosmos_reason2_qwen3_vl_config", tiny_backbone):
        model = groot_n1_7.GR00TN17(config, load_backbone_weights=False)
    state = model.state_dict()
    for name, value in state.items():
        if name != "backbone.model.lm_head.weight":
            value.copy_(torch.from_numpy(fill.weight(name, value.shape)))
    return model.double().eval()


def numbers(name: str, shape: tuple[int, ...]) -> torch.Tensor:
    """Normal numbers that float32 holds, as float64."""
    return torch.from_numpy(fill.normal(name, shape)).double()


def inputs(padded: bool) -> dict[str, torch.Tensor]:
    """Two samples of two images of 16 x 16 pixels; ``padded``: the second has fewer words."""
    pictures = torch.from_numpy(fill.normal("pictures", (2, 6, 16, 16))).reshape(4, 3, 16, 16)
    processor = Qwen2VLImageProcessor(
        do_resize=False,
        do_rescale=False,
        do_normalize=False,
        do_convert_rgb=False,
        patch_size=4,
        merge_size=2,
        temporal_patch_size=2,
    )
    seen = processor(list(pictures), return_tensors="pt")
    words = torch.from_numpy(fill.integers("words", (2, 7), PLACE))
    places = torch.full((2, 4), PLACE)
    tokens = torch.cat([words[:, :4], places, words[:, 4:5], places, words[:, 5:]], dim=1)
    mask = torch.ones_like(tokens)
    if padded:
        mask[1, :3] = 0
    return {
        "input_ids": tokens,
        "attention_mask": mask,
        "pixel_values": seen["pixel_values"].double(),
        "image_grid_thw": seen["image_grid_thw"],
    }


def batch(padded: bool) -> BatchFeature:
    """What the head gets; ``padded``: the first sample's last two actions are none."""
    mask = torch.ones(2, 6, 5, dtype=torch.float64)
    mask[..., 4] = 0
    if padded:
        mask[0, 4:] = 0
    return BatchFeature(
        {
            "state": numbers("states", (2, 1, 7)),
            "action": numbers("actions", (2, 6, 5)),
            "action_mask": mask,
            "embodiment_id": torch.tensor([2, 0]),
        }
    )


def results(padded: bool) -> dict[str, torch.Tensor]:
    """Features, loss, gradients and sampled actions."""
    model = tiny_model()
    found: dict[str, torch.Tensor] = {}
    noise = numbers("noise", (2, 6, 5))
    time = torch.from_numpy(fill.uniform("time", (2,))).double()
    seen = model.backbone(BatchFeature(inputs(padded)))
    found["features"] = seen["backbone_features"].detach()
    with (
        mock.patch.object(torch, "randn", return_value=noise),
        mock.patch.object(model.action_head, "sample_time", return_value=time),
    ):
        loss = model.action_head(seen, batch(padded))["loss"]
        loss.backward()
        again = model.backbone(BatchFeature(inputs(padded)))
        actions = model.action_head.get_action(again, batch_to_act())
    found["loss"] = loss.detach()
    found["actions"] = actions["action_pred"].detach()
    parameters = dict(model.named_parameters())
    for name in GRADIENTS:
        found[f"gradient.{name}"] = parameters[name].grad
    return found


def lowered(padded: bool) -> dict[str, torch.Tensor]:
    """Features, loss and sampled actions by autocast to bfloat16."""
    model = tiny_model().float()
    noise = numbers("noise", (2, 6, 5)).float()
    time = torch.from_numpy(fill.uniform("time", (2,)))
    seen, given, asked = (
        BatchFeature({name: _float(value) for name, value in table.items()})
        for table in (inputs(padded), batch(padded), batch_to_act())
    )
    with (
        torch.no_grad(),
        torch.autocast("cpu", torch.bfloat16),
        mock.patch.object(torch, "randn", return_value=noise),
        mock.patch.object(model.action_head, "sample_time", return_value=time),
    ):
        features = model.backbone(seen)
        found = {"features": features["backbone_features"]}
        found["loss"] = model.action_head(features, given)["loss"]
        actions = model.action_head.get_action(model.backbone(seen), asked)
        found["actions"] = actions["action_pred"]
    return found


def _float(value: torch.Tensor) -> torch.Tensor:
    return value.float() if value.is_floating_point() else value


def batch_to_act() -> BatchFeature:
    """What the head gets to act."""
    full = batch(False)
    return BatchFeature({key: full[key] for key in ("state", "embodiment_id")})


def main(folder: Path) -> None:
    torch.set_num_threads(1)
    found = {
        f"{case}.{name}": value.float().contiguous()
        for case, padded in (("even", False), ("padded", True))
        for name, value in results(padded).items()
    }
    for case, padded in (("even", False), ("padded", True)):
        for name, value in lowered(padded).items():
            found[f"bf16.{case}.{name}"] = value.float().contiguous()
    about = {name: version(name) for name in ("lerobot", "transformers", "torch", "diffusers")}
    folder.mkdir(parents=True, exist_ok=True)
    save_file(found, folder / "lerobot061_n17.safetensors", about)


if __name__ == "__main__":
    here = Path(__file__).resolve().parents[1] / "golden"
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else here)
