"""Each thing that can be wrong with a dataset, made wrong in a real one."""

from __future__ import annotations

import json
import os
import shutil

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from fluxvla_core.cli.main import main
from fluxvla_core.data.dataset import ParquetDataset
from fluxvla_core.data.metadata import read_metadata
from fluxvla_core.data.mixture import DistributedRepeatingDataset
from fluxvla_core.data.writer import LeRobotWriter
from fluxvla_core.errors import DataError, SpecMismatch

TOP = "observation.images.top"
DATA = "data/chunk-000/file-000.parquet"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"
VIDEO = f"videos/{TOP}/chunk-000/file-000.mp4"


def load(root, **options):
    return ParquetDataset(str(root), [], ["top"], **options)


def refused(root, **options):
    with pytest.raises(DataError) as caught:
        load(root, **options)
    assert caught.value.exit_code == 2
    return str(caught.value)


def edit_info(root, **changes):
    path = root / "meta/info.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


def edit_column(root, file, name, change):
    """Replace a column by ``change(list of its values)``, or an array; None drops it."""
    table = pq.read_table(root / file)
    i = table.schema.get_field_index(name)
    table = table.remove_column(i)
    column = change(pq.read_table(root / file)[name].to_pylist()) if change else None
    if column is not None:
        table = table.add_column(i, name, [column])
    pq.write_table(table, root / file)


def test_missing(tmp_path):
    text = refused(tmp_path / "nowhere")
    assert f"{tmp_path / 'nowhere'}: there is no dataset here: the folder does not exist" in text
    assert "in a config it is data_root_path" in text


def test_a_file_or_another_folder(tmp_path, dataset):
    (tmp_path / "a.txt").write_text("")
    assert "this is not a LeRobot dataset: it is a file" in refused(tmp_path / "a.txt")
    text = refused(dataset.parent)
    assert "this is not a LeRobot dataset: it has no meta/info.json" in text
    assert f"did you mean {dataset}?" in text


@pytest.mark.parametrize("version", ["v1.6", "v4.0", None])
def test_another_version(dataset, version):
    edit_info(dataset, codebase_version=version)
    text = refused(dataset)
    assert f"dataset of version {version}, v2.0, v2.1 and v3.0 are what is read here" in text


def test_empty(dataset):
    edit_info(dataset, total_episodes=0, total_frames=0)
    text = refused(dataset)
    assert "the dataset is empty: 0 episodes, 0 frames" in text
    assert "nothing was recorded into it yet" in text


def test_info_that_is_no_json_or_not_all(dataset):
    edit_info(dataset)
    info = json.loads((dataset / "meta/info.json").read_text())
    del info["fps"], info["data_path"]
    (dataset / "meta/info.json").write_text(json.dumps(info))
    assert "meta/info.json: data_path, fps missing" in refused(dataset)
    (dataset / "meta/info.json").write_text("[1]")
    assert "meta/info.json: input should be an object" in refused(dataset)
    (dataset / "meta/info.json").write_text("{")
    assert "meta/info.json: invalid JSON" in refused(dataset)


@pytest.mark.parametrize("keep", [0, 3, 500, -30])
@pytest.mark.parametrize("file", [DATA, EPISODES, "meta/tasks.parquet"])
def test_truncated_parquet(dataset, file, keep):
    data = (dataset / file).read_bytes()
    (dataset / file).write_bytes(data[:keep])
    text = refused(dataset)
    assert f"{dataset / file}: cannot be read as parquet" in text
    assert "the file is truncated, or its writer was stopped before its end" in text


@pytest.mark.parametrize("file", [DATA, "meta/tasks.parquet"])
def test_a_missing_table(dataset, file):
    (dataset / file).unlink()
    assert f"{dataset / file}: the file is missing" in refused(dataset)


def test_no_episode_table(dataset):
    shutil.rmtree(dataset / "meta/episodes")
    assert "meta/episodes holds no episode table" in refused(dataset)


