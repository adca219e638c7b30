"""Writing PI0-FAST as LeRobot 0.6 saves it, with the tokenizer of actions beside it.

LeRobot reads that tokenizer from the hub or from a folder, by a name in the config. The published
one keeps its name there; another one is named by its folder inside the checkpoint's, which LeRobot
finds where the checkpoint is the working directory.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from fluxvla_models.fast_tokenizer import SETTINGS, FastTokenizer

from fluxvla_core import build_tokenizer_from_cfg
from fluxvla_core.errors import CheckpointError
from fluxvla_core.models import ForeignCheckpoint
from fluxvla_core.results import read_json
from fluxvla_pi.action_tokens import ActionWords
from fluxvla_pi.lerobot_write import write_policy
from fluxvla_pi.published import FAST, only, table_of

TOKENIZER = "lerobot/fast-action-tokenizer"
"""The tokenizer of actions that LeRobot names."""
PUBLISHED = {"scale": 10, "min_token": -354, "vocab_size": 2048}
"""Its settings; a tokenizer that is fitted to a dataset has others."""
SIZES: Mapping[str, Any] = {
    "variant": "gemma_2b",
    "vision_variant": "so400m",
    "vocab_size": 257152,
}
WORDS = ActionWords()


def write_fast(checkpoint: ForeignCheckpoint, folder: Path) -> None:
    """Write a ``PI0FAST`` into the empty ``folder``; weights keep their dtype.

    Raises:
        CheckpointError: LeRobot's PI0-FAST or its processors cannot do what it does.
    """
    model = checkpoint.model
    sizes = {key: model.get(key, default) for key, default in SIZES.items()}
    if sizes != SIZES:
        raise CheckpointError(f"LeRobot's PI0-FAST has the sizes {SIZES}; this one has {sizes}")
    words = ActionWords.of(model.get("words"), "PI0FAST")
    if replace(words, skipped=WORDS.skipped) != WORDS:
        raise CheckpointError(
            f"LeRobot's PI0-FAST writes actions with PaliGemma's words, {WORDS}; "
            f"this one has {words}"
        )
    only(model, "strict_decoding", False, False)
    only(model, "bos_in_prompt", True, False)
    prompt = table_of(checkpoint, "PreparePromptWithState")
    only(prompt, "state_dim", None, None)
    only(prompt, "ending", "", "Action: ")
    tokenizer = build_tokenizer_from_cfg(model["tokenizer"])
    if not isinstance(tokenizer, FastTokenizer):
        raise CheckpointError(f"the tokenizer of actions is a {type(tokenizer).__name__}")
    inside = folder / Path(TOKENIZER).name
    name = TOKENIZER if _is_published(tokenizer) else inside.name
    written = table_of(checkpoint, "ProcessActionTokens")
    tokens = {
        "trust_remote_code": True,  # as LeRobot saves it: the published tokenizer has Python
        "max_action_tokens": int(written.get("max_len", 256)),
        "action_tokenizer_name": name,
    }
    if words.skipped != WORDS.skipped:
        tokens["fast_skip_tokens"] = words.skipped
    more = {
        "max_action_tokens": tokens["max_action_tokens"],
        "max_decoding_steps": model.get("max_decoding_steps", 256),
        "temperature": model.get("temperature", 0.0),
        "fast_skip_tokens": words.skipped,
        "action_tokenizer_name": name,
        # LeRobot would end the program where an answer does not begin with "Action: ".
        "validate_action_token_prefix": False,
    }
    write_policy(checkpoint, FAST, more, folder, tokens)
    tokenizer.save_pretrained(inside)


def _is_published(tokenizer: FastTokenizer) -> bool:
    settings = read_json(tokenizer.folder / SETTINGS, dict[str, Any], CheckpointError)
    return all(settings.get(key) == value for key, value in PUBLISHED.items())
