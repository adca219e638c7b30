"""A checkpoint whose files do not fit each other is refused before its model is built."""

from __future__ import annotations

import re
from typing import Any

import pytest

pytest.importorskip("torch")

from fluxvla_core.errors import ConfigError, SpecMismatch
from fluxvla_core.models import InputSizes
from fluxvla_core.plugins.registry import VLAS
from fluxvla_core.spec import EmbodimentSpec
from tests.policies.saved import ARM, LittleVLA, load, models, observation, save

__all__ = ["models"]  # a fixture


class SizedVLA(LittleVLA):
    """Says what it takes, and must not be built of what does not fit."""

    input_sizes = InputSizes(
        cameras="num_cameras", image_size=(12, 16), states="action_dim", horizon=4
    )

    def __init__(self, action_dim: int = 2, num_cameras: int = 1) -> None:
        raise AssertionError("it was built")


@pytest.fixture
def sized():
    VLAS.register_module()(SizedVLA)
    yield {"type": "SizedVLA"}
    VLAS.unregister("SizedVLA")


@pytest.mark.parametrize(
    ("model", "changes", "words"),
    [
        ({"num_cameras": 2}, {}, "model.num_cameras: SizedVLA: the number of cameras is 2, in the"),
        (
            {"action_dim": 3},
            {},
            "model.action_dim: SizedVLA: the width of states is 3, in the data",
        ),
        ({}, {"policy.json": {"action_rate_hz": 10.0, "horizon": 5}}, "has 4 actions, the horizon"),
    ],
)
def test_a_model_that_does_not_take_what_it_would_be_given_is_not_built(
    tmp_path, sized, model, changes, words
):
    path = save(tmp_path, config={"model": {**sized, **model}}, **changes)
    with pytest.raises(SpecMismatch, match=words) as error:
        load(path)
    assert error.value.where == str(path)


def test_images_of_another_size_are_refused_before_the_model_is_built(tmp_path, sized):
    kept = [{"type": "NormalizeStatesAndActions", "norm_type": "mean_std"}]
    path = save(tmp_path, config={"model": sized}, dataset={"transforms": kept})
    with pytest.raises(SpecMismatch, match="size of images is 12 x 16, in the data it is 24 x 32"):
        load(path)


def test_who_drives_the_robot_can_refuse_before_the_model_is_built(tmp_path, sized):
    def check(robot: EmbodimentSpec, cameras: tuple[str, ...]) -> None:
        assert (robot, cameras) == (ARM, ("front",))
        raise SpecMismatch("another robot")

    with pytest.raises(SpecMismatch, match="another robot"):
        load(save(tmp_path, config={"model": sized}), check=check)


class ReadingVLA(LittleVLA):
    """Embeds 30 tokens, fewer than the tokenizer has with those that were added to it."""

    input_sizes = InputSizes(vocabulary="words")

    def __init__(self, words: int = 30) -> None:
        super().__init__()

    def predict_action(self, images: Any, states: Any, noise: Any, lang_tokens: Any) -> Any:
        return super().predict_action(images, states, noise)


@pytest.fixture
def reading(tmp_path):
    from tokenizers import Tokenizer, pre_tokenizers
    from tokenizers.models import WordLevel

    words = ["<unk>", "wave", "at", "the", "camera", *(f"word{i}" for i in range(25))]
    known = {word: i for i, word in enumerate(words)}
    made = Tokenizer(WordLevel(known, unk_token="<unk>"))
    made.pre_tokenizer = pre_tokenizers.Whitespace()
    made.add_special_tokens(["<loc>"])
    (tmp_path / "words").mkdir()
    made.save(str(tmp_path / "words" / "tokenizer.json"))
    tokenizer = {"type": "PretrainedTokenizer", "model_path": str(tmp_path / "words")}
    transforms = [
        {"type": "ResizeImages", "height": 12, "width": 16},
        {"type": "NormalizeStatesAndActions", "norm_type": "mean_std"},
        {"type": "ProcessPrompts", "tokenizer": tokenizer, "max_len": 8},
    ]
    VLAS.register_module()(ReadingVLA)
    yield lambda **model: save(
        tmp_path,
        config={"model": {"type": "ReadingVLA", **model}},
        dataset={"transforms": transforms},
    )
    VLAS.unregister("ReadingVLA")


def test_an_instruction_with_a_token_that_the_model_does_not_embed(reading):
    place = reading()
    policy = load(place)
    assert policy.predict_action(observation()).shape == (4, 2)
    typed = {**observation(), "task_description": "wave at <loc>"}
    said = f"the instruction 'wave at <loc>' has the token 30; the policy of {place} knows those"
    with pytest.raises(ConfigError, match=re.escape(f"{said} below 30")) as error:
        policy.predict_action(typed)
    assert error.value.next == "use other words, or name the model's own tokenizer"
    assert policy.predict_action(observation()).shape == (4, 2)


def test_a_tokenizer_of_more_words_than_the_model_embeds(reading):
    place = reading(words=29)
    words = "model.words: ReadingVLA: ids of tokens are below 29, in the data they go up to 29"
    with pytest.raises(SpecMismatch, match=words) as error:
        load(place)
    assert error.value.where == str(place)