def test_truncated_video(dataset):
    data = (dataset / VIDEO).read_bytes()
    (dataset / VIDEO).write_bytes(data[: len(data) // 2])
    text = refused(dataset)
    assert f"{dataset / VIDEO}: 28 frames expected, " in text
    assert "the file is truncated: its index points beyond its end" in text
    assert "fluxvla data validate DATASET" in text


def test_a_missing_video_matters_only_to_who_needs_it(dataset):
    (dataset / VIDEO).unlink()
    assert f"{dataset / VIDEO}: the video file is missing; 28 frames expected" in refused(dataset)
    assert len(ParquetDataset(str(dataset), [], ["wrist"])) == 28


def test_a_missing_camera_gets_a_hint(shared):
    with pytest.raises(DataError) as caught:
        ParquetDataset(str(shared), [], ["tpo"])
    text = str(caught.value)
    assert f"{shared}: there is no camera 'tpo'; did you mean '{TOP}'?" in text
    assert f"there are {TOP}, observation.images.wrist" in text
    with pytest.raises(DataError, match="there is no camera 'zzz'; there are"):
        ParquetDataset(str(shared), [], ["zzz"])


def test_a_missing_feature_gets_a_hint(shared):
    text = refused(shared, action_key="actions")
    assert "there is no feature 'actions'; did you mean 'action'?" in text
    text = refused(shared, state_key="task_index")
    assert "feature 'task_index' is int64 of shape (1,), not a vector of float32" in text


def test_images_that_are_not_in_the_tables(dataset):
    info = json.loads((dataset / "meta/info.json").read_text())
    info["features"]["observation.images.side"] = {
        "dtype": "image",
        "shape": [32, 48, 3],
        "names": None,
    }
    edit_info(dataset, features=info["features"])
    words = r"observation\.images\.side holds null, not the bytes of images"
    with pytest.raises(DataError, match=words):
        ParquetDataset(str(dataset), [], ["side"])
    info["features"]["observation.images.side"]["shape"] = [32, 48, 1]
    edit_info(dataset, features=info["features"])
    with pytest.raises(DataError, match=r"'observation\.images\.side' is of shape \(32, 48, 1\)"):
        ParquetDataset(str(dataset), [], ["side"])
    with pytest.raises(DataError, match="'action' is stored as 'float32', it is not a camera"):
        ParquetDataset(str(dataset), [], ["action"])


def test_totals_that_do_not_agree(dataset):
    edit_info(dataset, total_episodes=4)
    assert "states 4 episodes, the episode table lists 3" in refused(dataset)
    edit_info(dataset, total_episodes=3, total_frames=29)
    assert "states 29 frames, the episode table lists 28" in refused(dataset)


def test_rows_that_are_missing(dataset):
    table = pq.read_table(dataset / DATA)
    pq.write_table(table.slice(0, 27), dataset / DATA)
    assert f"{dataset / DATA}: 28 frames expected, 27 found" in refused(dataset)


def test_rows_of_another_recording(dataset):
    edit_column(dataset, DATA, "episode_index", lambda v: v[::-1])
    text = refused(dataset)
    assert "the rows of the data files are not those that the episode table lists" in text


def test_episodes_that_are_not_numbered_through(dataset):
    edit_column(dataset, EPISODES, "episode_index", lambda v: [0, 2, 3])
    assert "does not number its episodes 0, 1, 2" in refused(dataset)


def test_a_column_that_is_gone(dataset):
    edit_column(dataset, DATA, "action", None)
    assert f"{dataset / DATA}: column 'action' is missing" in refused(dataset)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda v: [r[:2] for r in v], "does not hold 3 numbers in every row"),
        (lambda v: [*v[1:], v[0][:2]], "does not hold 3 numbers in every row"),
        (lambda v: [[str(x) for x in r] for r in v], "holds string, not numbers"),
        (lambda v: [r[0] for r in v], "is double, not a list of 3 numbers"),
        (lambda v: [None, *v[1:]], "has 1 empty rows"),
        (lambda v: [[None, 0.0, 0.0], *v[1:]], "has 1 empty rows"),
        (lambda v: [[float("nan"), 0.0, 0.0], *v[1:]], "is not finite in row 0: [nan, 0.0, 0.0]"),
    ],
)
def test_values_that_are_not_what_info_says(dataset, change, message):
    edit_column(dataset, DATA, "action", change)
    text = refused(dataset)
    assert f"{dataset / DATA}: column 'action' {message}" in text


