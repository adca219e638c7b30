"""A checkpoint alone is a policy: equal actions for equal seeds, and clear refusals."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from fluxvla_core.errors import CheckpointError, ConfigError, DataError, SpecMismatch
from tests.policies.saved import ARM, MEAN, STD, load, models, observation, save

torch = pytest.importorskip("torch")
safetensors = pytest.importorskip("safetensors.torch")

__all__ = ["models"]  # a fixture


def test_a_policy_is_made_of_the_checkpoint_alone(tmp_path):
    policy = load(save(tmp_path))
    policy.reset(3)

    chunk = policy.predict_action(observation())

    assert (policy.embodiment, policy.action_rate_hz, policy.horizon) == (ARM, 10.0, 4)
    assert policy.cameras == ("front",)
    assert chunk.shape == (4, 2)
    assert chunk.dtype == np.float64
    batch = policy.model.batch
    assert batch["images"].shape == (1, 3, 12, 16)
    assert float(batch["images"].min()) == pytest.approx(1.0)
    # The state is normalised, without the noise that only training adds; actions are undone.
    states = (np.array([0.3, -0.4]) - MEAN) / (np.array(STD) + 1e-6)
    np.testing.assert_allclose(batch["states"][0].numpy(), states, rtol=1e-5)
    expected = (2 * batch["noise"][0].numpy() + states) * STD + MEAN
    np.testing.assert_allclose(chunk, expected, rtol=1e-4)
    assert set(policy.stages) == {"preprocess", "inference", "postprocess"}


def test_the_noise_follows_from_the_seed_and_the_call(tmp_path):
    policy = load(save(tmp_path))
    runs = []
    for seed in (3, 3, 4):
        policy.reset(seed)
        runs.append([policy.predict_action(observation()) for _ in range(3)])

    np.testing.assert_array_equal(runs[0], runs[1])
    assert not np.allclose(runs[0][0], runs[0][1])
    assert not np.allclose(runs[0], runs[2])


def test_a_policy_of_a_mixture_is_for_its_first_dataset(tmp_path):
    alone = load(save(tmp_path / "alone"))
    table = json.loads(
        (tmp_path / "alone/checkpoints/step-000000100/config.resolved.json").read_text()
    )
    first = table["config"]["train_dataloader"]["dataset"]
    mixed = {"type": "DistributedRepeatingDataset", "datasets": [first, {"type": "ParquetDataset"}]}
    policy = load(save(tmp_path / "mixed", config={"train_dataloader": {"dataset": mixed}}))
    for each in (alone, policy):
        each.reset(3)
    np.testing.assert_array_equal(
        alone.predict_action(observation()), policy.predict_action(observation())
    )


def test_averaged_weights_are_preferred(tmp_path):
    assert float(load(save(tmp_path, ema=5.0)).model.gain.detach()) == 5.0


def test_a_model_without_noise_gets_none(tmp_path):
    path = save(tmp_path, config={"model": {"type": "Plain"}})
    policy = load(path)
    policy.reset(0)
    policy.predict_action(observation())

    assert "noise" not in policy.model.batch
    assert {"images", "states", "img_masks"} <= policy.model.batch.keys()


def test_the_specifications_dataset_and_denormalisation_override(tmp_path):
    policy = load(
        save(tmp_path),
        dataset={
            "type": "PrivateInferenceDataset",
            "img_keys": ["front"],
            "transforms": [
                {"type": "ResizeImages", "height": 8, "width": 8},
                {"type": "SimpleNormalizeImages"},
                {"type": "NormalizeStatesAndActions", "norm_type": "none"},
            ],
        },
        denormalize_action={"type": "DenormalizePrivateAction", "norm_type": "mean_std",
                            "action_dim": 2},
    )  # fmt: skip
    policy.reset(0)
    chunk = policy.predict_action(observation())

    batch = policy.model.batch
    assert batch["images"].shape == (1, 3, 8, 8)
    np.testing.assert_allclose(batch["states"][0].numpy(), [0.3, -0.4], rtol=1e-6)
    expected = (2 * batch["noise"][0].numpy() + batch["states"][0].numpy()) * STD + MEAN
    np.testing.assert_allclose(chunk, expected, rtol=1e-4)


def test_images_with_more_pixels_are_scaled_before_pixels_are_cut_by_number(tmp_path):
    crop = {"type": "CropImages", "top": 0, "left": 0, "height": 12, "width": 32}
    transforms = [
        crop,
        {"type": "NormalizeImages", "means": [[0] * 3], "stds": [[1] * 3]},
        {"type": "NormalizeStatesAndActions"},
    ]
    policy = load(save(tmp_path, dataset={"transforms": transforms}))
    policy.reset(0)
    large = observation()
    large["images"]["front"] = np.zeros((96, 128, 3), np.uint8)
    large["images"]["front"][:48] = 200

    policy.predict_action(large)

    # The upper half of the view, whatever its pixels.
    assert policy.model.batch["images"].shape == (1, 3, 12, 32)
    assert float(policy.model.batch["images"].min()) == pytest.approx(200, rel=1e-6)

    large["images"]["front"] = np.zeros((0, 128, 3), np.uint8)
    with pytest.raises(DataError, match=r"gives uint8 of shape \(0, 128, 3\)"):
        policy.predict_action(large)
    large["images"]["front"] = np.zeros((96, 96, 3), np.uint8)
    with pytest.raises(DataError, match=r"'front' gives 96 x 96 images; .* on 24 x 32: another vi"):
        policy.predict_action(large)


def test_bf16_computes_and_still_gives_float64(tmp_path):
    policy = load(save(tmp_path), mixed_precision_dtype="bf16")
    policy.reset(0)

    assert policy.predict_action(observation()).dtype == np.float64
    with pytest.raises(
        ConfigError, match="mixed_precision_dtype 'fp16' is unknown; choose one of float32, bf16"
    ):
        load(save(tmp_path), mixed_precision_dtype="fp16")


@pytest.mark.parametrize(
    ("environment", "count", "device"),
    [
        ({}, 8, "cuda"),
        ({"LOCAL_RANK": "0"}, 8, "cuda:0"),
        ({"LOCAL_RANK": "5"}, 8, "cuda:5"),
        ({"LOCAL_RANK": "5"}, 2, "cuda:1"),
        ({"LOCAL_RANK": "3"}, 1, "cuda:0"),
        ({"LOCAL_RANK": "3"}, 0, "cuda"),
        ({"SLURM_LOCALID": "2"}, 4, "cuda:2"),
        ({"LOCAL_RANK": "1", "SLURM_LOCALID": "0"}, 4, "cuda:1"),
    ],
)
def test_processes_of_one_machine_have_a_gpu_each(environment, count, device):
    from fluxvla_core.policies.loading import own_device

    assert own_device(environment, count) == device


def test_a_plain_cuda_is_the_gpu_of_this_process(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(torch.nn.Module, "to", lambda self, device: asked.append(device) or self)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setenv("LOCAL_RANK", "3")
    path = save(tmp_path)
    assert load(path, device="cuda").device == "cuda:1"
    assert load(path, device="cuda:0").device == "cuda:0"
    assert asked == ["cuda:1", "cuda:0"]


def test_a_work_dir_means_its_newest_whole_checkpoint(tmp_path):
    from fluxvla_core.policies.loading import find_checkpoint

    save(tmp_path, step=100)
    newest = save(tmp_path, step=200)
    assert find_checkpoint(None, tmp_path) == newest
    assert find_checkpoint(newest, tmp_path / "elsewhere") == newest

    (newest / "model.safetensors").write_bytes(b"")
    assert find_checkpoint(None, tmp_path).name == "step-000000100"


def test_a_work_dir_that_is_named_means_its_newest_whole_checkpoint_too(tmp_path, caplog):
    from fluxvla_core.policies.loading import find_checkpoint, load_policy

    whole = save(tmp_path, step=100)
    damaged = save(tmp_path, step=200)
    (damaged / "model.safetensors").write_bytes(b"")

    assert find_checkpoint(tmp_path, tmp_path / "elsewhere") == whole
    assert "damaged" in caplog.text
    assert damaged.name in caplog.text
    assert load_policy(tmp_path).source == str(whole)
    with pytest.raises(CheckpointError, match="damaged"):
        load_policy(damaged)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"embodiment.json": None}, SpecMismatch, "does not say the embodiment: what its actions"),
        (
            {"policy.json": {"action_rate_hz": None, "horizon": None}},
            SpecMismatch,
            "does not say action_rate_hz, horizon",
        ),
        ({"dataset": {"use_delta": True}}, SpecMismatch, "trained with use_delta=True"),
        (
            {"config": {"train_dataloader": {}}},
            CheckpointError,
            "train_dataloader.dataset has no img_keys, transforms",
        ),
        ({"dataset": {"transforms": []}}, ConfigError, "no transform knows how actions were"),
    ],
)
def test_what_a_checkpoint_does_not_say_is_named(tmp_path, changes, error, message):
    path = save(tmp_path, **changes)

    with pytest.raises(error, match=message) as caught:
        load(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("rate", "horizon", "message"),
    [
        ("-1", "4", "action_rate_hz: input should be greater than 0"),
        ("0", "4", "action_rate_hz: input should be greater than 0"),
        ("1e999", "4", "action_rate_hz: input should be less than inf"),
        ("NaN", "4", "action_rate_hz: "),
        ('"10"', "4", "action_rate_hz: input should be a valid number"),
        ("10.0", "0", "horizon: input should be greater than or equal to 1"),
        ("10.0", "2.5", "horizon: input should be a valid integer"),
    ],
)
def test_chunks_that_cannot_be_played_are_refused_on_loading(tmp_path, rate, horizon, message):
    text = f'{{"action_rate_hz": {rate}, "horizon": {horizon}}}'
    path = save(tmp_path, **{"policy.json": text.encode()})

    with pytest.raises(CheckpointError, match=re.escape(f"policy.json: {message}")) as caught:
        load(path)
    assert str(path) in str(caught.value)


def test_a_config_without_a_model_is_no_policy(tmp_path):
    path = save(tmp_path)
    config = json.loads((path / "config.resolved.json").read_text())
    del config["config"]["model"]
    changed = {"config.resolved.json": config}

    with pytest.raises(CheckpointError, match="the checkpoint's config has no section 'model'"):
        load(save(tmp_path, step=300, **changed))


def test_weights_of_another_model_and_damaged_files_are_refused(tmp_path):
    path = save(tmp_path)
    (path / "dataset_statistics.json").write_text("{}")
    with pytest.raises(CheckpointError, match=r"dataset_statistics.json is damaged"):
        load(path)
    from fluxvla_core.checkpoints.writer import CheckpointWriter

    with CheckpointWriter(tmp_path, 400, 1) as writer:
        for name in ("config.resolved.json", "embodiment.json", "policy.json", "trainer.json"):
            writer.write_bytes(name, (path / name).read_bytes())
        stats = {"private": {k: {"mean": MEAN, "std": STD} for k in ("proprio", "action")}}
        writer.write_json("dataset_statistics.json", stats)
        other = safetensors.save({"other": torch.zeros(3)})
        writer.write_bytes("model.safetensors", other)
        wrong = writer.commit()
    with pytest.raises(CheckpointError, match="gain"):
        load(wrong)
