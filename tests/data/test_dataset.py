from __future__ import annotations

import json
import pickle
from itertools import islice

import numpy as np
import pytest
import torch

from fluxvla_core import build_dataset_from_cfg
from fluxvla_core.data import frames
from fluxvla_core.data.dataset import ParquetDataset
from fluxvla_core.data.loader import DictCollator, make_loader
from fluxvla_core.data.sampler import SampleKey, StepPlan, StepSampler
from fluxvla_core.data.video_decode import VideoFile
from fluxvla_core.errors import ConfigError, DataError, SpecMismatch

STARTS = (0, 7, 19)
TRANSFORMS = [
    {"type": "StateNoise", "std": 0.1, "state_key": "proprio"},
    {"type": "NormalizeStatesAndActions", "std_floor": 0.01, "action_dim": 5},
    {"type": "ResizeImages", "height": 16, "width": 24},
    {"type": "RandomShiftImages", "pixels": 2},
    {"type": "SimpleNormalizeImages"},
    {"type": "SampleFlowNoise", "repeats": 2},
]
KEYS = (
    *("images", "img_masks", "states", "actions", "action_masks", "noise", "time"),
    *("sample_ids", "timestamp"),
)


def load(root, transforms=(), img_keys=("top", "wrist"), **options):
    return ParquetDataset(str(root), list(transforms), list(img_keys), **options)


def same(left, right):
    return set(left) == set(right) and all(np.array_equal(left[k], right[k]) for k in KEYS)


def test_samples_are_what_was_recorded(shared, takes):
    dataset = build_dataset_from_cfg(
        {
            "type": "ParquetDataset",
            "data_root_path": str(shared),
            "img_keys": ["observation.images.top"],
            "transforms": [],
            "action_window_size": 5,
            "embodiment_id": 3,
        }
    )
    assert len(dataset) == 28
    assert dataset.fps == 10
    assert dataset.tasks == ("hold the cube", "hand the cube over")
    assert dataset.embodiment.joint_names == ("waist", "elbow", "gripper")
    for take, start in zip(takes, STARTS, strict=True):
        for t in range(len(take.state)):
            sample = dataset[start + t]
            np.testing.assert_array_equal(sample["states"], take.state[t])
            there = min(5, len(take.state) - t)
            np.testing.assert_array_equal(sample["actions"][:there], take.action[t : t + there])
            assert (sample["actions"][there:] == take.action[-1]).all()
            assert sample["action_masks"].tolist() == [1.0] * there + [0.0] * (5 - there)
            error = np.abs(sample["images"].transpose(1, 2, 0).astype(int) - take.top[t])
            assert error.mean() < 6
            assert sample["task_description"] == take.task
            assert sample["timestamp"] == np.float32(t / 10)
            assert sample["sample_ids"] == start + t
            assert sample["info"] == {
                "dataset": str(shared),
                "episode_index": take.key,
                "frame_index": t,
            }
            assert sample["embodiment_ids"] == 3
    assert {k: sample[k].dtype.name for k in sample if hasattr(sample[k], "dtype")} == {
        "images": "uint8",
        "img_masks": "bool",
        "states": "float32",
        "actions": "float32",
        "action_masks": "float32",
        "timestamp": "float32",
        "sample_ids": "int64",
        "embodiment_ids": "int64",
    }


def test_cameras_of_different_sizes_stay_a_list_until_they_are_resized(shared):
    sample = load(shared)[0]
    assert [image.shape for image in sample["images"]] == [(3, 32, 48), (3, 16, 16)]
    assert sample["img_masks"].tolist() == [True, True]
    resized = load(shared, [{"type": "ResizeImages", "height": 8, "width": 8}])[0]
    assert resized["images"].shape == (6, 8, 8)


def test_indices_end_where_the_dataset_ends(shared):
    dataset = load(shared)
    assert len(list(dataset)) == 28
    for index in (28, -1):
        with pytest.raises(IndexError, match=f"sample {index} of 28"):
            dataset[index]


def test_a_later_first_action_leaves_out_frames_that_have_none(shared, takes):
    dataset = load(shared, window_start_idx=2, action_key="observation.state", action_window_size=3)
    assert len(dataset) == 28 - 3 * 2
    np.testing.assert_array_equal(dataset[0]["actions"], takes[0].state[2:5])
    last = dataset[4]
    np.testing.assert_array_equal(last["states"], takes[0].state[4])
    assert last["action_masks"].tolist() == [1, 0, 0]
    np.testing.assert_array_equal(dataset[5]["states"], takes[1].state[0])


