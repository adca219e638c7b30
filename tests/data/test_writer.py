from __future__ import annotations

import errno
import json
import os
import re

import numpy as np
import pyarrow.parquet as pq
import pytest

from fluxvla_core.data import assemble
from fluxvla_core.data import writer as writer_module
from fluxvla_core.data.dataset import ParquetDataset
from fluxvla_core.data.files import write_metadata
from fluxvla_core.data.metadata import read_metadata
from fluxvla_core.data.video_encode import CODECS
from fluxvla_core.data.writer import LeRobotWriter
from fluxvla_core.errors import ConfigError, DataError, RunFailed

TOP, WRIST = "observation.images.top", "observation.images.wrist"


def files(root):
    return sorted(str(p.relative_to(root)) for p in root.rglob("*") if p.is_file())


def test_the_layout_is_lerobots(shared):
    assert files(shared) == [
        "data/chunk-000/file-000.parquet",
        "meta/episodes/chunk-000/file-000.parquet",
        "meta/fluxvla_embodiment.json",
        "meta/fluxvla_episodes.parquet",
        "meta/info.json",
        "meta/stats.json",
        "meta/tasks.parquet",
        f"videos/{TOP}/chunk-000/file-000.mp4",
        f"videos/{WRIST}/chunk-000/file-000.mp4",
    ]
    assert [p.name for p in shared.parent.iterdir()] == ["shared"]


def test_info_says_what_there_is(shared, takes):
    info = json.loads((shared / "meta/info.json").read_text())
    assert info["codebase_version"] == "v3.0"
    assert info["robot_type"] == "arm"
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (3, 28, 2)
    assert info["fps"] == 10
    assert isinstance(info["fps"], int)
    assert info["splits"] == {"train": "0:3"}
    assert info["features"]["action"] == {
        "dtype": "float32",
        "shape": [3],
        "names": ["waist", "elbow", "gripper"],
    }
    assert info["features"][TOP]["shape"] == [32, 48, 3]
    assert info["features"][TOP]["info"]["video.codec"] == "h264"
    assert info["features"]["task_index"] == {"dtype": "int64", "shape": [1], "names": None}


def test_rows_and_schema(shared, takes):
    table = pq.read_table(shared / "data/chunk-000/file-000.parquet")
    assert str(table.schema.field("action").type) == "fixed_size_list<element: float>[3]"
    assert str(table.schema.field("timestamp").type) == "float"
    schema = json.loads(table.schema.metadata[b"huggingface"])["info"]["features"]
    assert schema["action"] == {
        "feature": {"dtype": "float32", "_type": "Value"},
        "length": 3,
        "_type": "List",
    }
    assert schema["index"] == {"dtype": "int64", "_type": "Value"}
    assert table["index"].to_pylist() == list(range(28))
    assert table["episode_index"].to_pylist() == [0] * 7 + [1] * 12 + [2] * 9
    assert table["task_index"].to_pylist() == [0] * 7 + [1] * 12 + [0] * 9
    assert table["frame_index"].to_pylist() == [*range(7), *range(12), *range(9)]
    assert table["timestamp"].to_pylist()[8] == pytest.approx(0.1)
    whole = np.concatenate([t.action for t in takes])
    np.testing.assert_array_equal(np.stack(table["action"].to_pylist()), whole)


