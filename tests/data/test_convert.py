"""Version 2 to version 3: rows, frames and instructions stay, statistics become exact."""

from __future__ import annotations

import errno
import json
import shutil

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from fluxvla_core.cli.main import main
from fluxvla_core.data import convert as convert_module
from fluxvla_core.data.convert import convert
from fluxvla_core.data.dataset import ParquetDataset
from fluxvla_core.data.inspection import validate
from fluxvla_core.data.metadata import read_metadata
from fluxvla_core.errors import DataError, RunFailed

from .version2 import FPS, write_v2

CAMERAS = ["top", "wrist"]
TOP = "observation.images.top"


@pytest.fixture(scope="module")
def old(tmp_path_factory, takes):
    return write_v2(tmp_path_factory.mktemp("v2") / "old", takes)


@pytest.fixture
def broken(old, tmp_path):
    return shutil.copytree(old, tmp_path / "broken")


def same_samples(left, right):
    one, two = (ParquetDataset(str(root), [], CAMERAS) for root in (left, right))
    assert len(one) == len(two)
    assert one.statistics == two.statistics
    for a, b in zip(one, two, strict=True):
        assert a["task_description"] == b["task_description"]
        for key in ("states", "actions", "timestamp"):
            np.testing.assert_array_equal(a[key], b[key])
        for x, y in zip(a["images"], b["images"], strict=True):
            np.testing.assert_array_equal(x, y)


def refused(root, out):
    with pytest.raises(DataError) as caught:
        convert(root, out)
    assert not out.exists()
    assert not list(out.parent.glob(".*writing"))
    return str(caught.value)


def test_nothing_is_lost(old, tmp_path, capsys):
    out = tmp_path / "new"
    before = {p: p.read_bytes() for p in old.rglob("*") if p.is_file()}
    assert main(["data", "convert", str(old), str(out)]) == 0
    assert f"dataset: {out}" in capsys.readouterr().out
    assert {p: p.read_bytes() for p in old.rglob("*") if p.is_file()} == before
    same_samples(old, out)
    assert read_metadata(out).version == "v3.0"
    assert len(list(out.rglob("*.mp4"))) == 2
    table = pq.read_table(out / "data/chunk-000/file-000.parquet")
    assert table["next.done"].to_pylist().count(True) == 3
    assert table["index"].to_pylist() == list(range(28))
    info = json.loads((out / "meta/info.json").read_text())
    assert "total_videos" not in info
    assert info["robot_type"] == "arm"
    assert len(validate(out)) == 1  # no embodiment


