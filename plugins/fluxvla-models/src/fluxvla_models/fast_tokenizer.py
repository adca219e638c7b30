"""FAST: a chunk of actions as a few tokens, by a cosine transform and byte-pair encoding.

Source: Pertsch et al. 2025, "FAST: Efficient Action Tokenization for Vision-Language-Action Models"
(arXiv 2501.09747), in the format of the published ``physical-intelligence/fast``: a byte-level BPE
in ``tokenizer.json`` (Hugging Face ``tokenizers``), and ``scale`` and ``min_token`` in
``processor_config.json``. The Python file that is published next to them is never run.

A chunk ``(T, D)`` is transformed over time by the orthonormal DCT-II, multiplied by ``scale`` and
rounded (halves to even). The whole numbers, all dimensions of the lowest frequency first, become
characters, ``chr(number - min_token)``, which the BPE merges; what is below ``min_token`` becomes
``min_token``.
"""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Iterable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.data import PretrainedTokenizer
from fluxvla_core.errors import ConfigError, DataError
from fluxvla_core.results import read_json

log = logging.getLogger("fluxvla.models")

SETTINGS = "processor_config.json"
LONGEST = 10000
"""Characters that one token may stand for, as in the published fitting."""
_SURROGATES = 0xD800
"""The first character that no UTF-8 holds."""
_BROKEN = "\N{REPLACEMENT CHARACTER}"

Floats = npt.NDArray[np.float64]


class FastTokenizer(PretrainedTokenizer):
    """Normalised actions to tokens and back.

    Args:
        model_path: the folder of a published FAST tokenizer, or of one that :func:`fit` wrote; as
            of ``PretrainedTokenizer``.

    Raises:
        ConfigError: there is no such folder, or it is not a FAST tokenizer's.
    """

    def __init__(self, model_path: str) -> None:
        super().__init__(model_path)
        self.base_vocab_size = None  # a model's words stand for its ids
        self.scale, self.min_token = _settings(self.folder)

    def encode_actions(self, actions: npt.ArrayLike) -> list[int]:
        """Token ids of a chunk of normalised actions ``(T, D)``.

        Raises:
            DataError: it is no chunk of finite numbers, or has one that the tokenizer cannot write.
        """
        text = "".join(map(chr, self._numbers(actions)))
        ids = list(self._tokenizer.encode(text, add_special_tokens=False).ids)
        if self.decode(ids, skip_special_tokens=False) != text:
            raise DataError(
                "the FAST tokenizer has no token for some of the chunk's coefficients",
                where=str(self.folder),
                cause="it was fitted to actions of a smaller range",
                next="fit it to chunks of this dataset: fluxvla_models.fast_tokenizer.fit",
            )
        return ids

    def decode_actions(
        self, ids: Sequence[int], horizon: int, dim: int, strict: bool = False
    ) -> Floats:
        """The normalised actions ``(horizon, dim)`` float64 that ``ids`` stand for.

        Ids that are no tokens are left out. What is no chunk is zeros, with a warning: bytes that
        are no characters, negative ids and, if ``strict``, another number of coefficients than
        ``horizon * dim``. Otherwise the coefficients are cut, or filled up with zeros at the
        highest frequencies.

        Args:
            strict: as the published tokenizer and openpi; LeRobot's PI0-FAST cuts and fills up.
        """
        size = horizon * dim
        text = "" if min(ids, default=0) < 0 else self.decode(list(ids), skip_special_tokens=False)
        broken = min(ids, default=0) < 0 or _BROKEN in text
        if broken or (strict and len(text) != size):
            found = "something that is no chunk" if broken else f"{len(text)} coefficients"
            log.warning("FAST tokens are %s, not %d coefficients: zeros are taken", found, size)
            return np.zeros((horizon, dim))
        numbers = np.zeros(size)
        numbers[: len(text)] = [ord(character) + self.min_token for character in text[:size]]
        return _cosines(horizon).T @ (numbers.reshape(horizon, dim) / self.scale)

    def save_pretrained(self, folder: str | Path) -> None:
        """Copy the files that this was loaded from, so that ``folder`` loads to an equal one."""
        super().save_pretrained(folder)
        shutil.copyfile(self.folder / SETTINGS, Path(folder) / SETTINGS)

    def _numbers(self, actions: npt.ArrayLike) -> list[int]:
        """The characters' numbers of a chunk."""
        shifted = _quantized(actions, self.scale) - self.min_token
        if shifted.max() >= _SURROGATES:
            raise DataError(
                f"a coefficient of {shifted.max() + self.min_token:.0f} in a chunk of actions up "
                f"to {np.abs(np.asarray(actions)).max():.3g} is beyond what FAST writes",
                next="FAST takes normalised actions, about -1..1: norm_type='quantile'",
            )
        return [int(number) for number in np.maximum(shifted, 0).ravel()]