def test_episodes_have_their_places_and_statistics(shared, takes):
    rows = pq.read_table(shared / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [r["length"] for r in rows] == [7, 12, 9]
    assert [r["tasks"] for r in rows] == [[t.task] for t in takes]
    assert [r["dataset_from_index"] for r in rows] == [0, 7, 19]
    assert [r["dataset_to_index"] for r in rows] == [7, 19, 28]
    assert [r[f"videos/{TOP}/from_timestamp"] for r in rows] == [0, 0.7, 1.9]
    assert [r[f"videos/{TOP}/to_timestamp"] for r in rows] == [0.7, 1.9, 2.8]
    for row, take in zip(rows, takes, strict=True):
        np.testing.assert_allclose(row["stats/action/mean"], take.action.mean(0), rtol=1e-5)
        np.testing.assert_allclose(row["stats/action/q99"], np.quantile(take.action, 0.99, 0))
        pixels = take.top.reshape(-1, 3).astype(np.float64) / 255
        assert np.shape(row[f"stats/{TOP}/std"]) == (3, 1, 1)
        np.testing.assert_allclose(np.ravel(row[f"stats/{TOP}/std"]), pixels.std(0))
        assert row[f"stats/{TOP}/count"] == [len(take.state)]
        assert row["stats/frame_index/max"] == [len(take.state) - 1]
        assert isinstance(row["stats/frame_index/max"][0], int)


def test_statistics_of_the_whole(shared, takes):
    stats = json.loads((shared / "meta/stats.json").read_text())
    action = np.concatenate([t.action for t in takes]).astype(np.float64)
    np.testing.assert_allclose(stats["action"]["std"], action.std(0), rtol=1e-9)
    np.testing.assert_allclose(stats["action"]["q01"], np.quantile(action, 0.01, 0))
    pixels = np.concatenate([t.wrist.reshape(-1, 3) for t in takes]).astype(np.float64) / 255
    np.testing.assert_allclose(np.ravel(stats[WRIST]["mean"]), pixels.mean(0))
    np.testing.assert_allclose(np.ravel(stats[WRIST]["q90"]), np.quantile(pixels, 0.9, 0))
    assert stats["action"]["count"] == [28]
    assert set(stats) == {
        *(TOP, WRIST, "observation.state", "action"),
        *("timestamp", "frame_index", "episode_index", "index", "task_index"),
    }


def test_the_embodiment_has_the_images_true_sizes(shared, spec):
    found = read_metadata(shared).embodiment
    assert found.joints == spec().joints
    assert found.rate_hz == 50
    assert [(c.height, c.width) for c in found.cameras] == [(32, 48), (16, 16)]


@pytest.mark.parametrize("codec", list(CODECS))
def test_images_come_back_nearly_as_they_were(codec, tmp_path, takes, recorder):
    root = recorder(tmp_path / "d", video_codec=codec)
    dataset = ParquetDataset(str(root), [], ["wrist"])
    whole = np.concatenate([t.wrist for t in takes]).transpose(0, 3, 1, 2)
    for i in range(len(dataset)):
        assert np.abs(dataset[i]["images"].astype(int) - whole[i]).mean() < 4


def test_full_files_are_followed_by_others(tmp_path, takes, recorder, take):
    many = [take(k, 6) for k in range(5)]
    root = recorder(tmp_path / "d", many, data_file_mb=0.001, video_file_mb=0.004)
    meta = read_metadata(root)
    assert len(set(meta.episodes.files)) > 1
    assert len(set(meta.episodes.videos[TOP].files)) > 1
    dataset = ParquetDataset(str(root), [], ["top"])
    whole = np.concatenate([t.state for t in many])
    for i in range(len(dataset)):
        np.testing.assert_array_equal(dataset[i]["states"], whole[i])
        wanted = np.concatenate([t.top for t in many])[i].transpose(2, 0, 1)
        assert np.abs(dataset[i]["images"].astype(int) - wanted).mean() < 6


def test_splitting_keeps_the_order_and_never_makes_an_empty_file():
    assert assemble.split_by_size([3, 3, 3], 6) == [[0, 1], [2]]
    assert assemble.split_by_size([9, 1, 9], 6) == [[0], [1], [2]]


def test_discarded_frames_are_gone(tmp_path, spec, takes):
    with LeRobotWriter(tmp_path / "d", 10, spec()) as writer:
        takes[0].record(writer)
        writer.add_frame({"top": takes[1].top[0], "wrist": takes[1].wrist[0]}, *_row(), "x")
        assert (writer.episodes, writer.frames) == (1, 1)
        writer.discard_episode()
        assert writer.frames == 0
        takes[2].record(writer)
    dataset = ParquetDataset(str(tmp_path / "d"), [], ["top"])
    assert len(dataset) == 16
    np.testing.assert_array_equal(dataset[7]["states"], takes[2].state[0])


def _row():
    return np.zeros(3), np.zeros(3)


def frame(**changes):
    values = {
        "images": {
            "top": np.zeros((32, 48, 3), np.uint8),
            "wrist": np.zeros((16, 16, 3), np.uint8),
        },
        "state": np.zeros(3),
        "action": np.zeros(3),
        "task": "hold",
    }
    values["images"] = {**values["images"], **changes.pop("images", {})}
    return {**values, **changes}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"state": np.zeros(4)}, r"state has shape \(4,\), \(3,\) is expected"),
        ({"action": np.zeros((1, 3))}, r"action has shape \(1, 3\), \(3,\) is expected"),
        ({"action": [0, np.nan, 0]}, r"action is not finite: \[0.0, nan, 0.0\]"),
        ({"task": " "}, "the task is empty; every episode needs an instruction"),
        ({"task": "hand over"}, "task 'hand over' within an episode of 'hold'"),
        (
            {"images": {"side": None}},
            r"cameras \['side', 'top', 'wrist'\] given, \['top', 'wrist'\]",
        ),
        (
            {"images": {"top": np.zeros((32, 48, 3))}},
            "camera 'top' gives float64, uint8 is expected",
        ),
        ({"images": {"top": None}}, "camera 'top' gives NoneType, uint8 is expected"),
        ({"images": {"top": np.zeros((3, 32, 48), np.uint8)}}, r"gives shape \(3, 32, 48\)"),
        ({"images": {"top": np.zeros((32, 46, 3), np.uint8)}}, "gives 32 x 46, 32 x 48 before"),
    ],
)
def test_a_wrong_frame_is_refused_and_leaves_the_episode_as_it_was(
    tmp_path, spec, changes, message
):
    writer = LeRobotWriter(tmp_path / "d", 10, spec())
    writer.add_frame(**frame())
    with pytest.raises(DataError, match=message):
        writer.add_frame(**frame(**changes))
    assert writer.frames == 1
    writer.add_frame(**frame())
    writer.save_episode()
    writer.finalize()
    assert len(ParquetDataset(str(tmp_path / "d"), [], ["top"])) == 2


