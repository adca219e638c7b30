"""Names of weights: ours, and those of the published files of GR00T N1.5 and N1.7.

The published names are those of NVIDIA's Isaac-GR00T, which LeRobot uses too.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

_BACKBONES = {
    "n1.5": (
        (r"^vlm_backbone\.vision\.", "backbone.eagle_model.vision_model.vision_model."),
        (r"^vlm_backbone\.connect\.", "backbone.eagle_model.mlp1.0."),
        (r"^vlm_backbone\.text\.", "backbone.eagle_model.language_model.model."),
    ),
    "n1.7": ((r"^vlm_backbone\.model\.", "backbone.model.model."),),
}
_HEAD = (
    (r"^vla_head\.", "action_head."),
    (r"^action_head\.context_norm\.", "action_head.vlln."),
    (r"^action_head\.context_blocks\.", "action_head.vl_self_attention.transformer_blocks."),
    (r"^action_head\.positions\.", "action_head.position_embedding."),
    (
        r"^action_head\.dit\.time\.hidden\.",
        "action_head.model.timestep_encoder.timestep_embedder.linear_1.",
    ),
    (
        r"^action_head\.dit\.time\.out\.",
        "action_head.model.timestep_encoder.timestep_embedder.linear_2.",
    ),
    (r"^action_head\.dit\.blocks\.", "action_head.model.transformer_blocks."),
    (r"^action_head\.dit\.modulate\.", "action_head.model.proj_out_1."),
    (r"^action_head\.dit\.out\.", "action_head.model.proj_out_2."),
    (r"(transformer_blocks\.\d+)\.modulate\.", r"\1.norm1.linear."),
    (r"(transformer_blocks\.\d+)\.attention_norm\.", r"\1.norm1."),
    (r"(transformer_blocks\.\d+)\.feed_forward_norm\.", r"\1.norm3."),
    (r"(transformer_blocks\.\d+)\.attention\.(query|key|value)\.", r"\1.attn1.to_\2."),
    (r"attn1\.to_query\.", "attn1.to_q."),
    (r"attn1\.to_key\.", "attn1.to_k."),
    (r"attn1\.to_value\.", "attn1.to_v."),
    (r"(transformer_blocks\.\d+)\.attention\.out\.", r"\1.attn1.to_out.0."),
    (r"(transformer_blocks\.\d+)\.feed_forward\.expand\.", r"\1.ff.net.0.proj."),
    (r"(transformer_blocks\.\d+)\.feed_forward\.contract\.", r"\1.ff.net.2."),
    (r"^action_head\.(state_encoder|action_decoder)\.hidden\.", r"action_head.\1.layer1."),
    (r"^action_head\.(state_encoder|action_decoder)\.out\.", r"action_head.\1.layer2."),
    (r"^action_head\.action_encoder\.actions\.", "action_head.action_encoder.W1."),
    (r"^action_head\.action_encoder\.joined\.", "action_head.action_encoder.W2."),
    (r"^action_head\.action_encoder\.out\.", "action_head.action_encoder.W3."),
    (r"(layer[12]|W[123])\.weight$", r"\1.W"),
    (r"(layer[12]|W[123])\.bias$", r"\1.b"),
)
_UNREAD = {
    # The vision tower's pooling head and the language model's words: features come before them.
    "n1.5": (
        r"^backbone\.eagle_model\.vision_model\.vision_model\.head\.",
        r"^backbone\.eagle_model\.language_model\.lm_head\.",
    ),
    # The features are what the last layer gives, before the last norm.
    "n1.7": (r"^backbone\.model\.lm_head\.", r"^backbone\.model\.model\.language_model\.norm\."),
}


def published_name(name: str, version: str) -> str:
    """The published name of our weight ``name``; ``version`` is ``n1.5`` or ``n1.7``."""
    for pattern, replacement in (*_BACKBONES[version], *_HEAD):
        name = re.sub(pattern, replacement, name)
    return name


def key_map(names: Iterable[str], version: str) -> dict[str, str]:
    """Published name -> ours, for all of our ``names``."""
    return {published_name(name, version): name for name in names}


def is_unread(name: str, version: str) -> bool:
    """Whether a published weight is of a part that this model does without."""
    return any(re.search(pattern, name) for pattern in _UNREAD[version])
