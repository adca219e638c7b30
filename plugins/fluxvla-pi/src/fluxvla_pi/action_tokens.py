"""Action tokens among the words of PaliGemma, as PI0-FAST writes and reads them.

Source: Pertsch et al. 2025 (arXiv 2501.09747) and openpi's ``FASTTokenizer``: token ``i`` of the
FAST tokenizer takes the place of the word ``vocab_size - 1 - skipped - i``, which PaliGemma hardly
uses. The answer of the model is ``<bos>Action: ``, the action tokens, ``|<eos>``, as LeRobot's
PI0-FAST has it; openpi's has no ``<bos>`` there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from fluxvla_models.fast_tokenizer import FastTokenizer

from fluxvla_core import Tokenizer, Transform, build_tokenizer_from_cfg
from fluxvla_core.errors import ConfigError


@dataclass(frozen=True)
class ActionWords:
    """Token ids of a text tokenizer by which actions are written; the defaults are PaliGemma's.

    Args:
        vocab_size: its words.
        skipped: words at the end that stay free (PaliGemma's for segmentation).
        bos: the answer's first token.
        begin: ``Action: ``.
        stop: ``|``, which ends the actions.
        eos: the last token.
    """

    vocab_size: int = 257152
    skipped: int = 128
    bos: int = 2
    begin: tuple[int, ...] = (4022, 235292, 235248)
    stop: int = 235371
    eos: int = 1

    @classmethod
    def of(cls, table: Mapping[str, Any] | None, where: str) -> ActionWords:
        """The words that a config's table names.

        Raises:
            ConfigError: an unknown key, or no ``begin``.
        """
        table = table or {}
        known = [field.name for field in fields(cls)]
        unknown = [key for key in table if key not in known]
        if unknown:
            raise ConfigError(
                f"{where}: words has no {', '.join(unknown)}; it has {', '.join(known)}"
            )
        found = cls(**{**table, "begin": tuple(table.get("begin", cls.begin))})
        if not found.begin:
            raise ConfigError(f"{where}: words.begin is empty: how an answer begins is not known")
        return found

    def check(self, count: int, where: str) -> None:
        """Check that ``count`` action tokens find a place.

        Raises:
            ConfigError: there are too few words, one of them is one of the answer's own, or one
                of those is no word.
        """
        highest = self.vocab_size - 1 - self.skipped
        lowest = highest - count + 1
        ids = (self.bos, *self.begin, self.stop, self.eos)
        if any(not 0 <= i < self.vocab_size for i in ids):
            raise ConfigError(
                f"{where}: bos, begin, stop and eos are the words {ids}; there are "
                f"0..{self.vocab_size - 1} (words.vocab_size)"
            )
        if lowest < 0 or any(lowest <= i <= highest for i in ids):
            raise ConfigError(
                f"{where}: {count} action tokens would take the words {lowest}..{highest}, and the "
                f"answer's own are {ids}",
                next="a FAST tokenizer with a smaller vocab_size, or other words",
            )

    def write(self, actions: Sequence[int]) -> list[int]:
        """The model's whole answer for ids of the FAST tokenizer."""
        last = self.vocab_size - 1 - self.skipped
        return [self.bos, *self.begin, *(last - i for i in actions), self.stop, self.eos]

    def read(self, answer: Sequence[int]) -> list[int]:
        """The ids of the FAST tokenizer in an ``answer`` without its ``bos``.

        What follows the first ``stop`` is left out, and so is ``begin`` wherever it stands. Other
        words give ids that the FAST tokenizer does not have and refuses.
        """
        rest, begin = list(answer), list(self.begin)
        if self.stop in rest:
            rest = rest[: rest.index(self.stop)]
        place = 0
        while place + len(begin) <= len(rest):
            if rest[place : place + len(begin)] == begin:
                del rest[place : place + len(begin)]
            else:
                place += 1
        last = self.vocab_size - 1 - self.skipped
        return [last - token for token in rest]


class ProcessActionTokens(Transform):
    """Write the normalised ``actions`` as tokens, behind the normalisation.

    Adds ``action_tokens`` int64 and ``action_token_masks`` bool, ``(max_len,)``, padded on the
    right. Steps beyond the end of an episode are part of the chunk, as in the references.

    Args:
        tokenizer: a table of ``fluxvla.tokenizers``, ``FastTokenizer``, or one already built.
        max_len: length of the result.
        words: a table as :class:`ActionWords`, where the text tokenizer is not PaliGemma's.

    Raises:
        ConfigError: the tokenizer knows no actions, or has too many tokens; a chunk has more than
            ``max_len``: without its last tokens it is another chunk, so it is never cut.
        DataError: the tokenizer cannot write a chunk.
    """

    keeps_images = True
    training_only = True

    def __init__(
        self,
        tokenizer: Mapping[str, Any] | Any,
        max_len: int = 256,
        words: Mapping[str, Any] | None = None,
    ) -> None:
        who = type(self).__name__
        if max_len < 1:
            raise ConfigError(f"{who}: max_len must be at least 1, got {max_len}")
        self.tokenizer = Tokenizer.adapt(build_tokenizer_from_cfg(tokenizer))
        self.max_len = max_len
        self.words = ActionWords.of(words, who)
        if isinstance(self.tokenizer, FastTokenizer):
            self.words.check(self.tokenizer.vocab_size, who)

    def __call__(self, sample: Mapping[str, Any]) -> dict[str, Any]:
        """The sample with ``action_tokens`` and ``action_token_masks``."""
        who = type(self).__name__
        if "actions" not in sample:
            raise ConfigError(f"{who}: the sample has no actions")
        try:
            written = self.words.write(self.tokenizer.encode_actions(sample["actions"]))
        except NotImplementedError as error:
            raise ConfigError(
                f"{who}: {error}",
                next="tokenizer=dict(type='FastTokenizer', model_path=FOLDER)",
            ) from error
        if len(written) > self.max_len:
            raise ConfigError(
                f"{who}: a chunk of {' x '.join(map(str, np.shape(sample['actions'])))} actions "
                f"has {len(written)} tokens, max_len is {self.max_len}",
                next=f"--set <{who}>.max_len={len(written)} (or more), and a model whose "
                "max_decoding_steps is as many; or a tokenizer that is fitted to these actions",
            )
        tokens = np.zeros(self.max_len, np.int64)
        mask = np.zeros(self.max_len, np.bool_)
        tokens[: len(written)], mask[: len(written)] = written, True
        return {**sample, "action_tokens": tokens, "action_token_masks": mask}