def test_odd_sizes_cannot_be_video(tmp_path, spec):
    writer = LeRobotWriter(tmp_path / "d", 10, spec())
    with pytest.raises(DataError) as caught:
        writer.add_frame(**frame(images={"top": np.zeros((33, 48, 3), np.uint8)}))
    assert "images of 33 x 48 cannot be stored as video" in str(caught.value)
    assert "height and width must be even" in str(caught.value)


def test_a_first_frame_that_is_refused_leaves_nothing(tmp_path, spec):
    odd = frame(images={"top": np.zeros((33, 48, 3), np.uint8)})
    with pytest.raises(DataError), LeRobotWriter(tmp_path / "d", 10, spec()) as writer:
        writer.add_frame(**odd)
    assert list(tmp_path.iterdir()) == []


def test_saved_episodes_outlive_a_frame_that_is_refused(tmp_path, spec):
    odd = frame(images={"top": np.zeros((34, 48, 3), np.uint8)})

    def record():
        with LeRobotWriter(tmp_path / "d", 10, spec()) as writer:
            writer.add_frame(**frame())
            writer.save_episode()
            writer.add_frame(**odd)

    with pytest.raises(DataError):
        record()
    with LeRobotWriter(tmp_path / "d", 10, spec(), recover=True) as writer:
        assert writer.episodes == 1


def test_an_unknown_codec_is_refused(tmp_path, spec):
    with pytest.raises(ConfigError, match="video_codec 'mpeg' is not one of h264, libsvtav1"):
        LeRobotWriter(tmp_path / "d", 10, spec(), video_codec="mpeg")


def test_nothing_is_written_over(shared, tmp_path, spec):
    with pytest.raises(DataError, match="there is something here already; a dataset is never"):
        LeRobotWriter(shared, 10, spec())
    (tmp_path / "empty").mkdir()
    LeRobotWriter(tmp_path / "empty", 10, spec())


def test_a_place_that_cannot_be_written_to(tmp_path, spec):
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError) as caught:
        LeRobotWriter(tmp_path / "file" / "dataset", 10, spec())
    assert f"{tmp_path / 'file'}: no dataset can be written here" in str(caught.value)
    assert "there is no permission to write, or a file is where a folder" in str(caught.value)


def test_frames_without_an_episode_and_episodes_without_frames(tmp_path, spec):
    writer = LeRobotWriter(tmp_path / "d", 10, spec())
    with pytest.raises(DataError, match="save_episode: no frame was added since the last episode"):
        writer.save_episode()
    with pytest.raises(DataError, match="no episode was saved, so there is no dataset to write"):
        writer.finalize()
    writer.add_frame(**frame())
    with pytest.raises(DataError, match="finalize: 1 frames belong to no episode"):
        writer.finalize()