def test_other_floats_and_plain_lists_are_read_as_they_are(dataset, shared):
    edit_column(dataset, DATA, "action", lambda v: pa.array(v, pa.list_(pa.float64())))
    edit_column(
        dataset, DATA, "timestamp", lambda v: pa.array([[x] for x in v], pa.list_(pa.float32()))
    )
    ours, other = load(shared), load(dataset)
    for i in range(28):
        np.testing.assert_array_equal(ours[i]["actions"], other[i]["actions"])
        assert ours[i]["timestamp"] == other[i]["timestamp"]


def test_tasks_that_do_not_exist(dataset):
    edit_column(dataset, DATA, "task_index", lambda v: [x + 1 for x in v])
    assert "task_index runs from 1 to 2, meta/tasks.parquet lists 2 tasks" in refused(dataset)
    pq.write_table(pa.table({"a": [1]}), dataset / "meta/tasks.parquet")
    assert "tasks.parquet: columns ['a'] hold no tasks" in refused(dataset)


def test_an_embodiment_that_is_none(dataset):
    (dataset / "meta/fluxvla_embodiment.json").write_text('{"name": "x"}')
    with pytest.raises(SpecMismatch, match="this is not an embodiment spec"):
        read_metadata(dataset)


def test_datasets_that_do_not_go_together(shared, tmp_path, recorder, take, spec):
    left = spec(name="left", joints=spec().joints[::-1])
    other = recorder(tmp_path / "left", [take(0, 4)], embodiment=left)
    with pytest.raises(SpecMismatch) as caught:
        ParquetDataset([str(shared), str(other)], [], ["top"])
    assert "joints and their order" in str(caught.value)
    assert str(other) in str(caught.value)
    with LeRobotWriter(tmp_path / "fast", 20, spec()) as writer:
        take(0, 4).record(writer)
    with pytest.raises(DataError, match=r"do not go together: fps: 10\.0 / 20\.0"):
        ParquetDataset([str(shared), str(tmp_path / "fast")], [], ["top"])


def test_images_of_another_size_than_stated(dataset, capsys):
    info = json.loads((dataset / "meta/info.json").read_text())
    info["features"][TOP]["shape"] = [64, 48, 3]
    edit_info(dataset, features=info["features"])
    assert main(["data", "validate", str(dataset)]) == 2
    assert "frames of 32 x 48, info.json says 64 x 48" in capsys.readouterr().err
    assert "frames of 32 x 48, info.json says 64 x 48" in refused(dataset)


@pytest.mark.parametrize("fps", [0, -10, 9999999, "10", True, None])
def test_rates_that_are_none(dataset, fps):
    edit_info(dataset, fps=fps)
    assert "meta/info.json: fps: input should be" in refused(dataset)


def test_videos_of_another_rate_than_stated(dataset, capsys):
    edit_info(dataset, fps=20)
    assert main(["data", "validate", str(dataset)]) == 2
    said = capsys.readouterr().err
    assert f"{dataset / VIDEO}: 10 frames a second, info.json says 20" in said
    assert "10 frames a second, info.json says 20" in refused(dataset)


