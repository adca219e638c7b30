"""Instructions in words to token ids."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from fluxvla_core.build import build_tokenizer_from_cfg
from fluxvla_core.errors import ConfigError

Sample = dict[str, Any]


class ProcessPrompts:
    """Adds ``lang_tokens`` ``(max_len,)`` int64 and ``lang_masks`` ``(max_len,)`` bool.

    The text is ``sample["prompt"]``, or ``sample["task_description"]`` where there is none.
    Padding follows on the tokenizer's ``padding_side``, right unless it says otherwise; the mask
    is True on real tokens.

    Args:
        tokenizer: a table of ``fluxvla.tokenizers``, or one already built: ``encode(text)``
            gives ids, ``pad_token_id`` fills up.
        max_len: length of the result.

    Raises:
        ConfigError: the text is missing, or longer than ``max_len``: half an instruction is
            another instruction, so it is never cut.
    """

    keeps_images = True

    def __init__(self, tokenizer: Mapping[str, Any] | Any, max_len: int = 180) -> None:
        if max_len < 1:
            raise ConfigError(f"ProcessPrompts: max_len must be at least 1, got {max_len}")
        self.tokenizer = build_tokenizer_from_cfg(tokenizer)
        self.max_len = max_len
        # A dataset has a handful of instructions and millions of frames.
        self._known: dict[str, tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]] = {}

    def __call__(self, sample: Sample) -> Sample:
        text = sample.get("prompt", sample.get("task_description"))
        if not isinstance(text, str) or not text.strip():
            raise ConfigError(
                "ProcessPrompts: there is no instruction: neither 'prompt' nor "
                f"'task_description' is in the sample ({text!r})"
            )
        if text not in self._known:
            self._known[text] = self._encode(text)
        tokens, mask = self._known[text]
        return {**sample, "lang_tokens": tokens.copy(), "lang_masks": mask.copy()}

    def _encode(self, text: str) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
        ids = self.tokenizer.encode(text)
        if len(ids) > self.max_len:
            raise ConfigError(
                f"ProcessPrompts: the instruction {text!r} has {len(ids)} tokens, "
                f"max_len is {self.max_len}",
                next=f"set max_len to {len(ids)} or more where the model was trained, "
                "or use shorter words",
            )
        pad = int(getattr(self.tokenizer, "pad_token_id", 0) or 0)
        left = getattr(self.tokenizer, "padding_side", "right") == "left"
        place = slice(self.max_len - len(ids), None) if left else slice(len(ids))
        tokens = np.full(self.max_len, pad, dtype=np.int64)
        mask = np.zeros(self.max_len, dtype=np.bool_)
        tokens[place], mask[place] = ids, True
        return tokens, mask
