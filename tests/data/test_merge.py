from __future__ import annotations

import errno

import numpy as np
import pyarrow.parquet as pq
import pytest

from fluxvla_core.data import assemble
from fluxvla_core.data.assemble import merge_datasets
from fluxvla_core.data.dataset import ParquetDataset
from fluxvla_core.errors import DataError, RunFailed, SpecMismatch


def contents(root):
    return {str(p.relative_to(root)): p.read_bytes() for p in root.rglob("*") if p.is_file()}


@pytest.mark.parametrize("workers", [1, 2, 3])
@pytest.mark.parametrize("codec", ["h264", "libsvtav1"])
def test_the_result_does_not_depend_on_who_recorded_what(workers, codec, tmp_path, recorder, take):
    takes = [take(k, 5 + k, f"task {k % 2}") for k in range(5)]
    limits = {"video_file_mb": 0.01, "video_codec": codec}
    alone = recorder(tmp_path / "alone", takes, **limits)
    shards = [
        recorder(tmp_path / f"shard-{w}", takes[w::workers], **limits) for w in range(workers)
    ]
    merged = merge_datasets(shards, tmp_path / "merged")
    assert contents(merged) == contents(alone)
    assert not list(tmp_path.glob(".*"))


def test_merged_episodes_have_their_own_frames(tmp_path, recorder, take):
    takes = [take(k, 4 + k) for k in (3, 1, 2)]
    roots = [recorder(tmp_path / str(t.key), [t]) for t in takes]
    dataset = ParquetDataset(str(merge_datasets(roots, tmp_path / "m")), [], ["top"])
    ordered = sorted(takes, key=lambda t: t.key)
    states = np.concatenate([t.state for t in ordered])
    tops = np.concatenate([t.top for t in ordered])
    assert len(dataset) == len(states)
    for i in range(len(dataset)):
        np.testing.assert_array_equal(dataset[i]["states"], states[i])
        error = np.abs(dataset[i]["images"].transpose(1, 2, 0).astype(int) - tops[i])
        assert error.mean() < 6


def test_merging_a_merged_dataset_changes_nothing(shared, tmp_path):
    assert contents(merge_datasets([shared], tmp_path / "m")) == contents(shared)


def unkeyed(root):
    path = root / "meta/fluxvla_episodes.parquet"
    table = pq.read_table(path)
    nulls = pq.read_table(path).slice(0, 0)["key"].type
    import pyarrow as pa

    pq.write_table(table.set_column(0, "key", pa.nulls(len(table), nulls)), path)
    return root


def test_without_keys_the_order_is_that_of_the_datasets(tmp_path, recorder, take):
    first, second = (unkeyed(recorder(tmp_path / str(k), [take(k, 4)])) for k in (8, 2))
    dataset = ParquetDataset(str(merge_datasets([first, second], tmp_path / "m")), [], ["top"])
    np.testing.assert_array_equal(dataset[0]["states"], take(8, 4).state[0])


def test_what_does_not_go_together_is_refused(tmp_path, recorder, take, spec, shared):
    plain = recorder(tmp_path / "plain", [take(7, 4)])
    left = spec(name="left", joints=spec().joints[::-1])
    with pytest.raises(SpecMismatch, match="joints and their order"):
        merge_datasets(
            [plain, recorder(tmp_path / "other", [take(8, 4)], embodiment=left)], tmp_path / "m"
        )
    slow = recorder(tmp_path / "av1", [take(8, 4)], video_codec="libsvtav1")
    with pytest.raises(DataError, match="cannot be merged: video codec: h264 / libsvtav1"):
        merge_datasets([plain, slow], tmp_path / "m")
    with pytest.raises(DataError) as caught:
        merge_datasets([plain, plain], tmp_path / "m")
    assert "1 keys occur twice, for example 7" in str(caught.value)
    assert "two processes recorded the same seeds" in str(caught.value)
    bare = unkeyed(recorder(tmp_path / "bare", [take(9, 4)]))
    with pytest.raises(DataError, match="1 of 2 episodes have a key"):
        merge_datasets([plain, bare], tmp_path / "m")
    assert not (tmp_path / "m").exists()
    assert not list(tmp_path.glob(".m*"))


def test_only_our_own_datasets_are_merged(dataset, tmp_path):
    (dataset / "meta/fluxvla_episodes.parquet").unlink()
    with pytest.raises(DataError) as caught:
        merge_datasets([dataset], tmp_path / "m")
    assert "only datasets that LeRobotWriter wrote can be merged" in str(caught.value)
    assert "another program wrote it" in str(caught.value)


def test_nothing_to_merge_and_nowhere_to_put_it(shared, tmp_path):
    with pytest.raises(DataError, match="merge_datasets: no datasets were given"):
        merge_datasets([], tmp_path / "m")
    with pytest.raises(DataError, match="there is something here already"):
        merge_datasets([shared], shared)
    (tmp_path / ".m.writing").mkdir()
    with pytest.raises(DataError, match=r"\.m\.writing is in the way"):
        merge_datasets([shared], tmp_path / "m")


def test_a_full_disk_leaves_the_sources_and_no_half_dataset(shared, tmp_path, monkeypatch):
    def full(*args):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(assemble, "assemble", full)
    with pytest.raises(RunFailed) as caught:
        merge_datasets([shared], tmp_path / "m")
    assert "no space left on the disk" in str(caught.value)
    assert "the datasets that were to be merged are as they were" in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_a_video_that_lost_frames_is_named(dataset, tmp_path, shared):
    path = "videos/observation.images.top/chunk-000/file-000.mp4"
    (dataset / path).write_bytes((shared / path).read_bytes()[:-1000])
    with pytest.raises(
        DataError, match=r"file-000\.mp4: 9 frames expected, \d found|cannot be read"
    ):
        merge_datasets([dataset], tmp_path / "m")
    assert not (tmp_path / "m").exists()


def test_an_episode_that_begins_within_a_group_of_frames_cannot_be_copied(dataset, tmp_path):
    path = dataset / "meta/episodes/chunk-000/file-000.parquet"
    table = pq.read_table(path)
    name = "videos/observation.images.top/from_timestamp"
    starts = [s + 0.1 * (i == 0) for i, s in enumerate(table[name].to_pylist())]
    i = table.schema.get_field_index(name)
    pq.write_table(table.set_column(i, name, [starts]), path)
    with pytest.raises(DataError, match=r"the episode at 0\.100 s cannot be copied"):
        merge_datasets([dataset], tmp_path / "m")
