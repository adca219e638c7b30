"""PI0-FAST as LeRobot saves it: ``config.json``, weights, and its processors' files.

The tokenizer of actions is not among them. LeRobot names one of the hub; here its files are looked
for in a folder of that name, or of its last part inside the checkpoint's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

from fluxvla_models.fast_tokenizer import SETTINGS
from fluxvla_models.lerobot_files import (
    ACTION,
    CONFIG,
    STATE,
    check_policy_settings,
    policy_type,
)

from fluxvla_core.data import PretrainedTokenizer
from fluxvla_core.errors import CheckpointError
from fluxvla_core.models import CheckpointFormat, ForeignCheckpoint, without_cameras
from fluxvla_core.results import read_json
from fluxvla_pi.action_tokens import ActionWords
from fluxvla_pi.lerobot_fast_write import TOKENIZER, write_fast
from fluxvla_pi.lerobot_format import (
    SHARED,
    cameras_in,
    count_of,
    features_of,
    normalization,
    notes_of,
    of_images,
    of_words,
    resolution_of,
    statistics_of,
    width_of,
)
from fluxvla_pi.lerobot_processors import from_files
from fluxvla_pi.pi0_fast import PI0FAST
from fluxvla_pi.published import FAST, weights_in

_FIXED = {"n_obs_steps": 1, "use_peft": False}
_SETTINGS = (
    *SHARED,
    "max_action_tokens",
    "text_tokenizer_name",
    "action_tokenizer_name",
    "temperature",
    "max_decoding_steps",
    "fast_skip_tokens",
    "validate_action_token_prefix",
    "use_kv_cache",
)


class LeRobotPi0FastFormat(CheckpointFormat):
    """LeRobot's ``pi0_fast`` policies."""

    name: ClassVar[str] = "lerobot"
    model_types: ClassVar[Sequence[str]] = (PI0FAST.__name__,)

    def recognizes(self, folder: Path) -> bool:
        """Whether ``config.json`` is of such a policy."""
        return policy_type(folder) == FAST

    def read(
        self, folder: Path, tokenizer: str | None = None, absent: Sequence[str] = ()
    ) -> ForeignCheckpoint:
        """The checkpoint in ``folder``.

        Args:
            tokenizer: the folder of PaliGemma's tokenizer.
            absent: cameras without images, which LeRobot masks.

        Raises:
            CheckpointError: it is damaged, does something that PI0-FAST here does not, or the
                tokenizer of actions is not there.
            UsageError: it has no such camera.
        """
        where = str(folder / CONFIG)
        config = read_json(folder / CONFIG, dict[str, Any], CheckpointError)
        for key, value in _FIXED.items():
            if config.get(key, value) != value:
                raise CheckpointError(f"{key} is {config[key]!r}; {value!r} is read", where=where)
        check_policy_settings(config, _SETTINGS, where)
        inputs, outputs = (features_of(config, f"{w}_features", where) for w in ("input", "output"))
        weights = weights_in(folder)
        if weights.family != FAST:
            raise CheckpointError(
                f"type is {FAST}, the weights are those of {weights.family}", where=where
            )
        widths = {STATE: width_of(inputs, STATE, where), ACTION: width_of(outputs, ACTION, where)}
        preparation = from_files(folder, widths)
        actions = {
            "type": "FastTokenizer",
            "model_path": str(_action_tokenizer(folder, config, where)),
        }
        skipped = config.get("fast_skip_tokens", ActionWords.skipped)
        words = _words(weights.model["vocab_size"], skipped, tokenizer, where)
        named = {} if words == ActionWords() else {"words": _table(words)}
        cameras = cameras_in(inputs, where, preparation.renamed)
        horizon = count_of(config, "chunk_size", 50, where)
        model = {
            **weights.model,
            "tokenizer": actions,
            **named,
            "n_action_steps": horizon,
            "action_dim": widths[ACTION],
            "max_decoding_steps": count_of(config, "max_decoding_steps", 256, where),
            "temperature": float(config.get("temperature", 0.0)),
            "bos_in_prompt": True,
        }
        written = {
            "type": "ProcessActionTokens",
            "tokenizer": actions,
            "max_len": count_of(config, "max_action_tokens", 256, where),
            **named,
        }
        return ForeignCheckpoint(
            model=model,
            tensors=weights.tensors,
            img_keys=without_cameras(cameras, absent, where),
            transforms=[
                *of_images(resolution_of(config, where)),
                normalization(preparation),
                {"type": "PreparePromptWithState", "ending": ""},
                of_words(preparation, tokenizer),
                written,
            ],
            statistics={"private": statistics_of(preparation, widths)},
            horizon=horizon,
            notes=notes_of(
                preparation, tokenizer, count_of(config, "n_action_steps", horizon, where), horizon
            ),
        )

    def write(self, checkpoint: ForeignCheckpoint, folder: Path) -> None:
        """Write ``checkpoint`` into ``folder``; see ``CheckpointFormat``."""
        write_fast(checkpoint, folder)


def _action_tokenizer(folder: Path, config: Mapping[str, Any], where: str) -> Path:
    """The folder of the FAST tokenizer."""
    name = str(config.get("action_tokenizer_name", TOKENIZER))
    inside = folder / Path(name).name
    for place in (Path(name), inside):
        if (place / SETTINGS).is_file():
            return place
    raise CheckpointError(
        f"the tokenizer of actions, {name}, is not in the checkpoint's files",
        where=where,
        next=f"put tokenizer.json and {SETTINGS} of {name} into {inside}",
    )


def _words(size: int, skipped: Any, tokenizer: str | None, where: str) -> ActionWords:
    """The words that answers are written with, by the text tokenizer where it is known."""
    if type(skipped) is not int or skipped < 0:
        raise CheckpointError(f"fast_skip_tokens is {skipped!r}, not a number from 0", where=where)
    if tokenizer is None:
        return ActionWords(size, skipped)
    encode = PretrainedTokenizer(tokenizer).encode
    bos, eos, stop = (encode(text, add_special_tokens=False) for text in ("<bos>", "<eos>", "|"))
    if not len(bos) == len(eos) == len(stop) == 1:
        raise CheckpointError(
            f"the tokenizer in {tokenizer} has no single token for <bos>, <eos> or |",
            cause="it is not PaliGemma's",
        )
    begin = tuple(encode("Action: ", add_special_tokens=False))
    return ActionWords(size, skipped, bos[0], begin, stop[0], eos[0])


def _table(words: ActionWords) -> dict[str, Any]:
    return {**vars(words), "begin": list(words.begin)}
