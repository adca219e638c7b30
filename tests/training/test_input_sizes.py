"""What a model's class says about its batches, read from a config without building anything."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from fluxvla_core import HEADS, VISION_BACKBONES, VLAS, RunContext
from fluxvla_core.errors import CheckpointError, ConfigError
from fluxvla_core.models import VLA, InputSizes
from fluxvla_core.training.fit_checks import check_data, check_family, observations_in
from fluxvla_core.training.input_sizes import Declared, chunk_of, declared_sizes, misfits

torch = pytest.importorskip("torch")


class Head:
    def __init__(self, horizon: int = 8, width: int = 16) -> None:
        raise AssertionError("it was built")


class Seeing:
    def __init__(self, num_cameras: int = 1) -> None:
        raise AssertionError("it was built")


class BaseSized(VLA, torch.nn.Module):
    input_sizes = InputSizes(
        cameras="vision_backbone.num_cameras | vlm_backbone.num_cameras",
        image_size=("side", lambda side: side * 2),
        actions="action_dim",
        horizon="vla_head.horizon",
        n_obs_steps="n_obs",
        embodiments=3,
        vocabulary=50,
        float_images=True,
    )

    def __init__(self, vla_head=None, vision_backbone=None, action_dim=7, side=14, n_obs=1):
        raise AssertionError("it was built")

    def predict_action(self, states):
        return states


class Sized(BaseSized):
    input_sizes = replace(BaseSized.input_sizes, states="state_dim")

    def __init__(self, state_dim: int | None = 6, **kwargs):
        super().__init__(**kwargs)


class Unsized(torch.nn.Module):
    def __init__(self):
        raise AssertionError("it was built")

    def predict_action(self, states):
        return states


KINDS = ((HEADS, Head), (VISION_BACKBONES, Seeing))
MODELS = (BaseSized, Sized, Unsized)


@pytest.fixture(autouse=True)
def registered():
    every = [*KINDS, *((VLAS, cls) for cls in MODELS)]
    for registry, cls in every:
        registry.register_module()(cls)
    yield
    for registry, cls in every:
        registry.unregister(cls.__name__)


TABLE = {"type": "Sized", "vla_head": {"type": "Head"}}


def batch(**changes):
    made = {
        "images": torch.zeros(1, 3, 28, 28),
        "states": torch.zeros(1, 6),
        "actions": torch.zeros(1, 8, 7),
        "embodiment_ids": torch.zeros(1, dtype=torch.int64),
    }
    return {**made, **changes}


def test_sizes_are_arguments_their_defaults_those_of_parts_and_of_base_classes():
    found = declared_sizes({**TABLE, "vision_backbone": {"type": "Seeing", "num_cameras": 2}})
    assert found == {
        "cameras": Declared("vision_backbone.num_cameras", 2),
        "image_size": Declared("side", 28),
        "states": Declared("state_dim", 6),
        "actions": Declared("action_dim", 7),
        "horizon": Declared("vla_head.horizon", 8),
        "n_obs_steps": Declared("n_obs", 1),
        "embodiments": Declared("", 3),
        "vocabulary": Declared("", 50),
        "float_images": Declared("", True),
    }
    assert chunk_of(found) == (8, 7)


@pytest.mark.parametrize(
    ("change", "gone"),
    [
        ({"state_dim": None}, "states"),
        ({"state_dim": "six"}, "states"),
        ({"side": "wide"}, "image_size"),
        ({"vla_head": None}, "horizon"),
        ({"vla_head": {"type": "Seeing"}}, "horizon"),
    ],
)
def test_what_is_not_said_or_makes_no_sense_is_any(change, gone):
    found = declared_sizes({**TABLE, **change})
    assert gone not in found
    assert "actions" in found


def test_a_model_that_says_nothing_or_is_built_already_takes_anything():
    assert declared_sizes({"type": "Unsized"}) == {}
    assert declared_sizes(object()) == {}
    assert misfits({"type": "Unsized"}, batch()) == []


def test_what_fits_is_no_misfit():
    assert misfits(TABLE, batch()) == []
    assert misfits(TABLE, {"states": torch.zeros(1, 6)}) == []
    assert misfits(TABLE, batch(actions=[np.zeros((8, 7))])) == []


@pytest.mark.parametrize(
    ("change", "key", "words"),
    [
        ({"images": torch.zeros(1, 3, 28, 30)}, "side", "is 28 x 28, in the data it is 28 x 30"),
        ({"images": torch.zeros(1, 3, 28, 28).byte()}, "", "floats, in the data they are uint8"),
        (
            {"states": torch.zeros(1, 2, 5)},
            "state_dim",
            "width of states is 6, in the data it is 5",
        ),
        ({"actions": torch.zeros(1, 9, 7)}, "vla_head.horizon", "is 8, in the data it is 9"),
        ({"actions": [np.zeros((8, 4))]}, "action_dim", "is 7, in the data it is 4"),
        ({"embodiment_ids": torch.tensor([3])}, "", "are below 3, in the data one is 3"),
        ({"embodiment_ids": torch.tensor([-1])}, "", "are below 3, in the data one is -1"),
        (
            {"lang_tokens": torch.tensor([[7, 50, 8]])},
            "",
            "ids of tokens are below 50, in the data they go up to 50",
        ),
    ],
)
def test_a_misfit_names_the_key_and_both_values(change, key, words):
    (found,) = misfits(TABLE, batch(**change))
    assert found.key == key
    assert found.text.startswith("Sized: ")
    assert words in found.text


def test_words_that_the_batch_does_not_have_count_too():
    shown = batch(lang_tokens=torch.tensor([[7, 49, 8]]))
    assert misfits(TABLE, shown, tokens=50) == []
    (found,) = misfits(TABLE, shown, tokens=51)
    assert found.text == "Sized: ids of tokens are below 50, in the data they go up to 50"


class Data:
    """Samples of one shape."""

    def __init__(self, width=6, datasets=(), n_obs_steps=1):
        self.width, self.datasets, self.n_obs_steps = width, datasets, n_obs_steps

    def __len__(self):
        return 1

    def get_sample(self, index, epoch):
        return {
            name: value[0].numpy()
            for name, value in batch(states=torch.zeros(1, self.width)).items()
        }


def stack(samples):
    return {name: torch.stack([torch.as_tensor(s[name]) for s in samples]) for name in samples[0]}


def context(**table):
    origins = {"model": "a.py:3", "model.state_dim": "a.py:4", "val_dataloader.dataset": "a.py:7"}
    return RunContext(config={"model": {**TABLE, **table}}, section="runner", origins=origins)


def test_the_first_sample_of_every_dataset_is_compared():
    check_data(context(), Data(), stack)
    wrong = r"a.py:4: model.state_dim: Sized: the width of states is 6, in the data it is 5"
    for data in (Data(5), Data(datasets=[Data(), Data(5)])):
        with pytest.raises(ConfigError, match=wrong) as error:
            check_data(context(), data, stack)
        assert "or those that a transform pads them to" in str(error.value)


class Words:
    """A tokenizer of so many words."""

    def __init__(self, count):
        self.base_vocab_size = count

    def encode(self, text):
        return [0]


@pytest.mark.parametrize("tokenizer", [None, object(), Words(50), Words(None)])
def test_a_tokenizer_that_fits_or_does_not_say_how_many_words_it_has(tokenizer):
    data = Data()
    data.pipeline = SimpleNamespace(transforms=[SimpleNamespace(tokenizer=tokenizer)])
    check_data(context(), data, stack)


def test_the_tokenizer_of_every_dataset_is_compared():
    other = Data()
    other.pipeline = SimpleNamespace(transforms=[SimpleNamespace(tokenizer=Words(60))])
    wrong = "a.py:3: model: Sized: ids of tokens are below 50, in the data they go up to 59"
    for data in (other, Data(datasets=[Data(), other])):
        with pytest.raises(ConfigError, match=wrong) as error:
            check_data(context(), data, stack)
        assert "let the transforms' tokenizer be the one of the model" in error.value.next


def test_a_dataset_need_not_keep_its_frames_in_memory_for_it():
    data = Data()
    data.uncached = lambda: Data(5)
    data.get_sample = None
    with pytest.raises(ConfigError, match="in the data it is 5"):
        check_data(context(), data, stack)


def test_other_observations_than_the_models():
    assert observations_in(TABLE, declared_sizes(TABLE)) == {"n_obs_steps": 1, "past_actions": 0}
    with pytest.raises(ConfigError, match="n_obs_steps of the model is 1, that of the dataset 2"):
        check_data(context(), Data(n_obs_steps=2), stack)


def test_validation_data_are_compared_too_and_all_that_does_not_fit_is_listed_at_once():
    check_data(context(), Data(), stack, Data())
    with pytest.raises(ConfigError) as error:
        check_data(context(), Data(5), stack, Data(datasets=[Data(4, n_obs_steps=2), Data(4)]))
    assert [str(problem) for problem in error.value.problems] == [
        "a.py:4: model.state_dim: Sized: the width of states is 6, in the data it is 5",
        "a.py:7: val_dataloader.dataset.n_obs_steps: n_obs_steps of the model is 1, that of the "
        "dataset 2",
        "a.py:4: model.state_dim: Sized: the width of states is 6, in the validation data it is 4",
    ]
    assert error.value.next.count("those that a transform pads them to") == 1
    assert "--set val_dataloader.dataset.n_obs_steps=1" in error.value.next


def checkpoint(folder, kind, **parts):
    from fluxvla_core.checkpoints.writer import CheckpointWriter

    with CheckpointWriter(folder, 1, 0) as writer:
        tree = {"model": {"type": kind, **parts}}
        config = {"format": "fluxvla-config-1", "config": tree, "origins": {}}
        writer.write_json("config.resolved.json", config)
        return writer.commit()


def test_a_checkpoint_of_another_family(tmp_path):
    path = checkpoint(tmp_path, "Unsized")
    with pytest.raises(CheckpointError, match="of Unsized, the config's model is Sized") as error:
        check_family(str(tmp_path), TABLE)
    assert error.value.where == str(path)


@pytest.mark.parametrize("kind", ["Sized", "some-plugin:Sized", "BaseSized", "NotInstalled"])
def test_a_checkpoint_of_the_same_family_or_of_an_unknown_one(tmp_path, kind):
    checkpoint(tmp_path, kind)
    check_family(str(tmp_path), TABLE)


def test_a_checkpoint_of_the_same_class_with_another_part(tmp_path):
    path = checkpoint(tmp_path, "Sized", vla_head={"type": "Seeing"})
    words = "the vla_head of the checkpoint's Sized is Seeing, that of the config's model is Head"
    HEADS.register_module()(Seeing)
    try:
        with pytest.raises(CheckpointError, match=words) as error:
            check_family(str(tmp_path), TABLE)
    finally:
        HEADS.unregister("Seeing")
    assert error.value.where == str(path)
    assert "let model.vla_head.type be Seeing" in error.value.next


@pytest.mark.parametrize("part", [{"type": "NotInstalled"}, {"type": "some-plugin:Head"}, None])
def test_a_part_of_the_same_class_or_of_an_unknown_one(tmp_path, part):
    checkpoint(tmp_path, "Sized", vla_head=part)
    check_family(str(tmp_path), TABLE)