def test_a_crash_leaves_no_dataset_and_the_saved_episodes(tmp_path, spec, takes):
    root = tmp_path / "d"

    def crash():
        with LeRobotWriter(root, 10, spec()) as writer:
            takes[0].record(writer)
            writer.add_frame(**frame())
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        crash()
    assert not root.exists()
    with pytest.raises(DataError) as caught:
        read_metadata(root)
    assert "its recording was never finalized; what was saved is in" in str(caught.value)
    with pytest.raises(DataError) as caught:
        LeRobotWriter(root, 10, spec())
    assert "a recording was interrupted, or is under way: 1 saved episodes" in str(caught.value)
    assert "recover=True" in str(caught.value)
    with LeRobotWriter(root, 10, spec(), recover=True) as writer:
        assert writer.episodes == 1
        takes[1].record(writer)
    assert len(ParquetDataset(str(root), [], ["top"])) == 19
    assert not list(tmp_path.glob(".*"))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"fps": 20}, r"another fps: 10\.0 / 20\.0"),
        ({"video_codec": "libsvtav1"}, "another video_codec: h264 / libsvtav1"),
        ({"turned": True}, "another embodiment$"),
    ],
)
def test_a_recording_does_not_go_on_with_what_is_read_otherwise(
    changes, message, tmp_path, spec, takes
):
    """AV1 joined to h264, or joints in another order, would be one dataset and no error."""
    root = tmp_path / "d"
    settings = {"fps": 10, "embodiment": spec()}

    def crash():
        with LeRobotWriter(root, **settings) as writer:
            takes[0].record(writer)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        crash()
    if changes.pop("turned", False):
        changes["embodiment"] = spec(joints=spec().joints[::-1])
    with pytest.raises(DataError) as caught:
        LeRobotWriter(root, **{**settings, **changes}, recover=True)
    assert re.search(message, caught.value.what)
    with LeRobotWriter(root, **settings, recover=True) as writer:
        assert writer.episodes == 1
    assert len(ParquetDataset(str(root), [], ["top"])) == 7


def test_dying_in_the_middle_of_a_file_leaves_the_one_before(tmp_path, spec, takes, monkeypatch):
    root = tmp_path / "d"
    writer = LeRobotWriter(root, 10, spec())
    takes[0].record(writer)

    def die(path, text, **options):
        path.write_bytes(text.encode()[:3])
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(type(root), "write_text", die)
        with pytest.raises(KeyboardInterrupt):
            takes[1].record(writer)
    with LeRobotWriter(root, 10, spec(), recover=True) as writer:
        assert writer.episodes == 1


def test_dying_while_finalizing_leaves_no_dataset(tmp_path, spec, takes, monkeypatch):
    root = tmp_path / "d"
    writer = LeRobotWriter(root, 10, spec())
    takes[0].record(writer)

    def die(path, value):
        if path.name == "info.json":
            raise KeyboardInterrupt
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("{}")

    with monkeypatch.context() as patch:
        patch.setattr(assemble, "write_metadata", die)
        with pytest.raises(KeyboardInterrupt):
            writer.finalize()
    assert not root.exists()
    LeRobotWriter(root, 10, spec(), recover=True).finalize()
    assert len(ParquetDataset(str(root), [], ["top"])) == 7


@pytest.mark.parametrize("step", ["add_frame", "save_episode", "finalize"])
def test_a_full_disk_keeps_what_was_saved(step, tmp_path, spec, takes, monkeypatch):
    root = tmp_path / "d"
    writer = LeRobotWriter(root, 10, spec())
    takes[0].record(writer)

    def full(*args, **kwargs):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def full_at_the_last_file(path, value):
        if path.name == "episode.json":
            full()
        write_metadata(path, value)

    with monkeypatch.context() as patch:
        if step == "add_frame":
            patch.setattr(writer_module.EpisodeEncoder, "add", full)
            act = lambda: writer.add_frame(**frame())  # noqa: E731
        elif step == "save_episode":
            writer.add_frame(**frame())
            patch.setattr(writer_module, "write_metadata", full_at_the_last_file)
            act = writer.save_episode
        else:
            patch.setattr(assemble, "join_clips", full)
            act = writer.finalize
        with pytest.raises(RunFailed) as caught:
            act()
    assert "no space left on the disk" in str(caught.value)
    assert "1 saved episodes are safe in" in str(caught.value)
    assert caught.value.exit_code == 1
    assert not root.exists()
    LeRobotWriter(root, 10, spec(), recover=True).finalize()
    assert len(ParquetDataset(str(root), [], ["top"])) == 7


def test_other_failures_of_the_disk_stay_what_they_are(tmp_path, spec, takes, monkeypatch):
    writer = LeRobotWriter(tmp_path / "d", 10, spec())
    takes[0].record(writer)

    def refused(*args):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(assemble, "join_clips", refused)
    with pytest.raises(PermissionError):
        writer.finalize()


def test_the_same_episodes_make_the_same_bytes(shared, tmp_path, recorder):
    again = recorder(tmp_path / "again")
    assert files(again) == files(shared)
    for name in files(shared):
        assert (again / name).read_bytes() == (shared / name).read_bytes(), name
