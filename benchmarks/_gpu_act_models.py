"""The policies that ``gpu_act.py`` measures: PI0.5 and GR00T N1.5 with random weights, and tiny
ones of the same make. Sizes and inputs follow from the case and the seed alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from fluxvla_core.build import build_vla_from_cfg

SIZES = ("full", "tiny")
PROMPT = 200
GR00T_PROMPT = 64
_TINY_GEMMA = {"depth": 2, "heads": 2, "kv_heads": 1, "head_dim": 16}
_TINY_PI05 = {
    "variant": {**_TINY_GEMMA, "width": 32, "mlp_dim": 48},
    "expert_variant": {**_TINY_GEMMA, "width": 24, "mlp_dim": 32},
    "vision_variant": {
        "width": 16, "depth": 2, "mlp_dim": 24, "heads": 2, "image_size": 28, "patch_size": 14,
    },
    "vocab_size": 97,
}  # fmt: skip
_TINY_EAGLE = {
    "image_size": 28, "patch_size": 14, "vision_dim": 16, "vision_layers": 2, "vision_heads": 2,
    "vision_mlp": 24, "text_dim": 16, "text_layers": 2, "text_heads": 2, "text_kv_heads": 1,
    "text_head_dim": 8, "text_mlp": 24, "vocabulary": 100, "image_token": 90,
}  # fmt: skip
_TINY_HEAD = {
    "embodiments": 2, "layers": 4, "heads": 2, "head_dim": 8, "hidden_dim": 12,
    "context_layers": 1, "context_heads": 2, "future_tokens": 3,
}  # fmt: skip


@dataclass(frozen=True)
class Case:
    """One policy.

    Args:
        family: ``pi05`` or ``gr00t``.
        cameras: pictures of an observation.
        goal_ms: what p50 is to stay below on one H200.
    """

    family: str
    cameras: int
    goal_ms: float

    @property
    def name(self) -> str:
        """As results have it."""
        return f"{self.family}, {self.cameras} cameras"

    def model(self, size: str, device: str) -> Any:
        """Weights are drawn on the device, which takes a GPU a second and a CPU a minute."""
        tiny = size == "tiny"
        torch.manual_seed(0)
        with torch.device(device):
            if self.family == "pi05":
                return build_vla_from_cfg(
                    {"type": "PI05FlowMatching", "num_steps": 10, **(_TINY_PI05 if tiny else {})}
                ).eval()
            return build_vla_from_cfg(
                {
                    "type": "GR00T",
                    "vlm_backbone": {"type": "EagleBackbone", **(_TINY_EAGLE if tiny else {})},
                    "vla_head": {"type": "GR00TActionHead", **(_TINY_HEAD if tiny else {})},
                }
            ).eval()

    def batch(self, model: Any, seed: int) -> dict[str, Tensor]:
        """An observation and noise on the host, a prompt being as long as its budget."""
        drawn = torch.Generator().manual_seed(seed)
        horizon, width = model.action_shape
        found = {"noise": torch.randn(1, horizon, width, generator=drawn)}
        if self.family == "pi05":
            side, words = model.vision_backbone.size.image_size, PROMPT
            tokens = torch.randint(0, 90, (1, words), generator=drawn)
            found["states"] = torch.zeros(1, width)
        else:
            backbone = model.vlm_backbone
            side, words = backbone.image_size, GR00T_PROMPT
            text = torch.randint(0, 90, (1, words), generator=drawn)
            count = self.cameras * backbone.tokens_per_image
            image = torch.full((1, count), backbone.image_token)
            tokens = torch.cat([text[:, :8], image, text[:, 8:]], dim=1)
            found["states"] = torch.randn(1, model.vla_head.state_dim, generator=drawn)
        seen = torch.ones(tokens.shape, dtype=torch.bool)
        seen[:, -words // 4 :] = False
        pictures = torch.rand(1, 3 * self.cameras, side, side, generator=drawn) * 2 - 1
        return {**found, "images": pictures, "lang_tokens": tokens, "lang_masks": seen}


CASES = (Case("pi05", 2, 20.0), Case("pi05", 3, 20.0), Case("gr00t", 2, 15.0))
