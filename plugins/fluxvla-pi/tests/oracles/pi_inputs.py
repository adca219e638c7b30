"""Sizes and inputs of tiny models that every reference can make alike; numpy alone."""

from __future__ import annotations

import numpy as np

from tests.oracles import fill

GEMMA = {"width": 32, "depth": 3, "mlp_dim": 48, "heads": 8, "kv_heads": 1, "head_dim": 8}
EXPERT = {**GEMMA, "width": 24, "mlp_dim": 40}
VISION = {
    "width": 32,
    "depth": 2,
    "mlp_dim": 48,
    "heads": 16,
    "image_size": 28,
    "patch_size": 14,
}
VOCABULARY = 64
HORIZON, ACTIONS, STATES = 5, 8, 8
BATCH, CAMERAS, WORDS = 3, 2, 6
PATCHES = (VISION["image_size"] // VISION["patch_size"]) ** 2
SIZES = {
    "variant": GEMMA,
    "expert_variant": EXPERT,
    "vision_variant": VISION,
    "vocab_size": VOCABULARY,
    "n_action_steps": HORIZON,
    "max_action_dim": ACTIONS,
}


def inputs():
    """A batch. ``tau`` has few bits, so that ``1 - tau`` is exact in float32.

    The second sample has but one camera, and samples have 6, 4 and 5 words.
    """
    side = VISION["image_size"]
    return {
        "images": fill.uniform("images", (BATCH, 3 * CAMERAS, side, side), -1, 1),
        "img_masks": np.array([[True, True], [True, False], [True, True]]),
        "lang_tokens": fill.integers("lang_tokens", (BATCH, WORDS), VOCABULARY),
        "lang_masks": np.arange(WORDS)[None] < np.array([[6], [4], [5]]),
        "states": fill.normal("states", (BATCH, STATES)),
        "actions": fill.normal("actions", (BATCH, HORIZON, ACTIONS)),
        "noise": fill.normal("noise", (BATCH, HORIZON, ACTIONS)),
        "tau": np.array([0.125, 0.6875, 0.9375], np.float32),
    }


# -- a policy with everything around it ----------------------------------------------------------

SIZES_OF_CAMERAS = {"front": (48, 64), "wrist": (40, 30)}
ROBOT_ACTIONS, ROBOT_STATES = 7, 7
TASKS = {"pi0": "put the red_block away", "pi05": " put the red_block\naway "}
SEED = 5
LETTERS = "abcdefghijklmnopqrstuvwxyzTSA0123456789 ,:;_-\n"


def tokenizer():
    """A tokenizer of single letters, with PaliGemma's special ones in its places."""
    from tokenizers import Regex, Tokenizer, models, pre_tokenizers, processors

    special = ["<pad>", "<eos>", "<bos>", "<unk>"]
    vocabulary = {token: i for i, token in enumerate([*special, *LETTERS])}
    made = Tokenizer(models.WordLevel(vocabulary, unk_token="<unk>"))
    made.pre_tokenizer = pre_tokenizers.Split(Regex(r"[\s\S]"), "isolated")
    made.post_processor = processors.TemplateProcessing("<bos> $A", None, [("<bos>", 2)])
    made.add_special_tokens(special)
    return made


def statistics():
    """As LeRobot has them: key -> name -> numbers; one action never moved."""
    found = {}
    for key, width in (("observation.state", ROBOT_STATES), ("action", ROBOT_ACTIONS)):
        mean = fill.normal(f"{key}.mean", (width,), 0.5)
        std = fill.uniform(f"{key}.std", (width,), 0.2, 1.0)
        if key == "action":
            std[2] = 0
        found[key] = {"mean": mean, "std": std}
        for name, times in (("min", -3), ("max", 3), ("q01", -2), ("q99", 2)):
            found[key][name] = mean + np.float32(times) * std
    return found


def observation():
    """Images ``(H, W, 3)`` uint8 by camera, and the state in a robot's units."""
    images = {
        name: fill.integers(f"picture.{name}", (*size, 3), 256).astype(np.uint8)
        for name, size in SIZES_OF_CAMERAS.items()
    }
    mean, std = (statistics()["observation.state"][name] for name in ("mean", "std"))
    return images, mean + fill.normal("state", (ROBOT_STATES,)) * std


def chunk():
    """Actions in a robot's units ``(1, T, D)``, some beyond all that the statistics saw."""
    mean, std = (statistics()["action"][name] for name in ("mean", "std"))
    return (mean + 2 * fill.normal("chunk", (1, HORIZON, ROBOT_ACTIONS)) * std).astype(np.float32)


def first_noise():
    """``(1, T, D)``: what a policy here draws in an episode of ``SEED`` for its first chunk."""
    generator = np.random.Generator(np.random.Philox(key=np.array([SEED, 0], np.uint64)))
    return generator.standard_normal((1, HORIZON, ACTIONS), dtype=np.float32)


# -- PI0-FAST ------------------------------------------------------------------------------------

FAST_WORDS, FAST_VOCABULARY = 576, 288
FAST_TOKENS, FAST_STEPS = 24, 12
_FAST_TEXT = ["<pad>", "<eos>", "<bos>", "<unk>", *LETTERS, "|"]
ACTION_WORDS = {
    "vocab_size": FAST_WORDS,
    "skipped": 128,
    "bos": 2,
    "begin": [_FAST_TEXT.index(letter) for letter in "Action: "],
    "stop": _FAST_TEXT.index("|"),
    "eos": 1,
}
FAST_SIZES = {
    "variant": GEMMA,
    "vision_variant": VISION,
    "vocab_size": FAST_WORDS,
    "n_action_steps": HORIZON,
    "action_dim": ROBOT_ACTIONS,
    "words": ACTION_WORDS,
    "max_decoding_steps": FAST_STEPS,
}


def fast_text_tokenizer(template="<bos> $A"):
    """As :func:`tokenizer`, with more words, which no text has: they are for actions."""
    from tokenizers import Regex, Tokenizer, models, pre_tokenizers, processors

    words = [*_FAST_TEXT, *(f"<word{i}>" for i in range(len(_FAST_TEXT), FAST_WORDS))]
    made = Tokenizer(models.WordLevel({w: i for i, w in enumerate(words)}, unk_token="<unk>"))
    made.pre_tokenizer = pre_tokenizers.Split(Regex(r"[\s\S]"), "isolated")
    special = [(word, words.index(word)) for word in ("<bos>", "<eos>") if word in template]
    made.post_processor = processors.TemplateProcessing(template, None, special)
    made.add_special_tokens(_FAST_TEXT[:4])
    return made


def fast_chunks():
    """What the FAST tokenizer is fitted to: ``(400, T, D)``."""
    return 2 * fill.normal("fast.chunks", (400, HORIZON, ROBOT_ACTIONS))


def fast_inputs():
    """A batch as :func:`inputs`; answers have 24, 13 and 18 tokens."""
    found = inputs()
    real = np.arange(FAST_TOKENS)[None] < np.array([[24], [13], [18]])
    tokens = fill.integers("action_tokens", (BATCH, FAST_TOKENS), FAST_WORDS)
    tokens[:, 0] = ACTION_WORDS["bos"]
    return {
        **{key: found[key] for key in ("images", "img_masks", "lang_masks")},
        "lang_tokens": fill.integers("fast.lang_tokens", (BATCH, WORDS), FAST_WORDS),
        "action_tokens": np.where(real, tokens, 0),
        "action_token_masks": real,
    }


def fast_answers(ids):
    """Answers as a model may give them, ``ids`` being a chunk's of the FAST tokenizer."""
    last = FAST_WORDS - 1 - ACTION_WORDS["skipped"]
    begin, stop = ACTION_WORDS["begin"], ACTION_WORDS["stop"]
    chunk = [last - i for i in ids]
    return {
        "whole": [*begin, *chunk, stop, ACTION_WORDS["eos"]],
        "without_stop": [*begin, *chunk],
        "too_short": [*begin, *chunk[: len(chunk) // 2], stop],
        "too_long": [*begin, *chunk, *chunk, stop],
        "begun_twice": [*begin, *chunk[:4], *begin, *chunk[4:], stop],
        "with_words": [*begin, *chunk[:3], 9, 12, *chunk[3:], stop],
        "beyond_the_last": [*begin, *chunk[:3], FAST_WORDS - 1, *chunk[3:], stop],
        "nothing": [stop, *chunk],
        "one_short": [*begin, *chunk[:-1], stop],
        "one_more": [*begin, *chunk, chunk[-1], stop],
        "two_stops": [*begin, *chunk, stop, *chunk, stop],
        "no_begin": [*chunk, stop],
        "half_begun": [*begin[:4], *chunk, stop],
        "padded": [*begin, 0, *chunk[:5], 0, 0, *chunk[5:], stop],
        "first_of_the_vocabulary": [*begin, last, last, last, stop],
        "last_of_the_vocabulary": [*begin, *[last - (FAST_VOCABULARY - 1)] * 3, stop],
        "past_the_vocabulary": [*begin, last - FAST_VOCABULARY, *chunk[:2], stop],
    }
