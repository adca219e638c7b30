"""The entry-point groups that the core reads: one per registry."""

from __future__ import annotations

PREFIX = "fluxvla."

REGISTRIES = (
    "runners",
    "operators",
    "vlas",
    "vision_backbones",
    "llm_backbones",
    "vlm_backbones",
    "projectors",
    "heads",
    "datasets",
    "transforms",
    "collators",
    "tokenizers",
    "processors",
    "metrics",
    "optimizers",
    "action_filters",
    "hooks",
    "environments",
    "policies",
    "commands",
)

GROUPS = tuple(PREFIX + name for name in REGISTRIES)
