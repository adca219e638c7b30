"""Text to token ids, from the files that a pretrained model comes with."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

from fluxvla_core.errors import ConfigError
from fluxvla_core.processors.resources import resolve_model_path

_FILES = ("tokenizer.json", "vocab.txt", "tokenizer_config.json", "special_tokens_map.json")
_SIDES = ("right", "left")


class PretrainedTokenizer:
    """The tokenizer of a pretrained model, on the ``tokenizers`` library alone.

    Args:
        model_path: a folder, or ``package:<import name>/<folder>``, that holds
            ``tokenizer.json``, or BERT's ``vocab.txt``.
        model_max_length: longest sequence that :meth:`encode` returns.
        padding_side: ``right`` or ``left``; used by whoever pads.

    Raises:
        ConfigError: no such folder, no tokenizer in it, or an unreadable one.
    """

    def __init__(
        self, model_path: str, model_max_length: int = 2048, padding_side: str = "right"
    ) -> None:
        if padding_side not in _SIDES:
            raise ConfigError(f"padding_side must be one of {_SIDES}, got {padding_side!r}")
        self.model_path = str(model_path)
        self.folder = resolve_model_path(model_path)
        self.model_max_length = model_max_length
        self.padding_side = padding_side
        self._config = _json(self.folder / "tokenizer_config.json")
        self._tokenizer = _load(self.folder, self._config)
        # Files may carry the padding and truncation of another use; lengths are decided here.
        self._tokenizer.no_padding()
        self._tokenizer.no_truncation()
        self.pad_token_id = self._find_pad()

    @property
    def vocab_size(self) -> int:
        """Number of ids, added tokens included."""
        return int(self._tokenizer.get_vocab_size(with_added_tokens=True))

    def encode(self, text: str, add_special_tokens: bool = True) -> list[int]:
        """Token ids of ``text``, with the model's own special tokens around them.

        Raises:
            ConfigError: there are more than ``model_max_length``; text is never cut silently.
        """
        ids = self._tokenizer.encode(text, add_special_tokens=add_special_tokens).ids
        if len(ids) > self.model_max_length:
            raise ConfigError(
                f"{text!r} has {len(ids)} tokens, model_max_length is {self.model_max_length}"
            )
        return list(ids)

    def decode(self, ids: list[int], skip_special_tokens: bool = True) -> str:
        """The text that ``ids`` stand for."""
        return str(self._tokenizer.decode(ids, skip_special_tokens=skip_special_tokens))

    def save_pretrained(self, folder: str | Path) -> None:
        """Copy the files that this was loaded from, so that ``folder`` loads to an equal one."""
        target = Path(folder)
        target.mkdir(parents=True, exist_ok=True)
        for name in _FILES:
            if (self.folder / name).is_file():
                shutil.copyfile(self.folder / name, target / name)

    def _find_pad(self) -> int:
        token = self._config.get("pad_token", "[PAD]")
        if isinstance(token, dict):
            token = token.get("content", "[PAD]")
        found = self._tokenizer.token_to_id(token) if isinstance(token, str) else None
        return int(found) if found is not None else 0


def _load(folder: Path, config: dict[str, Any]) -> Any:
    try:
        from tokenizers import BertWordPieceTokenizer, Tokenizer
    except ImportError as error:
        raise ConfigError(
            "PretrainedTokenizer needs the package tokenizers, which is not installed",
            next="pip install 'fluxvla-core[train]'",
        ) from error

    file, vocab = folder / "tokenizer.json", folder / "vocab.txt"
    # The library raises plain Exception for files that it cannot read.
    try:
        if file.is_file():
            return Tokenizer.from_file(str(file))
        if vocab.is_file():
            lower = bool(config.get("do_lower_case", True))
            return BertWordPieceTokenizer(str(vocab), lowercase=lower)
    except Exception as error:
        raise ConfigError(f"no tokenizer can be read from {folder}: {error}") from error
    present = sorted(p.name for p in folder.iterdir())[:8]
    raise ConfigError(
        f"{folder} holds neither tokenizer.json nor vocab.txt; it holds {', '.join(present)}",
        cause="the folder is not the one that the model's tokenizer was saved in",
    )


def _json(path: Path) -> dict[str, Any]:
    if not path.is_file():
        return {}
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ConfigError(f"{path} is no JSON: {error}") from error
    return found if isinstance(found, dict) else {}