def test_rows_that_do_not_begin_at_zero(dataset):
    """As in a part that was cut out by hand: windows would run on into the next episode."""
    for name in ("dataset_from_index", "dataset_to_index"):
        edit_column(dataset, EPISODES, name, lambda v: [x + 5 for x in v])
    text = refused(dataset)
    assert "the rows of the data files are not those that the episode table lists" in text


def test_an_episode_without_frames(dataset):
    edit_column(dataset, EPISODES, "dataset_to_index", lambda v: [v[0], v[0], v[2]])
    edit_column(dataset, EPISODES, "dataset_from_index", lambda v: [0, v[1], v[1]])
    assert f"{dataset}: episode 1 has 0 frames" in refused(dataset)


def test_videos_without_a_place(dataset):
    edit_info(dataset, video_path=None)
    assert "info.json: video_path missing" in refused(dataset)


def test_an_instruction_that_is_no_text(dataset):
    edit_column(dataset, "meta/tasks.parquet", "task", lambda v: [v[0], None])
    assert f"{dataset}: task_index 1 has no instruction, but None" in refused(dataset)


def test_episode_tables_of_several_files(dataset, shared):
    """Written at different times, with integers of different width; or with other columns."""
    table = pq.read_table(dataset / EPISODES)
    second = dataset / "meta/episodes/chunk-000/file-001.parquet"
    i = table.schema.get_field_index("episode_index")
    narrow = table["episode_index"].cast(pa.int32())
    pq.write_table(table.set_column(i, "episode_index", narrow).slice(0, 1), second)
    pq.write_table(table.slice(1), dataset / EPISODES)
    assert load(dataset).episode_ends.tolist() == load(shared).episode_ends.tolist()
    words = pa.array(["0"])
    pq.write_table(table.slice(0, 1).set_column(i, "episode_index", words), second)
    assert "the files of meta/episodes are not of the same columns" in refused(dataset)


def rename(root, names, **changes):
    """As LeRobot's own datasets are: joints have names, and nothing else says which robot it is."""
    (root / "meta/fluxvla_embodiment.json").unlink()
    info = json.loads((root / "meta/info.json").read_text())
    for feature in ("observation.state", "action"):
        info["features"][feature]["names"] = names
    (root / "meta/info.json").write_text(json.dumps({**info, **changes}))
    return root


def test_joints_in_another_order_do_not_go_together(dataset, shared, tmp_path):
    other = shutil.copytree(shared, tmp_path / "other")
    both = [str(rename(dataset, ["a", "b", "c"])), str(rename(other, ["c", "b", "a"]))]
    with pytest.raises(DataError, match=r"another order: a, b, c / c, b, a"):
        ParquetDataset(both, [], ["top"])
    mixture = {"datasets": [{"type": "ParquetDataset", "data_root_path": b} for b in both]}
    for table in mixture["datasets"]:
        table.update(transforms=[], img_keys=["top"])
    with pytest.raises(DataError, match="another order"):
        DistributedRepeatingDataset(**mixture)


def test_joints_of_other_names_are_doubted(dataset, shared, tmp_path):
    other = shutil.copytree(shared, tmp_path / "other")
    both = [str(rename(dataset, ["a", "b", "c"])), str(rename(other, ["x", "b", "c"]))]
    warnings = ParquetDataset(both, [], ["top"]).warnings()
    assert [d for d in warnings if "states have other names: a, b, c / x, b, c" in d]
    tables = [
        {"type": "ParquetDataset", "data_root_path": b, "transforms": [], "img_keys": ["top"]}
        for b in both
    ]
    assert DistributedRepeatingDataset(tables).warnings() == warnings
    assert ParquetDataset([both[0], both[0]], [], ["top"]).warnings() == []