def test_changing_a_sample_changes_nothing_else(shared):
    dataset = load(shared, img_keys=["top"], cache_frames=True)
    before = {k: np.copy(v) for k, v in dataset[3].items() if isinstance(v, np.ndarray)}
    sample = dataset[3]
    for value in sample.values():
        if isinstance(value, np.ndarray):
            value[...] = 0
    after = dataset[3]
    for key, value in before.items():
        np.testing.assert_array_equal(after[key], value)


@pytest.mark.parametrize("cache", [True, False])
def test_the_cache_cannot_be_written_to(shared, cache):
    sample = load(shared, cache_frames=cache)[3]
    before = sample["images"][0].copy()
    if cache:
        with pytest.raises(ValueError, match="read-only"):
            sample["images"][0][...] = 0
    resized = load(shared, [{"type": "ResizeImages", "height": 8, "width": 8}], cache_frames=cache)
    assert resized[3]["images"].shape == (6, 8, 8)
    np.testing.assert_array_equal(load(shared, cache_frames=cache)[3]["images"][0], before)


def test_without_cameras_there_are_no_images(shared):
    sample = load(shared, img_keys=[])[3]
    assert not {"images", "img_masks"} & set(sample)
    assert sample["states"].shape == (3,)


def test_cached_frames_are_the_decoded_ones(shared):
    shown = []

    class Reporter:
        def progress(self, name, done, total, **fields):
            shown.append((name, done, total))

    decoded, cached = load(shared), load(shared, cache_frames=True)
    cached.prepare(Reporter())
    assert shown[-1] == ("decode frames", 56, 56)
    assert not cached._frames._decoders._readers, "no file stays open"
    for i in np.random.default_rng(0).permutation(28):
        for one, two in zip(decoded[int(i)]["images"], cached[int(i)]["images"], strict=True):
            np.testing.assert_array_equal(one, two)


def test_a_cache_that_does_not_fit_is_refused(shared, monkeypatch):
    monkeypatch.setattr(frames, "available_memory", lambda: 1000)
    with pytest.raises(DataError) as caught:
        load(shared, cache_frames=True).prepare()
    assert "cache_frames=True needs 0.0 GB, 0.0 GB are free" in str(caught.value)
    assert "--set train_dataloader.dataset.cache_frames=false" in str(caught.value)
    monkeypatch.setattr(frames, "available_memory", lambda: None)
    load(shared, cache_frames=True).prepare()


def test_available_memory_is_positive_where_it_is_known():
    assert (frames.available_memory() or 1) > 0


def test_several_datasets_follow_one_another(shared, tmp_path, recorder, take):
    more = recorder(tmp_path / "more", [take(5, 4, "wave")])
    both = ParquetDataset([str(shared), str(more)], [], ["top"])
    assert len(both) == 32
    assert both.tasks == ("hold the cube", "hand the cube over", "wave")
    np.testing.assert_array_equal(both[28]["states"], take(5, 4).state[0])
    np.testing.assert_array_equal(both[27]["states"], load(shared)[27]["states"])
    assert both[31]["info"]["dataset"] == str(more)
    assert both.statistics["private"]["action"]["count"] == [32]
    apart = ParquetDataset([str(shared), str(more)], [], ["top"], episodes=[[1], [0]])
    assert len(apart) == 16


def test_some_episodes_need_only_their_own_files(tmp_path, recorder, take):
    takes = [take(k, 6) for k in range(4)]
    root = recorder(tmp_path / "d", takes, video_file_mb=0.002)
    videos = sorted((root / "videos/observation.images.top").rglob("*.mp4"))
    assert len(videos) == 4
    videos[1].unlink()
    dataset = load(root, img_keys=["top"], episodes=[0, 3])
    assert len(dataset) == 12
    np.testing.assert_array_equal(dataset[6]["states"], takes[3].state[0])
    np.testing.assert_allclose(
        dataset.statistics["private"]["proprio"]["mean"],
        np.concatenate([takes[0].state, takes[3].state]).astype(float).mean(0),
    )
    with pytest.raises(DataError, match="the video file is missing"):
        load(root, img_keys=["top"], episodes=[1])


def test_episodes_that_are_not_there(shared):
    with pytest.raises(DataError, match="there is no episode 3; there are 0 to 2"):
        load(shared, episodes=[0, 3])
    with pytest.raises(DataError) as caught:
        load(shared, episodes=[])
    assert "no frame can be used" in str(caught.value)
    with pytest.raises(DataError, match="episodes are no longer than window_start_idx 12"):
        load(shared, window_start_idx=12)


