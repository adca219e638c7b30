"""Datasets of versions 2.0 and 2.1: one file an episode, tables as JSON lines."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

from fluxvla_core import build_dataset_from_cfg
from fluxvla_core.data.dataset import ParquetDataset
from fluxvla_core.data.metadata import read_metadata
from fluxvla_core.errors import DataError

from .version2 import write_v2

CAMERAS = ["top", "wrist"]


@pytest.fixture(scope="module")
def old(tmp_path_factory, takes):
    return write_v2(tmp_path_factory.mktemp("v2") / "old", takes)


@pytest.fixture
def broken(old, tmp_path):
    return shutil.copytree(old, tmp_path / "broken")


def refused(root, **options):
    with pytest.raises(DataError) as caught:
        ParquetDataset(str(root), [], ["top"], **options)
    assert caught.value.exit_code == 2
    return str(caught.value)


@pytest.mark.parametrize("name", ["ParquetDataset", "ParquetDatasetV3"])
def test_samples_are_those_of_version_3(name, old, shared):
    """Upstream has one class for each version; here info.json decides under either name."""
    cfg = {"type": name, "img_keys": CAMERAS, "transforms": [], "action_window_size": 5}
    two = build_dataset_from_cfg({**cfg, "data_root_path": str(old)})
    three = build_dataset_from_cfg({**cfg, "data_root_path": str(shared)})
    assert len(two) == len(three) == 28
    assert two.tasks == three.tasks == ("hold the cube", "hand the cube over")
    assert two.statistics == three.statistics
    assert (two.fps, two.embodiment) == (10, None)
    for i in range(28):
        one, other = two[i], three[i]
        for key in ("states", "actions", "action_masks", "timestamp", "sample_ids"):
            np.testing.assert_array_equal(one[key], other[key])
        for left, right in zip(one["images"], other["images"], strict=True):
            np.testing.assert_array_equal(left, right)
        assert one["task_description"] == other["task_description"]
        assert one["info"] == {**other["info"], "dataset": str(old)}


def test_both_versions_in_one_dataset(old, shared):
    both = ParquetDataset([str(old), str(shared)], [], CAMERAS)
    assert len(both) == 56
    assert both.statistics["private"]["action"]["count"] == [56]


def test_tasks_go_by_their_index_not_by_their_line(old):
    """Upstream looked tasks up by their place in the list."""
    lines = (old / "meta/tasks.jsonl").read_text().splitlines()
    assert [json.loads(line)["task_index"] for line in lines] == [1, 0]
    assert read_metadata(old).tasks == ("hold the cube", "hand the cube over")


def test_version_2_0_differs_in_what_is_not_read(broken):
    path = broken / "meta/info.json"
    path.write_text(path.read_text().replace('"v2.1"', '"v2.0"'))
    (broken / "meta/episodes_stats.jsonl").unlink()
    assert len(ParquetDataset(str(broken), [], CAMERAS)) == 28


def test_some_episodes_need_only_their_own_videos(broken):
    videos = sorted(broken.glob("videos/*/observation.images.top/*.mp4"))
    assert [v.parent.parent.name for v in videos] == ["chunk-000", "chunk-000", "chunk-001"]
    videos[1].unlink()
    assert len(ParquetDataset(str(broken), [], CAMERAS, episodes=[0, 2])) == 16
    assert f"{videos[1]}: the video file is missing; 12 frames expected" in refused(broken)


def test_a_file_of_an_episode_that_is_missing_or_short(broken):
    video = broken / "videos/chunk-001/observation.images.top/episode_000002.mp4"
    video.write_bytes(video.read_bytes()[:700])
    assert f"{video}: " in refused(broken)
    data = broken / "data/chunk-000/episode_000001.parquet"
    shutil.copyfile(broken / "data/chunk-000/episode_000000.parquet", data)
    assert f"{data}: 12 frames expected, 7 found" in refused(broken)
    data.unlink()
    assert f"{data}: the file is missing" in refused(broken)


@pytest.mark.parametrize("name", ["episodes", "tasks"])
@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "the file is missing"),
        ('{"episode_index": 0', ":1: invalid JSON"),
        ("\n[1]\n", ":2: input should be an object"),
        ('{"task": "x"}\n', "_index: field required"),
    ],
)
def test_damaged_tables(broken, name, text, message):
    path = broken / f"meta/{name}.jsonl"
    path.unlink()
    if text is not None:
        path.write_text(text)
    found = refused(broken)
    assert str(path) in found
    assert message in found


def test_episodes_and_tasks_that_are_not_there(broken):
    path = broken / "meta/episodes.jsonl"
    lines = path.read_text()
    path.write_text(lines.replace('"episode_index": 1,', '"episode_index": 4,'))
    assert "does not number its episodes 0, 1, 2" in refused(broken)
    path.write_text(lines)
    (broken / "meta/tasks.jsonl").write_text('{"task_index": 0, "task": "hold"}\n')
    assert "task_index runs from 0 to 1, meta/tasks.jsonl lists 1 tasks" in refused(broken)


@pytest.mark.parametrize("line", ['{"task_index": 1}', '{"task_index": 1, "instruction": "hold"}'])
def test_a_line_without_instruction_is_not_taken_for_the_word_none(broken, line):
    (broken / "meta/tasks.jsonl").write_text(f'{{"task_index": 0, "task": "hold"}}\n{line}\n')
    assert "task_index 1 has no instruction, but None" in refused(broken)
