"""``SmolVLAPrompt``: the instruction as SmolVLA was trained on it."""

from __future__ import annotations

from typing import Any

from fluxvla_core import Transform


class SmolVLAPrompt(Transform):
    """End the instruction with a newline: sets ``prompt``, which ``ProcessPrompts`` tokenises."""

    keeps_images = True

    def __call__(self, sample: dict[str, Any]) -> dict[str, Any]:
        text = sample.get("prompt", sample.get("task_description"))
        if not isinstance(text, str) or not text.strip() or text.endswith("\n"):
            return sample
        return {**sample, "prompt": f"{text}\n"}
