"""What LeRobot 0.4.4's GR00T N1.5 makes of weights and inputs that our tiny model gets too.

Run from the repository's root in an environment with LeRobot 0.4.4 and transformers 4.57.6:

    HF_HUB_OFFLINE=1 PYTHONPATH=. python plugins/fluxvla-gr00t/tests/oracles/make_lerobot044_n15.py

It writes tests/golden/lerobot044_n15.safetensors. Sizes and inputs are those of
tests/gr00t_sizes.py and tests/test_gr00t_parity.py. The backbone is put together from LeRobot's
Eagle model with transformers' SigLIP and Qwen3, as its own constructor does; that one would fetch
a config and insists on flash attention, which a CPU has not.

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
from lerobot.policies.groot.action_head.flow_matching_action_head import (
    FlowmatchingActionHead,
    FlowmatchingActionHeadConfig,
)
from lerobot.policies.groot.eagle2_hg_model.configuration_eagle2_5_vl import Eagle25VLConfig
from lerobot.policies.groot.eagle2_hg_model.modeling_eagle2_5_vl import (
    Eagle25VLForConditionalGeneration,
)
from lerobot.policies.groot.groot_n1 import EagleBackbone
from safetensors.torch import save_file
from torch import nn
from transformers import Qwen3ForCausalLM, SiglipVisionModel
from transformers.feature_extraction_utils import BatchFeature

from tests.oracles import fill

ENVIRONMENT = "lerobot044"
PLACE = 90
GRADIENTS = (
    "action_head.state_encoder.layer1.W",
    "action_head.action_encoder.W2.W",
    "action_head.action_decoder.layer2.b",
    "action_head.model.transformer_blocks.2.attn1.to_v.weight",
    "action_head.model.transformer_blocks.3.norm1.linear.weight",
    "action_head.vl_self_attention.transformer_blocks.1.ff.net.2.weight",
    "action_head.position_embedding.weight",
    "action_head.future_tokens.weight",
    "backbone.eagle_model.language_model.model.layers.1.mlp.gate_proj.weight",
    "backbone.eagle_model.language_model.model.embed_tokens.weight",
    "backbone.eagle_model.vision_model.vision_model.encoder.layers.1.self_attn.v_proj.weight",
    "backbone.eagle_model.mlp1.0.weight",
)


class Tiny(nn.Module):
    """The two parts under their published names, filled."""

    def __init__(self) -> None:
        super().__init__()
        config = Eagle25VLConfig(
            vision_config={
                "model_type": "siglip_vision_model",
                "hidden_size": 12,
                "image_size": 28,
                "intermediate_size": 20,
                "num_attention_heads": 2,
                "num_hidden_layers": 2,
                "patch_size": 14,
            },
            text_config={
                "architectures": ["Qwen3ForCausalLM"],
                "hidden_size": 16,
                "intermediate_size": 24,
                "head_dim": 8,
                "num_attention_heads": 4,
                "num_hidden_layers": 4,
                "num_key_value_heads": 2,
                "rms_norm_eps": 1e-6,
                "rope_theta": 1000000.0,
                "vocab_size": 100,
                "use_cache": False,
            },
            select_layer=-1,
            use_pixel_shuffle=False,
            mlp_connector_layers=1,
            image_token_index=PLACE,
            _attn_implementation="sdpa",
        )
        config.vision_config._attn_implementation = "sdpa"
        config.text_config._attn_implementation = "sdpa"
        self.backbone = EagleBackbone.__new__(EagleBackbone)
        nn.Module.__init__(self.backbone)
        self.backbone.eagle_model = Eagle25VLForConditionalGeneration(
            config, SiglipVisionModel(config.vision_config), Qwen3ForCausalLM(config.text_config)
        )
        self.backbone.eagle_linear = nn.Identity()
        self.backbone.select_layer = 2
        layers = self.backbone.eagle_model.language_model.model.layers
        while len(layers) > self.backbone.select_layer:
            layers.pop(-1)
        self.backbone.set_trainable_parameters(tune_llm=True, tune_visual=True)
        self.action_head = FlowmatchingActionHead(
            FlowmatchingActionHeadConfig(
                backbone_embedding_dim=16,
                max_state_dim=7,
                action_dim=5,
                action_horizon=6,
                hidden_size=12,
                input_embedding_dim=16,
                max_seq_len=10,
                max_num_embodiments=3,
                num_inference_timesteps=4,
                num_target_vision_tokens=3,
                diffusion_model_cfg={
                    "positional_embeddings": None,
                    "num_layers": 4,
                    "num_attention_heads": 2,
                    "attention_head_dim": 8,
                    "norm_type": "ada_norm",
                    "dropout": 0.2,
                    "final_dropout": True,
                    "output_dim": 12,
                    "interleave_self_attention": True,
                    "cross_attention_dim": 16,
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
        )
        for name, value in self.state_dict().items():
            value.copy_(torch.from_numpy(fill.weight(name, value.shape)))
        self.double().eval()


def numbers(name: str, shape: tuple[int, ...]) -> torch.Tensor:
    """Normal numbers that float32 holds, as float64."""
    return torch.from_numpy(fill.normal(name, shape)).double()


def inputs(padded: bool) -> BatchFeature:
    """Two samples of two images of 28 x 28 pixels; ``padded``: the second has fewer words."""
    words = torch.from_numpy(fill.integers("words", (2, 7), PLACE))
    places = torch.full((2, 4), PLACE)
    tokens = torch.cat([words[:, :4], places, words[:, 4:5], places, words[:, 5:]], dim=1)
    mask = torch.ones_like(tokens)
    if padded:
        mask[1, :3] = 0
    pictures = numbers("pictures", (2, 6, 28, 28))
    return BatchFeature(
        {
            "eagle_input_ids": tokens,
            "eagle_attention_mask": mask,
            "eagle_pixel_values": pictures.reshape(4, 3, 28, 28),
            "eagle_image_sizes": None,
        }
    )


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
    model = Tiny()
    found: dict[str, torch.Tensor] = {}
    noise = numbers("noise", (2, 6, 5))
    time = torch.from_numpy(fill.uniform("time", (2,))).double()
    seen = model.backbone(inputs(padded))
    found["features"] = seen["backbone_features"].detach()
    with (
        mock.patch.object(torch, "randn", return_value=noise),
        mock.patch.object(model.action_head, "sample_time", return_value=time),
    ):
        loss = model.action_head(seen, batch(padded))["loss"]
        loss.backward()
        again = model.backbone(inputs(padded))
        actions = model.action_head.get_action(again, batch(False))
    found["loss"] = loss.detach()
    found["actions"] = actions["action_pred"].detach()
    parameters = dict(model.named_parameters())
    for name in GRADIENTS:
        found[f"gradient.{name}"] = parameters[name].grad
    return found


def lowered(padded: bool) -> dict[str, torch.Tensor]:
    """Features, loss and sampled actions by autocast to bfloat16."""
    model = Tiny().float()
    noise = numbers("noise", (2, 6, 5)).float()
    time = torch.from_numpy(fill.uniform("time", (2,)))
    seen, given, asked = (
        BatchFeature({name: _float(value) for name, value in table.items()})
        for table in (inputs(padded), batch(padded), batch(False))
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


def _float(value: torch.Tensor | None) -> torch.Tensor | None:
    return value.float() if value is not None and value.is_floating_point() else value


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
    save_file(found, folder / "lerobot044_n15.safetensors", about)


if __name__ == "__main__":
    here = Path(__file__).resolve().parents[1] / "golden"
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else here)
