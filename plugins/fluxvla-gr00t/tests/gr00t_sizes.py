"""Models of GR00T: those of the published files, and tiny ones of the same make."""

from __future__ import annotations

import torch
from fluxvla_gr00t.gr00t import GR00T
from fluxvla_gr00t.names import published_name

from tests.oracles import fill

N15 = {"vlm_backbone": {"type": "EagleBackbone"}, "vla_head": {"type": "GR00TActionHead"}}
N17 = {
    "vlm_backbone": {"type": "Qwen3VLBackbone"},
    "vla_head": {
        "type": "GR00TActionHead",
        "horizon": 40,
        "action_dim": 132,
        "state_dim": 132,
        "layers": 32,
        "future_tokens": 0,
        "attend_text_every": 2,
        "state_dropout": 0.2,
    },
}
PLACE = 90
TINY_HEAD = {
    "type": "GR00TActionHead",
    "horizon": 6,
    "action_dim": 5,
    "state_dim": 7,
    "embodiments": 3,
    "heads": 2,
    "head_dim": 8,
    "hidden_dim": 12,
    "context_layers": 2,
    "context_heads": 2,
    "max_steps": 10,
    "dropout": 0.0,
}
TINY_TEXT = {
    "text_dim": 16,
    "text_heads": 4,
    "text_kv_heads": 2,
    "text_head_dim": 8,
    "text_mlp": 24,
    "vocabulary": 100,
    "image_token": PLACE,
}
TINY_N15 = {
    "type": "GR00T",
    "vlm_backbone": {
        "type": "EagleBackbone",
        "image_size": 28,
        "patch_size": 14,
        "vision_dim": 12,
        "vision_layers": 2,
        "vision_heads": 2,
        "vision_mlp": 20,
        "text_layers": 2,
        **TINY_TEXT,
    },
    "vla_head": {**TINY_HEAD, "layers": 4, "future_tokens": 3},
}
TINY_N17 = {
    "type": "GR00T",
    "vlm_backbone": {
        "type": "Qwen3VLBackbone",
        "patch_size": 4,
        "merge": 2,
        "vision_dim": 16,
        "vision_layers": 4,
        "vision_heads": 2,
        "vision_mlp": 20,
        "vision_positions": 16,
        "deepstack": [0, 2],
        "text_layers": 3,
        "rope_sections": [2, 1, 1],
        **TINY_TEXT,
    },
    "vla_head": {**TINY_HEAD, "layers": 8, "future_tokens": 0, "attend_text_every": 2},
}
VERSIONS = {"n1.5": (N15, TINY_N15), "n1.7": (N17, TINY_N17)}


def published(version: str) -> GR00T:
    """The model of the published files, without memory."""
    with torch.device("meta"):
        return GR00T(**VERSIONS[version][0])


def tiny(
    version: str,
    freeze_vlm_backbone: bool = False,
    prefix_conditioning: bool = False,
    **head: object,
) -> GR00T:
    """A tiny model whose weights follow from their published names."""
    table = VERSIONS[version][1]
    model = GR00T(
        table["vlm_backbone"],
        {**table["vla_head"], **head},
        freeze_vlm_backbone,
        prefix_conditioning=prefix_conditioning,
    )
    filled = {
        name: torch.from_numpy(fill.weight(published_name(name, version), value.shape))
        for name, value in model.state_dict().items()
    }
    model.load_state_dict(filled)
    return model.eval()
