"""SmolVLA's published size, its guided sampling, and what it refuses."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from fluxvla_smolvla.images import SmolVLAImages
from fluxvla_smolvla.lerobot_files import published_names
from fluxvla_smolvla.model import SmolVLA
from fluxvla_smolvla.normalization import SmolVLANormalize

from fluxvla_core.errors import ConfigError, DataError

from .tiny import ACTION, HORIZON, SIZES, TEXT, VISION, WIDTH, model_batch, relative, tiny_model

KEYS = json.loads((Path(__file__).parent / "keys" / "smolvla-lerobot061.json").read_text())
ASKED = ("images", "img_masks", "lang_tokens", "lang_masks", "states")


@pytest.fixture(scope="module")
def full():
    with torch.device("meta"):
        return SmolVLA()


def test_the_published_names_and_shapes_are_covered_both_ways(full):
    state = full.state_dict()
    names = published_names(state)
    assert {names[name]: list(tensor.shape) for name, tensor in state.items()} == KEYS
    assert len(state) == 500
    assert sum(tensor.numel() for tensor in state.values()) == 450_046_176


def test_what_is_trained_by_default(full):
    trained = {name for name, p in full.named_parameters() if p.requires_grad}
    roots = {name.partition(".")[0] for name in trained}
    assert roots == {"state_proj", "embed_actions", "expert", "action_out_proj"}
    assert sum(p.numel() for p in full.parameters() if p.requires_grad) == 99_880_992


def asked():
    batch = model_batch()
    return {key: batch[key] for key in ASKED}, batch["noise"][:, 0]


def test_sampling_is_eulers_method():
    model, (batch, noise) = tiny_model(), asked()
    with torch.no_grad():
        cache = model._encode_prefix(*batch.values())
        x = noise
        for t in (1.0, 0.75, 0.5, 0.25):
            x = x - model._velocity(x, torch.full((3,), t), cache) / 4
        assert relative(model.predict_action(**batch, noise=noise), x) < 1e-6


def test_a_prediction_does_not_depend_on_its_company():
    model, (batch, noise) = tiny_model(), asked()
    with torch.no_grad():
        together = model.predict_action(**batch, noise=noise)
        alone = model.predict_action(**{k: v[1:2] for k, v in batch.items()}, noise=noise[1:2])
    assert relative(together[1:2], alone) < 1e-5


def test_padding_under_the_masks_does_not_matter():
    model, (batch, noise) = tiny_model(), asked()
    other = {key: value.clone() for key, value in batch.items()}
    other["images"][1, 3:] = 0.5
    other["lang_tokens"][~other["lang_masks"]] = 7
    with torch.no_grad():
        found = [model.predict_action(**b, noise=noise) for b in (batch, other)]
    assert torch.equal(*found)


def test_a_chunk_continues_another():
    model, (batch, noise) = tiny_model(), asked()
    old = torch.from_numpy(np.random.default_rng(0).normal(size=(3, HORIZON, WIDTH))).float()
    weights = torch.tensor([[1.0, 1.0, 0.7, 0.4, 0.2, 0.0, 0.0]]).expand(3, -1)
    with torch.no_grad():
        free = model.predict_action(**batch, noise=noise)
        kept = model.predict_action(
            **batch,
            noise=noise,
            prev_actions=old,
            prefix_weights=weights,
            prefix_len=torch.tensor([2, 2, 2]),
            max_guidance_weight=torch.full((3,), 5.0),
        )
    assert torch.equal(kept[:, :2, :ACTION], old[:, :2, :ACTION])
    gaps = [(chunk - old)[:, 2:4, :ACTION].abs().mean() for chunk in (kept, free)]
    assert gaps[0] < 0.5 * gaps[1]
    assert all(p.grad is None for p in model.parameters())


def test_what_padding_the_old_chunk_has_does_not_matter():
    model, (batch, noise) = tiny_model(), asked()
    guided = {
        "prefix_weights": torch.ones(3, HORIZON),
        "prefix_len": torch.tensor([1, 1, 1]),
        "max_guidance_weight": torch.full((3,), 5.0),
    }
    found = []
    for padding in (0.0, 100.0):
        old = torch.full((3, HORIZON, WIDTH), padding)
        old[..., :ACTION] = 0.5
        with torch.no_grad():
            found.append(model.predict_action(**batch, noise=noise, prev_actions=old, **guided))
    assert torch.equal(*found)


def several_draws():
    """A batch with two draws of noise and time a sample."""
    batch, drawn = model_batch(), np.random.default_rng(1)
    shape = (3, 2, HORIZON, WIDTH)
    batch["noise"] = torch.from_numpy(drawn.normal(size=shape)).float()
    batch["time"] = torch.from_numpy(drawn.uniform(size=(3, 2))).float()
    return batch


def test_a_prefix_of_no_actions_changes_nothing():
    batch, none = several_draws(), torch.zeros(3, 2, dtype=torch.int64)
    with torch.no_grad():
        free = tiny_model()(**batch)["loss"]
        found = tiny_model(prefix_conditioning=True)(**batch, prefix_len=none)["loss"]
    torch.testing.assert_close(found, free)


def test_actions_of_a_prefix_are_given_without_noise_and_not_counted():
    model = tiny_model(prefix_conditioning=True, loss_mean="all")
    batch, length = several_draws(), torch.tensor([[2, 0], [5, 1], [3, 4]])
    batch["action_masks"] = torch.ones(3, HORIZON)
    given = torch.arange(HORIZON) < length[..., None]
    observed = [batch[key] for key in ("images", "img_masks", "lang_tokens", "lang_masks")]
    total = 0.0
    with torch.no_grad():
        found = model(**batch, prefix_len=length)
        other = {**batch, "noise": torch.where(given[..., None], 9.0, batch["noise"])}
        torch.testing.assert_close(model(**other, prefix_len=length)["loss"], found["loss"])
        # By hand: the velocity at what is half known, errors of the rest over all.
        cache = model._encode_prefix(*observed, batch["states"])
        for k in range(2):
            t = torch.where(given[:, k], 0.0, 1 - batch["time"][:, k : k + 1])
            x = torch.lerp(batch["actions"], batch["noise"][:, k], t[..., None])
            velocity = model._velocity(x, t, cache)
            errors = (batch["noise"][:, k] - batch["actions"] - velocity).square()
            total += (errors * ~given[:, k, :, None])[..., :ACTION].sum().item()
    assert found["loss"].item() == pytest.approx(total / (3 * 2 * HORIZON * ACTION), rel=1e-5)


def test_a_chunk_continues_by_its_prefix():
    model, (batch, noise) = tiny_model(prefix_conditioning=True), asked()
    old = torch.from_numpy(np.random.default_rng(0).normal(size=(3, HORIZON, WIDTH))).float()
    more = {
        "prev_actions": old,
        "prefix_weights": torch.ones(3, HORIZON),
        "prefix_len": torch.tensor([2, 0, 3]),
        "max_guidance_weight": torch.full((3,), 5.0),
    }
    with torch.no_grad():
        found = model.predict_action(**batch, noise=noise, **more)
        free = model.predict_action(**batch, noise=noise)
        later = {**more, "prev_actions": old.clone()}
        later["prev_actions"][0, 2:] = 9.0
        assert torch.equal(model.predict_action(**batch, noise=noise, **later), found)
    assert torch.equal(found[0, :2], old[0, :2])
    assert torch.equal(found[2, :3], old[2, :3])
    assert relative(found[1], free[1]) < 1e-5
    assert not torch.allclose(found[0, 2:], free[0, 2:])


def test_prefixes_and_the_model_belong_together():
    length = torch.zeros(3, 1, dtype=torch.int64)
    with pytest.raises(ConfigError, match="prefix_conditioning is True, and the batch has no"):
        tiny_model(prefix_conditioning=True)(**model_batch())
    with pytest.raises(ConfigError, match="prefix_conditioning is False, and the batch has a"):
        tiny_model()(**model_batch(), prefix_len=length)


def test_units_to_shard_are_disjoint():
    units = tiny_model().fsdp_units()
    seen = [id(p) for unit in units for p in unit.parameters()]
    assert len(units) == 2 + 4 + 4
    assert len(seen) == len(set(seen))


@pytest.mark.parametrize(("layers", "experts"), [(3, 1), (6, 2)])
def test_a_third_of_the_layers_have_an_expert(layers, experts):
    text = {**TEXT, "layers": layers}
    model = tiny_model(text=text, num_expert_layers=experts, train_expert_only=False)
    model(**model_batch())["loss"].backward()
    for name, parameter in model.named_parameters():
        assert parameter.requires_grad == (parameter.grad is not None), name


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"vision": {**VISION, "heads": 3}}, "hidden_size 64 is not a multiple of heads 3"),
        ({"vision": {"width": 3}}, "VisionSize has no 'width'; it has hidden_size"),
        (
            {"vision": {**VISION, "image_size": 60}},
            "image_size 60 is not a multiple of patch_size 8",
        ),
        ({"text": {**TEXT, "kv_heads": 3}}, "heads 2 is not a multiple of kv_heads 3"),
        ({"ori_action_dim": 40}, r"ori_action_dim 40 is not in 1..32 \(max_action_dim\)"),
        ({"num_expert_layers": 3}, "num_expert_layers 3 does not divide the language model's 4"),
        ({"num_expert_layers": 2}, "self_attn_every_n_layers 2 and 2 layers"),
        ({"num_steps": 0}, "num_steps 0 must be positive"),
        ({"max_state_dim": -1}, "max_state_dim -1 must be positive"),
        ({"expert_width_multiplier": 0.0}, "the expert is 0 wide .* expert_width_multiplier 0.0"),
        ({"min_period": 5.0}, "min_period 5.0 and max_period 4.0 must be positive"),
        ({"loss_mean": "sum"}, "loss_mean 'sum' is not one of valid, all"),
    ],
)
def test_sizes_that_do_not_fit_are_refused(settings, words):
    with pytest.raises(ConfigError, match=words):
        SmolVLA(**{**SIZES, **settings})


@pytest.mark.parametrize(
    ("key", "change", "words"),
    [
        ("states", lambda v: v[:, :6], "states have 6 numbers, max_state_dim is 32"),
        (
            "actions",
            lambda v: v[:, :5],
            r"actions are \(5, 32\) .* chunks \(7, 32\)",
        ),
        (
            "noise",
            lambda v: v[..., :5],
            r"noise are \(7, 5\) .* chunks \(7, 32\)",
        ),
        ("img_masks", lambda v: v[:, :1], "images have 6 channels, img_masks 1 cameras"),
        ("images", lambda v: v[:, :5], "images have 5 channels, img_masks 2 cameras"),
    ],
)
def test_batches_that_do_not_fit_are_refused(key, change, words):
    batch = model_batch()
    batch[key] = change(batch[key])
    with pytest.raises(ConfigError, match=words):
        tiny_model()(**batch)


ROW = {"mean": [0.0, 1.0], "std": [1.0, 2.0]}


@pytest.mark.parametrize(
    ("settings", "sample", "words"),
    [
        ({"state_norm": "log"}, {}, "state_norm 'log' is not one of mean_std"),
        ({}, {"stats": {"action": ROW}}, "no entry 'proprio'; they have action"),
        ({"state_norm": "min_max"}, {}, "the statistics 'proprio' have no 'min'; they have mean"),
        ({}, {"states": np.zeros(3)}, r"states have shape \(3,\), the statistics \(2,\)"),
        ({"state_dim": 1}, {}, "state_dim 1 would cut the data's 2 dimensions"),
        (
            {},
            {"stats": {"proprio": ROW, "action": {**ROW, "relative": [1, 1]}}},
            "relative actions",
        ),
        ({}, {"stats": {"proprio": {**ROW, "std": [1.0]}, "action": ROW}}, r"'std' \(1,\)"),
    ],
)
def test_states_and_statistics_that_do_not_fit_are_refused(settings, sample, words):
    whole = {"states": np.zeros(2), "stats": {"proprio": ROW, "action": ROW}, **sample}
    with pytest.raises((ConfigError, DataError), match=words):
        SmolVLANormalize(**settings)(whole)


def test_images_that_do_not_fit_are_refused():
    with pytest.raises(ConfigError, match="height 3 and width None are not a size"):
        SmolVLAImages(height=3)
    with pytest.raises(ConfigError, match="empty_cameras -1 is below 0"):
        SmolVLAImages(empty_cameras=-1)
    two = [np.zeros((3, 4, 6), np.uint8), np.zeros((3, 4, 8), np.uint8)]
    with pytest.raises(DataError, match="cameras of different sizes: 4 x 6, 4 x 8") as caught:
        SmolVLAImages()({"images": two})
    assert "<SmolVLAImages>.height=512" in str(caught.value)


def test_images_that_are_normalised_on_the_device_are_the_same():
    from fluxvla_core.data import Pipeline

    image = np.random.default_rng(0).integers(0, 256, (3, 8, 12)).astype(np.uint8)
    table = {"type": "SmolVLAImages", "empty_cameras": 1}
    pipeline = Pipeline([table, {"type": "SmolVLAPrompt"}])
    sample = {"images": [image], "img_masks": np.array([True]), "task_description": "wave"}
    here, deferred = pipeline(sample), pipeline.deferring()(sample)
    assert deferred["images"].dtype == np.uint8
    divide, multiply, subtract, again = deferred["image_scale"][..., None, None]
    there = (deferred["images"].astype(np.float32) / divide * multiply - subtract) / again
    np.testing.assert_array_equal(here["images"], there)
    np.testing.assert_array_equal(deferred["img_masks"], [True, False])
    assert (here["images"][3:] == -1).all()
    assert deferred["prompt"] == "wave\n"