def test_statistics_are_exact_and_of_every_frame_once(shared, takes):
    stats = load(shared, statistic_name="arm").statistics["arm"]
    state = np.concatenate([t.state for t in takes]).astype(np.float64)
    action = np.concatenate([t.action for t in takes]).astype(np.float64)
    for name, rows in (("proprio", state), ("action", action)):
        np.testing.assert_allclose(stats[name]["mean"], rows.mean(0), rtol=1e-12)
        np.testing.assert_allclose(stats[name]["std"], rows.std(0), rtol=1e-12)
        np.testing.assert_array_equal(stats[name]["q99"], np.quantile(rows, 0.99, axis=0))
        assert stats[name]["min"] == rows.min(0).tolist()
        assert stats[name]["count"] == [28]
    assert isinstance(stats["action"]["mean"][0], float)


def windows(takes, size, relative):
    """(value, step) of every action that occurs in a window."""
    for take in takes:
        for t in range(len(take.state)):
            for j in range(min(size, len(take.state) - t)):
                yield take.action[t + j].astype(np.float64) - take.state[t] * relative, j


@pytest.mark.parametrize("per_step", [True, False])
@pytest.mark.parametrize("relative", [True, [True, False, True], False])
def test_statistics_of_relative_and_of_each_step(shared, takes, relative, per_step):
    dataset = load(
        shared, action_window_size=4, relative_actions=relative, per_step_statistics=per_step
    )
    found = dataset.statistics["private"]["action"]
    mask = {True: [1, 1, 0], False: None}.get(
        relative if isinstance(relative, bool) else "", [1, 0, 1]
    )
    assert found.get("relative") == mask
    if relative is False and not per_step:
        return
    values = list(windows(takes, 4, np.array(mask or [0, 0, 0])))
    steps = [np.array([v for v, j in values if j == k or not per_step]) for k in range(4)]
    for name, compute in {
        "mean": lambda a: a.mean(0),
        "std": lambda a: a.std(0),
        "q01": lambda a: np.quantile(a, 0.01, axis=0),
        "max": lambda a: a.max(0),
    }.items():
        expected = np.stack([compute(a) for a in steps]) if per_step else compute(steps[0])
        np.testing.assert_allclose(found[name], expected, atol=1e-6)


def test_relative_actions_come_back_from_the_pipeline(shared):
    raw = load(shared, action_window_size=4)
    normalise = {"type": "NormalizeStatesAndActions", "action_dim": 6}
    dataset = load(
        shared, [normalise], action_window_size=4, relative_actions=True, per_step_statistics=True
    )
    undo = dataset.pipeline.transforms[0].denormalizer(dataset.statistics)
    for i in (0, 6, 20, 27):
        back = undo({"action": dataset[i]["actions"][None], "states": raw[i]["states"]})
        np.testing.assert_allclose(back, raw[i]["actions"], atol=1e-5)


def test_windows_longer_than_every_episode_still_have_statistics(shared):
    dataset = load(shared, action_window_size=15, per_step_statistics=True)
    found = dataset.statistics["private"]["action"]
    assert np.isfinite(found["std"]).all()
    assert found["mean"][14] == found["mean"][0]


def test_differences_to_the_frame_before(shared, takes):
    dataset = load(shared, use_delta=True, action_window_size=3)
    for start, take in zip(STARTS, takes, strict=True):
        first = dataset[start]["actions"]
        assert first[0].tolist() == [0, 0, 0]
        np.testing.assert_allclose(first[1:], np.diff(take.action[:3], axis=0), rtol=1e-6)
    assert dataset.embodiment.action_mode == "delta"
    assert load(shared).embodiment.action_mode == "absolute"


def test_the_config_names_the_robot_of_a_dataset_that_does_not(dataset, spec, tmp_path):
    (dataset / "meta/fluxvla_embodiment.json").unlink()
    assert load(dataset).embodiment is None
    table = spec().to_dict()
    assert load(dataset, embodiment=table).embodiment == spec()
    (tmp_path / "arm.json").write_text(json.dumps(table))
    named = load(dataset, embodiment=str(tmp_path / "arm.json"), relative_actions=True)
    assert named.embodiment == spec()
    assert named.relative.tolist() == [True, True, False]
    with pytest.raises(DataError, match=r"none\.json: cannot be read"):
        load(dataset, embodiment="none.json")
    short = spec(joints=spec().joints[:2]).to_dict()
    with pytest.raises(SpecMismatch) as caught:
        load(dataset, embodiment=short)
    assert "states have 3 columns, the robot arm has 2 joints" in str(caught.value)


def test_a_config_that_contradicts_the_dataset_is_refused(shared, spec):
    other = spec(joints=spec().joints[::-1]).to_dict()
    with pytest.raises(SpecMismatch, match="the config's embodiment"):
        load(shared, embodiment=other)