def test_statistics_and_layout_are_a_recordings_own(old, shared, tmp_path):
    """As if LeRobotWriter had written it, but for the pixels, which are after compression."""
    out = convert(old, tmp_path / "new")
    ours, recorded = (json.loads((r / "meta/stats.json").read_text()) for r in (out, shared))
    for key in ("action", "observation.state", "timestamp", "index", "task_index"):
        assert ours[key] == recorded[key]
    np.testing.assert_allclose(ours[TOP]["q99"], recorded[TOP]["q99"], atol=0.03)
    rows = pq.read_table(out / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    other = pq.read_table(shared / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    for row, expected in zip(rows, other, strict=True):
        for key, value in expected.items():
            if not key.startswith("stats/observation.images"):
                assert row[key] == value
    assert set(rows[0]) - set(other[0]) == {f"stats/next.done/{name}" for name in ours["next.done"]}


def test_progress_and_the_robot(broken, shared, tmp_path):
    reported = []

    class Reporter:
        def progress(self, name, done, total, **fields):
            reported.append((name, done, total, fields["camera"]))

    shutil.copy(shared / "meta/fluxvla_embodiment.json", broken / "meta")
    out = convert(broken, tmp_path / "new", Reporter())
    assert reported[0] == ("convert frames", 7, 56, "top")
    assert reported[-1] == ("convert frames", 56, 56, "wrist")
    assert read_metadata(out).embodiment == read_metadata(shared).embodiment


def encode_otherwise(path, images, **options):
    with av.open(str(path), "w") as out:
        stream = out.add_stream("libx264", rate=FPS, options={"crf": "10", **options})
        stream.height, stream.width = images.shape[1:3]
        stream.pix_fmt = "yuv420p"
        for image in images:
            out.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        out.mux(stream.encode(None))


@pytest.mark.parametrize("which", [(0, 1, 2), (0, 2), (1,)])
def test_videos_of_other_programs(broken, takes, which, tmp_path):
    """With frames that are decoded before they are shown, and of several encoders."""
    for i in which:
        path = broken / f"videos/chunk-{i // 2:03d}/{TOP}/episode_{i:06d}.mp4"
        encode_otherwise(path, takes[i].top, bf="3", g="5")
    out = convert(broken, tmp_path / "new")
    same_samples(broken, out)
    files = len(list(out.glob(f"videos/{TOP}/*/*.mp4")))
    assert files == {3: 1, 2: 3, 1: 3}[len(which)]


def test_columns_of_text_are_kept_and_have_no_statistics(broken, tmp_path):
    path = broken / "meta/info.json"
    info = json.loads(path.read_text())
    info["features"]["note"] = {"dtype": "string", "shape": [1], "names": None}
    path.write_text(json.dumps(info))
    for i, file in enumerate(sorted(broken.glob("data/*/*.parquet"))):
        table = pq.read_table(file)
        notes = pa.array([f"episode {i}"] * table.num_rows)
        pq.write_table(table.append_column("note", notes), file)
    out = convert(broken, tmp_path / "new")
    notes = pq.read_table(out / "data/chunk-000/file-000.parquet")["note"].to_pylist()
    assert notes == ["episode 0"] * 7 + ["episode 1"] * 12 + ["episode 2"] * 9
    assert "note" not in json.loads((out / "meta/stats.json").read_text())


def test_large_files_are_split(old, tmp_path, monkeypatch):
    monkeypatch.setattr(convert_module.lerobot, "VIDEO_FILE_MB", 0.001)
    monkeypatch.setattr(convert_module.lerobot, "DATA_FILE_MB", 0.001)
    out = convert(old, tmp_path / "new")
    assert len(list(out.glob("data/*/*.parquet"))) == 3
    assert len(list(out.glob(f"videos/{TOP}/*/*.mp4"))) == 3
    same_samples(old, out)


def test_what_is_not_converted(shared, broken, tmp_path, capsys):
    out = tmp_path / "new"
    assert main(["data", "convert", str(shared), str(out)]) == 2
    assert "is of version v3.0 already" in capsys.readouterr().err
    path = broken / "meta/info.json"
    info = json.loads(path.read_text())
    info["features"]["side"] = {"dtype": "image", "shape": [4, 4, 3], "names": None}
    path.write_text(json.dumps(info))
    assert "column 'side' is missing" in refused(broken, out)
    assert main(["data", "convert", str(broken), str(shared)]) == 2


def test_nothing_is_written_over(old, shared, tmp_path):
    with pytest.raises(DataError, match="a dataset is never written over"):
        convert(old, shared)
    (tmp_path / ".new.writing").mkdir()
    with pytest.raises(DataError, match=r"\.new\.writing is in the way"):
        convert(old, tmp_path / "new")


def test_a_video_that_is_short_or_of_another_rate(broken, takes, tmp_path):
    path = broken / f"videos/chunk-000/{TOP}/episode_000001.mp4"
    encode_otherwise(path, takes[1].top[:5])
    text = refused(broken, tmp_path / "new")
    assert f"{path}: 12 frames expected, 5 found" in text
    (broken / "meta/info.json").write_text(
        (broken / "meta/info.json").read_text().replace('"fps": 10', '"fps": 20')
    )
    assert "7 frames are not shown at 20 Hz from 0 s on" in refused(broken, tmp_path / "new")


def test_columns_that_differ_between_episodes(broken, tmp_path):
    path = broken / "data/chunk-000/episode_000001.parquet"
    table = pq.read_table(path)
    i = table.schema.get_field_index("next.done")
    words = pa.array(["yes"] * table.num_rows)
    pq.write_table(table.set_column(i, "next.done", words), path)
    text = refused(broken, tmp_path / "new")
    assert f"{path}: its columns are not of the types of " in text
    pq.write_table(table.drop_columns("next.done"), path)
    assert f"{path}: column 'next.done' is missing" in refused(broken, tmp_path / "new")


def test_a_full_disk(old, tmp_path, monkeypatch):
    def full(*args):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(convert_module, "write_metadata", full)
    with pytest.raises(RunFailed, match="no space left on the disk") as caught:
        convert(old, tmp_path / "new")
    assert caught.value.exit_code == 1
    assert f"{old} is as it was" in str(caught.value)
    assert not (tmp_path / "new").exists()


def test_instructions_keep_their_index_even_if_two_are_the_same(broken, tmp_path):
    path = broken / "meta/tasks.jsonl"
    path.write_text('{"task_index": 1, "task": "hold"}\n{"task_index": 0, "task": "hold"}\n')
    out = convert(broken, tmp_path / "new")
    assert read_metadata(out).tasks == ("hold", "hold")
    same_samples(broken, out)


def test_what_has_gaps_in_one_episode_has_no_statistics(broken, tmp_path):
    """``next.done`` empty in one row; lists of unequal lengths whose numbers would fill a table."""
    info = json.loads((broken / "meta/info.json").read_text())
    info["features"]["touched"] = {"dtype": "int64", "shape": [2], "names": None}
    (broken / "meta/info.json").write_text(json.dumps(info))
    for i in range(3):
        path = broken / f"data/chunk-{i // 2:03d}/episode_{i:06d}.parquet"
        table = pq.read_table(path)
        rows = table.num_rows
        lists = pa.array([[1, 2, 3], [4], *[[0, 0]] * (rows - 2)], pa.list_(pa.int64()))
        table = table.append_column("touched", lists)
        if i == 1:
            done = pa.array([None, *[False] * (rows - 1)], pa.bool_())
            table = table.set_column(table.schema.get_field_index("next.done"), "next.done", done)
        pq.write_table(table, path)
    out = convert(broken, tmp_path / "new")
    stats = json.loads((out / "meta/stats.json").read_text())
    assert "action" in stats
    assert {"next.done", "touched"}.isdisjoint(stats)
    assert validate(out)
    same_samples(broken, out)
