"""Samples of several observations, and of actions before the present one's."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fluxvla_core.build import RunContext
from fluxvla_core.data.dataset import ParquetDataset
from fluxvla_core.data.loader import DictCollator, make_loader
from fluxvla_core.data.mixture import DistributedRepeatingDataset
from fluxvla_core.data.sampler import StepPlan, StepSampler
from fluxvla_core.data.transforms.images import normalized
from fluxvla_core.errors import ConfigError, DataError
from fluxvla_core.training.fit_checks import check_observations

STARTS = (0, 7, 19)
SIZED = {"type": "ResizeImages", "height": 16, "width": 24}
SHIFTED = {"type": "RandomShiftImages", "pixels": 6}
SCALED = {"type": "SimpleNormalizeImages"}
TRANSFORMS = [
    {"type": "NormalizeStatesAndActions", "std_floor": 0.01},
    SIZED,
    SHIFTED,
    SCALED,
    {"type": "SampleFlowNoise"},
]
KEYS = ["images", "states", "actions", "action_masks", "noise", "sample_ids"]
META = ["img_masks", "task_description", "timestamp", "info", "time"]


def load(root, transforms=(SIZED,), img_keys=("top", "wrist"), **options):
    options = {"n_obs_steps": 3, "past_actions": 2, "action_window_size": 4, **options}
    return ParquetDataset(str(root), list(transforms), list(img_keys), **options)


@pytest.mark.parametrize("cached", [False, True])
def test_frames_and_actions_of_the_steps_before(shared, takes, cached):
    dataset, alone = load(shared, cache_frames=cached), load(shared, n_obs_steps=1, past_actions=0)
    for take, start in zip(takes, STARTS, strict=True):
        length = len(take.state)
        for t in range(length):
            sample = dataset[start + t]
            # LeRobot: an index beyond an episode is that of its first, or last, frame.
            seen = np.clip(np.arange(t - 2, t + 1), 0, length - 1)
            window = np.arange(t - 2, t + 2)
            inside = (window >= 0) & (window < length)
            np.testing.assert_array_equal(sample["states"], take.state[seen])
            np.testing.assert_array_equal(
                sample["actions"], take.action[window.clip(0, length - 1)]
            )
            assert sample["action_masks"].tolist() == inside.astype(float).tolist()
            expected = np.stack([alone[start + step]["images"] for step in seen])
            np.testing.assert_array_equal(sample["images"], expected)
            assert sample["images"].shape == (3, 6, 16, 24)
            assert sample["img_masks"].shape == (2,)
            assert sample["info"]["frame_index"] == t


def test_all_observations_of_a_sample_are_shifted_alike(shared):
    plain, shifted = (load(shared, [SIZED, *more], ["top"]) for more in ([], [SHIFTED]))
    moved = set()
    for index in range(8, 14):
        still, sample = plain[index]["images"], shifted[index]["images"]
        found = []
        for before, after in zip(still, sample, strict=True):
            near = [
                (down, right)
                for down in range(-6, 7)
                for right in range(-6, 7)
                if np.array_equal(after, shift(before, down, right))
            ]
            found.append(near)
        common = set(found[0]).intersection(*found[1:])
        assert common
        moved |= common
    assert len(moved) > 2


def shift(image, down, right):
    rows = np.clip(np.arange(image.shape[1]) + down, 0, image.shape[1] - 1)
    columns = np.clip(np.arange(image.shape[2]) + right, 0, image.shape[2] - 1)
    return image[:, rows[:, None], columns]


def test_batches_do_not_depend_on_workers_or_on_where_images_are_normalised(shared):
    dataset = load(shared, TRANSFORMS)
    batches = []
    for source, workers in ((dataset, 0), (dataset, 2), (dataset.deferring(), 0)):
        sampler = StepSampler(StepPlan(len(dataset), 4, seed=3))
        loader = make_loader(source, DictCollator(KEYS, META), list(sampler.epoch(0)), workers)
        batches.append([normalized(batch) for batch in loader])
    first = batches[0]
    assert first[0]["images"].shape == (4, 3, 6, 16, 24)
    assert first[0]["images"].dtype == torch.float32
    assert first[0]["noise"].shape[-2:] == (4, 3)
    for others in batches[1:]:
        for one, other in zip(first, others, strict=True):
            assert one.keys() == other.keys()
            assert all(torch.equal(one[key], other[key]) for key in KEYS)


def test_statistics_of_windows_leave_out_what_is_before_an_episode(shared, takes):
    stats = load(shared, per_step_statistics=True).statistics["private"]["action"]
    for step in range(4):
        rows = [
            take.action[max(step - 2, 0) : len(take.action) - max(2 - step, 0)] for take in takes
        ]
        np.testing.assert_allclose(stats["mean"][step], np.concatenate(rows).mean(0), rtol=1e-5)


def test_what_does_not_fit_is_refused(shared):
    with pytest.raises(ConfigError, match="past_actions 4 from 0 to 3, below action_window_size"):
        load(shared, past_actions=4)
    with pytest.raises(ConfigError, match="n_obs_steps 0 must be at least 1"):
        load(shared, n_obs_steps=0)
    with pytest.raises(DataError, match="different sizes cannot be stacked"):
        load(shared, ())[0]


@pytest.mark.parametrize("name", ["n_obs_steps", "past_actions"])
def test_a_dataset_shows_what_its_model_takes(shared, name):
    settings = {"n_obs_steps": 2, "past_actions": 1}
    check_observations(settings, load(shared, **settings), RunContext())
    wrong = load(shared, **{**settings, name: settings[name] - 1})
    told = rf"{name} of the model is {settings[name]}, that of the dataset {settings[name] - 1}"
    mixture = DistributedRepeatingDataset([wrong])
    for dataset in (wrong, mixture):
        with pytest.raises(ConfigError, match=told) as caught:
            check_observations(settings, dataset, RunContext(), "val_dataloader")
        assert f"val_dataloader.dataset.{name}={settings[name]}" in str(caught.value.next)