def fit(
    chunks: Iterable[npt.ArrayLike],
    folder: str | Path,
    vocab_size: int = 1024,
    scale: float = 10.0,
) -> FastTokenizer:
    """Fit a tokenizer to chunks of normalised actions, and write it into ``folder``.

    The published algorithm, with one difference: every byte is a token from the beginning, so that
    the tokenizer can write coefficients that ``chunks`` do not have.

    Args:
        chunks: each ``(T, D)``, of a training set as its transforms give it.
        folder: is made; ``model_path`` of a :class:`FastTokenizer`.
        vocab_size: tokens; some 324 are single characters or bytes.
        scale: the larger, the finer the rounding and the more tokens.

    Raises:
        ConfigError: ``vocab_size`` is smaller than the range of the coefficients.
        DataError: there is no chunk, or one is not of finite numbers.
    """
    from tokenizers import ByteLevelBPETokenizer, pre_tokenizers
    from tokenizers.trainers import BpeTrainer

    if not scale > 0:
        raise ConfigError(f"scale must be above 0, got {scale}")
    numbers = [_quantized(chunk, scale) for chunk in chunks]
    if not numbers:
        raise DataError("there is no chunk to fit a FAST tokenizer to")
    lowest = int(min(rows.min() for rows in numbers))
    highest = int(max(rows.max() for rows in numbers))
    alphabet = [chr(code) for code in range(min(highest - lowest + 1, _SURROGATES))]
    alphabet = sorted({*alphabet, *pre_tokenizers.ByteLevel.alphabet()})
    if len(alphabet) > vocab_size:
        raise ConfigError(
            f"vocab_size {vocab_size} is too small: coefficients from {lowest} to {highest} need "
            f"{len(alphabet)} tokens before any two are merged",
            next="a larger vocab_size or a smaller scale, or actions of a smaller range",
        )
    texts = ["".join(chr(int(n) - lowest) for n in rows.ravel()) for rows in numbers]
    made = ByteLevelBPETokenizer()
    trainer = BpeTrainer(
        vocab_size=vocab_size,
        min_frequency=2,
        show_progress=False,
        special_tokens=[],
        initial_alphabet=alphabet,
        max_token_length=LONGEST,
    )
    made._tokenizer.train_from_iterator(texts, trainer=trainer)
    target = Path(folder)
    target.mkdir(parents=True, exist_ok=True)
    made.save(str(target / "tokenizer.json"))
    settings = {"scale": scale, "vocab_size": vocab_size, "min_token": lowest}
    (target / SETTINGS).write_text(json.dumps(settings, indent=2) + "\n", encoding="utf-8")
    return FastTokenizer(str(target))


def _quantized(actions: npt.ArrayLike, scale: float) -> Floats:
    """``(T, D)`` actions -> ``(T, D)`` whole numbers, the lowest frequency first.

    Raises:
        DataError: it is no chunk of finite numbers.
    """
    chunk = np.asarray(actions, np.float64)
    if chunk.ndim != 2 or not chunk.size or not np.isfinite(chunk).all():
        raise DataError(
            f"FAST takes a chunk (T, D) of finite numbers, got an array of shape {chunk.shape}"
            f"{'' if np.isfinite(chunk).all() else ' with nan or inf'}"
        )
    found: Floats = np.around(_cosines(len(chunk)) @ chunk * scale)
    return found


@lru_cache(maxsize=32)
def _cosines(length: int) -> Floats:
    """The orthonormal DCT-II as a matrix ``(length, length)``: a row for each frequency."""
    steps = np.arange(length)
    table = np.cos(np.pi * steps[:, None] * (2 * steps + 1) / (2 * length)) * (2 / length) ** 0.5
    table[0] /= 2**0.5
    table.flags.writeable = False
    return table


def _settings(folder: Path) -> tuple[float, int]:
    """``scale`` and ``min_token`` in a folder."""
    file = folder / SETTINGS
    if not file.is_file():
        raise ConfigError(
            f"there is no {SETTINGS}: it is not the folder of a FAST tokenizer",
            where=str(folder),
            next="name the folder of physical-intelligence/fast's files, or one that "
            "fluxvla_models.fast_tokenizer.fit wrote",
        )
    table = read_json(file, dict[str, Any], ConfigError)
    scale, lowest = table.get("scale"), table.get("min_token")
    if not (_number(scale) and scale > 0 and _number(lowest) and lowest == int(lowest)):
        raise ConfigError(
            f"scale {scale!r} and min_token {lowest!r} must be a number above 0 and a whole one",
            where=str(file),
        )
    return float(scale), int(lowest)


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and np.isfinite(value)