def test_everything_random_follows_from_seed_epoch_and_index(shared):
    dataset = load(shared, TRANSFORMS)
    assert same(dataset.get_sample(3, 1), load(shared, TRANSFORMS).get_sample(3, 1))
    assert same(dataset[3], dataset.get_sample(3, 0))
    for other in (
        dataset.get_sample(3, 2),
        load(shared, TRANSFORMS, seed=7).get_sample(3, 1),
    ):
        assert not np.array_equal(other["noise"], dataset.get_sample(3, 1)["noise"])
        assert not np.array_equal(other["states"], dataset.get_sample(3, 1)["states"])


def test_without_a_seed_it_takes_the_runs(shared):
    given, own = load(shared, TRANSFORMS), load(shared, TRANSFORMS, seed=42)
    assert same(given[3], own[3])
    given.use_seed(7)
    own.use_seed(7)
    assert same(given[3], load(shared, TRANSFORMS, seed=7)[3])
    assert same(own[3], load(shared, TRANSFORMS)[3])


def test_reading_many_at_once_gives_the_same(shared):
    dataset = load(shared, TRANSFORMS)
    keys = [SampleKey(1, i) for i in (20, 3, 27, 3, 0)]
    for key, sample in zip(keys, dataset.get_samples(keys), strict=True):
        assert same(sample, dataset.get_sample(key.index, key.epoch))


@pytest.mark.parametrize("cache", [False, True])
def test_batches_do_not_depend_on_workers(shared, cache):
    collate = DictCollator(KEYS, ["task_description", "info", "stats"])

    def batches(workers):
        dataset = load(shared, TRANSFORMS, cache_frames=cache)
        loader = make_loader(dataset, collate, StepSampler(StepPlan(len(dataset), 4)), workers)
        return list(islice(loader, 9))

    for one, two in zip(batches(0), batches(2), strict=True):
        assert one["images"].shape == (4, 6, 16, 24)
        assert one["actions"].shape == (4, 9, 5)
        assert one["noise"].shape == (4, 2, 9, 5)
        for key in KEYS:
            assert torch.equal(one[key], two[key])


def test_a_dataset_travels_to_a_spawned_worker(shared):
    dataset = load(shared, img_keys=["top"])
    dataset[5]
    copy = pickle.loads(pickle.dumps(dataset))  # noqa: S301
    np.testing.assert_array_equal(copy[5]["images"], dataset[5]["images"])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"action_window_size": 0}, "action_window_size 0 must be at least 1"),
        ({"window_start_idx": -1}, "window_start_idx -1 at least 0"),
        ({"relative_actions": [True]}, "relative_actions has 1 entries, actions have 3"),
        ({"episodes": [[0], [1]]}, "episodes must be one list for each of 1 datasets, got 2"),
    ],
)
def test_parameters_that_make_no_sense_are_refused(shared, options, message):
    with pytest.raises(ConfigError, match=message):
        load(shared, **options)


def test_no_dataset_named():
    with pytest.raises(ConfigError, match="data_root_path names no dataset"):
        ParquetDataset([], [], ["top"])


def test_joints_that_hardly_move_are_called_by_their_names(tmp_path, recorder, take):
    still = take(4, 12)
    still.state[:, 1] = 0.5
    root = recorder(tmp_path / "still", [still])
    (said,) = load(root, [{"type": "NormalizeStatesAndActions"}]).warnings()
    assert ": state elbow (range 0, divided by 1e-06);" in said
    assert load(root, TRANSFORMS).warnings() == []
    assert load(root).warnings() == []


def test_files_stay_open_and_are_read_in_their_order(shared, monkeypatch):
    """What a decoder costs: opening its file, and seeking."""
    opened, read = [], []
    begin, take = VideoFile.__init__, VideoFile.read

    def count(self, path):
        opened.append(path)
        begin(self, path)

    def note(self, time):
        read.append((str(self.path), time))
        return take(self, time)

    monkeypatch.setattr(VideoFile, "__init__", count)
    monkeypatch.setattr(VideoFile, "read", note)
    monkeypatch.setattr(frames, "MAX_THREADS", 1)
    dataset = ParquetDataset(str(shared), [], ["wrist", "top"])
    opened.clear()  # opening a dataset looks into its files
    keys = [SampleKey(0, int(i)) for i in np.random.default_rng(0).permutation(28)[:12]]
    for _ in range(3):
        read.clear()
        dataset.get_samples(keys)
        assert len(read) == 24
        assert read == sorted(read)
    assert len(opened) == 2


@pytest.mark.parametrize("size", [1, 5])
def test_statistics_of_each_step_fit_windows_of_that_length_only(shared, size):
    made = load(shared, action_window_size=10, per_step_statistics=True).statistics
    normalise = {"type": "NormalizeStatesAndActions"}
    dataset = load(shared, [normalise], action_window_size=size)
    dataset.use_statistics(made["private"])
    with pytest.raises(ConfigError, match=f"actions of {size} steps, .* describe 10 steps"):
        dataset[0]