@pytest.mark.parametrize(
    ("pattern", "fact"),
    [
        ("{chunk_index:0999999999d}", "takes no width but one like 03d"),
        ("{chunk_index:999}", "takes no width"),
        ("{chunk_index!r}", "takes no width"),
        ("{chunk_index:{file_index}}", "takes no width"),
        ("{chunk_index.__class__}", "there is no {chunk_index.__class__}"),
        ("{0}", "there is no {0}"),
        ("{", "no pattern"),
        ("/etc/passwd", "leads out of the dataset's folder"),
        ("data/../../{chunk_index}", "leads out of the dataset's folder"),
        (3, "data_path: input should be a valid string"),
    ],
)
def test_path_patterns_are_no_programs(dataset, pattern, fact):
    edit_info(dataset, data_path=pattern)
    assert fact in refused(dataset)


def test_camera_names_do_not_lead_out(dataset):
    meta = read_metadata(dataset)
    with pytest.raises(DataError, match=r"'\.\./\.\./x' leads out of the dataset's folder"):
        meta.video_file("../../x", (0, 0))


@pytest.mark.parametrize("index", [10**12, -1, 2**60])
def test_task_numbers_have_a_bound(dataset, index):
    edit_column(dataset, "meta/tasks.parquet", "task_index", lambda v: [0, index])
    assert "task_index" in refused(dataset)


def test_tables_of_more_rows_than_expected_are_not_unpacked(dataset):
    """A million equal rows are a few kB on the disk; 10^12 were gigabytes in memory."""
    table = pq.read_table(dataset / DATA)
    pq.write_table(pa.concat_tables([table.slice(0, 1)] * 1000), dataset / DATA)
    assert f"{dataset / DATA}: 28 frames expected, 1000 found" in refused(dataset)


@pytest.mark.parametrize(
    ("changes", "fact"),
    [
        ({"features": [1]}, "features: input should be an object"),
        ({"features": {"a": 3}}, "features.a: input should be"),
        ({"features": {"a": {"dtype": 3, "shape": [1]}}}, "features.a.dtype"),
        ({"features": {"a": {"dtype": "float32", "shape": "3"}}}, "features.a.shape"),
        ({"features": {"a": {"dtype": "float32", "shape": [-1]}}}, "features.a.shape.0"),
        ({"features": {"a": {"dtype": "video", "shape": [3]}}}, "features.a.shape: an image is"),
        ({"features": {"a": {"dtype": "image", "shape": [20000, 20000, 3]}}}, "each side from 1"),
        ({"features": {"a": {"dtype": "image", "shape": [16000, 16000, 3]}}}, "64 million pixels"),
        ({"total_frames": "28"}, "total_frames"),
        ({"total_episodes": 1e400}, "total_episodes"),
        ({"codebase_version": ["v3.0"]}, "of version"),
    ],
)
def test_wrong_types_are_named_by_their_field(dataset, changes, fact):
    edit_info(dataset, **changes)
    assert fact in refused(dataset)


@pytest.mark.parametrize("text", ["[" * 100_000, '{"a":' * 100_000, '{"\\ud800": 1}', "\udc80"])
def test_json_that_is_nested_deeply_or_no_text(dataset, text):
    (dataset / "meta/info.json").write_text(text, errors="surrogateescape")
    assert "meta/info.json: " in refused(dataset)


@pytest.mark.parametrize("name", ["meta/info.json", DATA, "meta/tasks.parquet", VIDEO])
def test_pipes_and_devices_are_not_read(dataset, name):
    for make in (os.mkfifo, lambda path: os.symlink("/dev/zero", path)):
        (dataset / name).unlink()
        make(dataset / name)
        assert str(dataset) in refused(dataset)


def test_a_playlist_that_is_called_mp4_opens_nothing(dataset, tmp_path):
    """ffmpeg goes by content, and would open whatever files a playlist names."""
    secret = tmp_path / "secret.mp4"
    shutil.copy(dataset / VIDEO, secret)
    (dataset / VIDEO).write_text(
        f"#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:2.8,\n{secret}\n#EXT-X-ENDLIST\n"
    )
    assert f"{dataset / VIDEO}: cannot be opened as video" in refused(dataset)
