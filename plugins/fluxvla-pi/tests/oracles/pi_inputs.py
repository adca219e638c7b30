"""Sizes and inputs of tiny models that every reference can make alike; numpy alone."""

from __future__ import annotations

import numpy as np

from tests.oracles import fill

GEMMA = {"width": 32, "depth": 3, "mlp_dim": 48, "heads": 8, "kv_heads": 1, "head_dim": 8}
EXPERT = {**GEMMA, "width": 24, "mlp_dim": 40}
VISION = {
    "width": 32,
    "depth": 2,
    "mlp_dim": 48,
    "heads": 4,
    "image_size": 28,
    "patch_size": 14,
}
VOCABULARY = 64
HORIZON, ACTIONS, STATES = 5, 8, 8
BATCH, CAMERAS, WORDS = 3, 2, 6
PATCHES = (VISION["image_size"] // VISION["patch_size"]) ** 2
SIZES = {
    "variant": GEMMA,
    "expert_variant": EXPERT,
    "vision_variant": VISION,
    "vocab_size": VOCABULARY,
    "n_action_steps": HORIZON,
    "max_action_dim": ACTIONS,
}


def inputs():
    """A batch. ``tau`` has few bits, so that ``1 - tau`` is exact in float32.

    The second sample has but one camera, and samples have 6, 4 and 5 words.
    """
    side = VISION["image_size"]
    return {
        "images": fill.uniform("images", (BATCH, 3 * CAMERAS, side, side), -1, 1),
        "img_masks": np.array([[True, True], [True, False], [True, True]]),
        "lang_tokens": fill.integers("lang_tokens", (BATCH, WORDS), VOCABULARY),
        "lang_masks": np.arange(WORDS)[None] < np.array([[6], [4], [5]]),
        "states": fill.normal("states", (BATCH, STATES)),
        "actions": fill.normal("actions", (BATCH, HORIZON, ACTIONS)),
        "noise": fill.normal("noise", (BATCH, HORIZON, ACTIONS)),
        "tau": np.array([0.125, 0.6875, 0.9375], np.float32),
    }
