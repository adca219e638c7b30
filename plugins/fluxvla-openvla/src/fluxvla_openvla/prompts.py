"""The prompt of OpenVLA, as tokens."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core import Tokenizer, Transform, build_tokenizer_from_cfg
from fluxvla_core.errors import ConfigError

TEMPLATE = "In: What action should the robot take to {instruction}?\nOut:"
EMPTY_TOKEN = 29871
"""Llama's token of a lone space, which stood before the actions in training."""
FIRST_TOKEN = 1
"""``<s>``: images stand behind it."""


class ProcessOpenVLAPrompts(Transform):
    r"""Tokenise ``In: What action should the robot take to {instruction}?\nOut:``.

    Adds ``lang_tokens`` int64 and ``lang_masks`` bool, ``(max_len,)``, padded on the right. The
    instruction is ``sample["task_description"]`` in lower case.

    Args:
        tokenizer: a table of ``fluxvla.tokenizers``, or one already built: Llama 2's, which puts
            its first token before the text by itself.
        max_len: length of the result.
        empty_token: appended unless it is the last token anyway.

    Raises:
        ConfigError: the tokenizer puts no ``<s>`` in front; the instruction is missing, or longer
            than ``max_len``: half an instruction is another instruction, so it is never cut.
    """

    keeps_images = True

    def __init__(
        self,
        tokenizer: Mapping[str, Any] | Any,
        max_len: int = 64,
        empty_token: int = EMPTY_TOKEN,
    ) -> None:
        if max_len < 1:
            raise ConfigError(f"ProcessOpenVLAPrompts: max_len must be at least 1, got {max_len}")
        self.tokenizer = Tokenizer.adapt(build_tokenizer_from_cfg(tokenizer))
        self.max_len = max_len
        self.empty_token = empty_token
        # A dataset has a handful of instructions and millions of frames.
        self._known: dict[str, tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_]]] = {}

    def __call__(self, sample: Mapping[str, Any]) -> dict[str, Any]:
        """The sample with ``lang_tokens`` and ``lang_masks``."""
        text = sample.get("task_description")
        if not isinstance(text, str) or not text.strip():
            raise ConfigError(
                "ProcessOpenVLAPrompts: there is no instruction: 'task_description' in the sample "
                f"is {text!r}"
            )
        if text not in self._known:
            self._known[text] = self._tokens(text)
        tokens, mask = self._known[text]
        return {**sample, "lang_tokens": tokens.copy(), "lang_masks": mask.copy()}

    def _tokens(self, text: str) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
        ids: Sequence[int] = self.tokenizer.encode(TEMPLATE.format(instruction=text.lower()))
        if not ids or ids[0] != FIRST_TOKEN:
            raise ConfigError(
                f"ProcessOpenVLAPrompts: the prompt's first token is {ids[0] if ids else None}, "
                f"not {FIRST_TOKEN} (<s>), behind which the images stand",
                cause="the tokenizer is not Llama 2's, or its files do not say that it adds <s>",
            )
        if ids[-1] != self.empty_token:
            ids = [*ids, self.empty_token]
        if len(ids) > self.max_len:
            raise ConfigError(
                f"ProcessOpenVLAPrompts: the prompt with {text[:100]!r} has {len(ids)} tokens, "
                f"max_len is {self.max_len}",
                next=f"--set <ProcessOpenVLAPrompts>.max_len={len(ids)} (or more) where the model "
                "is trained, or use shorter words",
            )
        tokens = np.full(self.max_len, int(self.tokenizer.pad_token_id or 0), dtype=np.int64)
        mask = np.zeros(self.max_len, dtype=np.bool_)
        tokens[: len(ids)], mask[: len(ids)] = ids, True
        return tokens, mask
