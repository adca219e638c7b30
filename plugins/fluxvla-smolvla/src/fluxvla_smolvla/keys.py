"""Names of SmolVLA's tensors in LeRobot's checkpoints."""

from __future__ import annotations

from collections.abc import Iterable

_VLM = "model.vlm_with_expert.vlm."
PREFIXES = {
    "vision.layers.": f"{_VLM}model.vision_model.encoder.layers.",
    "vision.post_layernorm.": f"{_VLM}model.vision_model.post_layernorm.",
    "vision.": f"{_VLM}model.vision_model.embeddings.",
    "connector.proj.": f"{_VLM}model.connector.modality_projection.proj.",
    "text.": f"{_VLM}model.text_model.",
    "lm_head.": f"{_VLM}lm_head.",
    "expert.": "model.vlm_with_expert.lm_expert.",
    "embed_actions.": "model.",
    "state_proj.": "model.state_proj.",
    "action_out_proj.": "model.action_out_proj.",
}
"""Prefix of a name here -> prefix there; the first that fits counts."""


def published(name: str) -> str:
    """LeRobot's name of the tensor that is ``name`` in ``SmolVLA().state_dict()``."""
    for ours, theirs in PREFIXES.items():
        if name.startswith(ours):
            return theirs + name.removeprefix(ours)
    raise KeyError(name)


def published_names(names: Iterable[str]) -> dict[str, str]:
    """``{name here: name there}`` of all tensors of a model."""
    return {name: published(name) for name in names}
