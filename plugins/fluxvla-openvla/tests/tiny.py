"""The models of ``oracles/make_openvla*.py``, made here and filled by the same published names."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from fluxvla_openvla.openvla import OpenVLA
from fluxvla_openvla.openvla_oft import OpenVLAOFT
from safetensors.numpy import load_file

from tests.oracles import fill

HERE = Path(__file__).parent
TOWERS = {
    "image_size": 28,
    "dino": {"width": 32, "depth": 3, "num_heads": 2, "mlp_width": 64},
    "siglip": {"width": 48, "depth": 3, "num_heads": 3, "mlp_width": 96},
}
LANGUAGE = {
    "hidden_size": 32,
    "intermediate_size": 64,
    "num_hidden_layers": 2,
    "num_attention_heads": 2,
    "num_key_value_heads": 2,
}
SIZES = {**TOWERS, "language": LANGUAGE}
SMALL = {**TOWERS, "language": {**LANGUAGE, "vocab_size": 416, "text_vocab_size": 384}}
"""With a vocabulary of 384 + 32."""


def golden(name: str) -> dict[str, np.ndarray]:
    return load_file(HERE / "golden" / f"{name}.safetensors")


def filled(model: torch.nn.Module, name_of: Callable[[str], str] = str) -> torch.nn.Module:
    """``model`` with every tensor drawn from ``name_of(its name)``, its published name."""
    state = {
        name: torch.from_numpy(fill.weight(name_of(name), tuple(tensor.shape)))
        for name, tensor in model.state_dict().items()
    }
    model.load_state_dict(state)
    return model.eval()


def film_published(name: str) -> str:
    """The name of a tensor in the authors' model with FiLM, which wraps towers and blocks."""
    if not name.startswith("vision_backbone."):
        return name
    name = re.sub(r"\.blocks\.(\d+)\.(?!scale\.|shift\.)", r".blocks.\1.block.", name)
    return f"vision_backbone.{name}"


def film_file_name(name: str) -> str:
    """The name of a tensor in their ``vision_backbone--…``; of other parts it stays."""
    return film_published(name).removeprefix("vision_backbone.")


def openvla() -> OpenVLA:
    return filled(OpenVLA(**SIZES))


def oft(name: str) -> OpenVLAOFT:
    head = "diffusion" if name == "diffusion" else "l1"
    model = OpenVLAOFT(**SIZES, head=head, use_film=name == "film")
    return filled(model, film_published if name == "film" else str)


def pictures(count: int) -> torch.Tensor:
    """``(2, 3 * count, 28, 28)`` in -1..1."""
    return torch.from_numpy(fill.uniform("images", (2, count, 3, 28, 28), -1.0, 1.0)).flatten(1, 2)


def batch(count: int, horizon: int) -> dict[str, torch.Tensor]:
    """The oracle's batch: two prompts of 9 and 6 tokens, padded on the right."""
    ids = 3 + fill.integers("prompts", (2, 9), 30000)
    lengths = np.array([9, 6])
    masks = np.arange(9)[None] < lengths[:, None]
    ids[:, 0] = 1
    ids[[0, 1], lengths - 1] = 29871
    wide = 1.2 if horizon == 1 else 1.0
    shape = (2, 7) if horizon == 1 else (2, horizon, 7)
    actions = torch.from_numpy(fill.uniform("actions", shape, -wide, wide)).reshape(2, horizon, 7)
    return {
        "images": pictures(count),
        "lang_tokens": torch.from_numpy(np.where(masks, ids, 0)),
        "lang_masks": torch.from_numpy(masks),
        "actions": actions,
    }


def oft_batch(name: str) -> dict[str, torch.Tensor]:
    found = batch(2, 8)
    found["states"] = torch.from_numpy(fill.uniform("states", (2, 8), -1.0, 1.0))
    if name == "diffusion":
        found["noise"] = torch.from_numpy(fill.normal("noise", (2, 8, 7)))[:, None]
        found["time"] = torch.tensor([[3], [41]])
    return found
