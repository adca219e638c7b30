"""``fluxvla data inspect``, ``validate`` and ``stats`` on real datasets, whole and damaged."""

from __future__ import annotations

import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from fluxvla_core.cli.main import main
from fluxvla_core.data.dataset import ParquetDataset

from .version2 import write_v2

TOP, WRIST = "observation.images.top", "observation.images.wrist"
DATA = "data/chunk-000/file-000.parquet"


@pytest.fixture
def fluxvla(capsys):
    def run(*words):
        code = main(["data", *map(str, words)])
        out, err = capsys.readouterr()
        return code, out, err

    return run


def video(root, camera):
    return root / f"videos/observation.images.{camera}/chunk-000/file-000.mp4"


def blank(path):
    """Damage that no index shows: zeros where frame data was."""
    data = bytearray(path.read_bytes())
    start = data.index(b"mdat") + 4
    data[start:] = bytes(len(data) - start)
    path.write_bytes(data)


def test_inspect_for_people(shared, fluxvla):
    code, out, err = fluxvla("inspect", shared)
    assert (code, err) == (0, "")
    for line in (
        f"{shared}: LeRobot v3.0",
        "  robot     arm",
        "  episodes  3, of 7 to 12 frames",
        "  frames    28 at 10 Hz, 3 s in all",
        f"  camera    {TOP}: 32 x 48, 1 files, 0.0 MB",
        "  vector    action (3): waist, elbow, gripper",
        "  task    0 2 episodes: hold the cube",
        "  task    1 1 episodes: hand the cube over",
    ):
        assert line in out.splitlines()


def test_inspect_for_programs(shared, takes, tmp_path, fluxvla):
    facts = json.loads(fluxvla("inspect", shared, "--json")[1])
    assert facts["version"] == "v3.0"
    assert facts["cameras"][WRIST]["height"] == 16
    assert facts["cameras"][WRIST]["codec"] == "h264"
    assert facts["data"]["bytes"] == (shared / DATA).stat().st_size
    old = json.loads(fluxvla("inspect", write_v2(tmp_path / "old", takes), "--json")[1])
    assert (old["version"], old["embodiment"], old["robot_type"]) == ("v2.1", None, "arm")
    assert old["cameras"][TOP]["files"] == old["data"]["files"] == 3
    for key in ("episodes", "frames", "seconds", "tasks", "vectors", "episode_frames"):
        assert old[key] == facts[key]


def test_inspect_decodes_nothing(dataset, fluxvla):
    video(dataset, "top").unlink()
    code, out, _ = fluxvla("inspect", dataset)
    assert code == 0
    assert "robot     arm" in out
    (dataset / "meta/fluxvla_embodiment.json").unlink()
    assert (
        "robot     does not say (a config then says embodiment=)" in fluxvla("inspect", dataset)[1]
    )


def test_names_of_older_datasets(tmp_path, takes, fluxvla):
    root = write_v2(tmp_path / "old", takes)
    path = root / "meta/info.json"
    info = json.loads(path.read_text())
    info["features"]["action"]["names"] = {"motors": ["a", "b", "c"]}
    info["features"]["observation.state"]["names"] = ["too", "few"]
    path.write_text(json.dumps(info))
    out = fluxvla("inspect", root)[1]
    assert "vector    action (3): a, b, c" in out
    assert "vector    observation.state (3)\n" in out
    assert "  0 " in fluxvla("stats", root)[1]


def test_many_tasks_are_not_all_listed(dataset, fluxvla):
    many = pa.table({"task_index": range(30), "task": [f"do {i}" for i in range(30)]})
    pq.write_table(many, dataset / "meta/tasks.parquet")
    out = fluxvla("inspect", dataset)[1]
    assert "task   11 0 episodes: do 11" in out
    assert out.endswith("… and 18 more tasks\n")


@pytest.mark.parametrize("command", ["inspect", "validate", "stats"])
def test_no_dataset(command, tmp_path, fluxvla):
    code, out, err = fluxvla(command, tmp_path / "none")
    assert (code, out) == (2, "")
    assert "there is no dataset here: the folder does not exist" in err
    code, _, err = fluxvla(command)
    assert code == 2
    assert "the following arguments are required: DIR" in err
    assert f"fluxvla data {command} --help" in err


def test_validate_says_that_all_is_well(shared, fluxvla):
    code, out, err = fluxvla("validate", shared)
    assert (code, err) == (0, "")
    assert f"{shared}: LeRobot v3.0, 3 episodes, 28 frames at 10 Hz" in out
    assert f"{WRIST}: 28 frames in 1 files" in out
    assert "decode frames 56/56" in out
    assert out.endswith(f"nothing is wrong with {shared}\n")


def test_validate_speaks_to_programs(shared, fluxvla):
    out = fluxvla("validate", shared, "--log-format", "json")[1]
    records = [json.loads(line) for line in out.splitlines()]
    progress = [r for r in records if r["kind"] == "progress"]
    assert {r["name"] for r in progress} == {"decode frames"}
    assert (progress[-1]["done"], progress[-1]["total"]) == (56, 56)


@pytest.mark.parametrize("camera", ["top", "wrist"])
def test_every_frame_is_decoded_by_validate(camera, dataset, fluxvla):
    blank(video(dataset, camera))
    assert len(ParquetDataset(str(dataset), [], [camera])) == 28
    code, _, err = fluxvla("validate", dataset)
    assert code == 2
    assert f"{video(dataset, camera)}: no frame at 0.000 s" in err
    assert "findings" not in err


def test_validate_names_all_that_is_wrong(dataset, fluxvla):
    blank(video(dataset, "top"))
    video(dataset, "wrist").unlink()
    table = pq.read_table(dataset / DATA)
    times = table["timestamp"].to_numpy().copy()
    times[9] += 0.06
    i = table.schema.get_field_index("timestamp")
    pq.write_table(table.set_column(i, "timestamp", [times]), dataset / DATA)
    code, _, err = fluxvla("validate", dataset)
    assert code == 2
    assert f"{dataset}: 3 findings" in err
    assert (
        "1 timestamps are off by half a frame or more, for example 0.260 s at frame 2 of "
        "episode 1, 0.200 s expected" in err
    )
    assert f"{video(dataset, 'wrist')}: the video file is missing; 28 frames expected" in err
    assert f"{video(dataset, 'top')}: no frame at 0.000 s" in err


def test_validate_warns_of_what_only_some_need(dataset, fluxvla):
    """Upstream's flaw D1: its merged deviations were too small; here they are called wrong."""
    (dataset / "meta/fluxvla_embodiment.json").unlink()
    path = dataset / "meta/stats.json"
    stats = json.loads(path.read_text())
    stats["action"]["std"] = [s / np.sqrt(3) for s in stats["action"]["std"]]
    del stats["observation.state"]["q01"]
    path.write_text(json.dumps(stats))
    code, out, _ = fluxvla("validate", dataset)
    assert code == 0
    assert "warning: meta/fluxvla_embodiment.json is missing" in out
    assert "meta/stats.json: action: std is not that of the data" in out
    assert "meta/stats.json: observation.state lacks q01" in out
    assert "nothing is wrong with" in out
    assert "3 warnings" in out
    assert fluxvla("stats", dataset, "--write")[0] == 0
    assert "1 warnings" in fluxvla("validate", dataset)[1]
    path.write_text("{}")
    assert "meta/stats.json: nothing about action" in fluxvla("validate", dataset)[1]


def test_validate_warns_of_episodes_without_instruction(tmp_path, takes, fluxvla):
    root = write_v2(tmp_path / "old", takes)
    (root / "meta/tasks.jsonl").write_text('{"task_index": 1, "task": "x"}\n')
    out = fluxvla("validate", root)[1]
    assert "warning: meta/tasks.jsonl: no instruction for task_index [0]" in out


def test_statistics_are_those_that_training_uses(shared, fluxvla):
    code, out, err = fluxvla("stats", shared, "--json")
    assert (code, err) == (0, "")
    used = ParquetDataset(str(shared), [], []).statistics["private"]
    assert json.loads(out) == {"observation.state": used["proprio"], "action": used["action"]}


def test_statistics_of_pixels_are_what_was_recorded(shared, dataset, fluxvla):
    code, out, err = fluxvla("stats", shared, "--json", "--pixels")
    assert code == 0
    assert "count pixels 56/56" in err
    found = json.loads(out)
    recorded = json.loads((shared / "meta/stats.json").read_text())
    assert found["action"] == recorded["action"]
    # What was recorded is before compression.
    np.testing.assert_allclose(found[TOP]["mean"], recorded[TOP]["mean"], atol=0.02)
    assert found[TOP]["count"] == [28]
    code, _, err = fluxvla("stats", dataset, "--pixels", "--write")
    assert f"statistics: {dataset}/meta/stats.json" in err
    written = json.loads((dataset / "meta/stats.json").read_text())
    assert {key: written[key] for key in found} == found
    assert written["index"] == recorded["index"]


def test_statistics_for_people(shared, takes, fluxvla):
    out = fluxvla("stats", shared, "--pixels")[1].splitlines()
    assert "action: 28 frames" in out
    waist = np.concatenate([t.action[:, 0] for t in takes])
    row = next(line.split() for line in out[out.index("action: 28 frames") :] if "waist" in line)
    assert row[1] == f"{waist.min():.4g}"
    assert row[-1] == f"{waist.astype(float).std():.4g}"
    assert f"{TOP}: 28 frames" in out
    assert any(line.startswith("  green") for line in out)


def test_statistics_tell_people_what_hardly_moves(tmp_path, recorder, take, fluxvla):
    still = take(4, 300)
    still.state[:, 0] = 0.5
    still.action[:, 2] = 0.0
    still.action[7, 2] = 1.0
    out = fluxvla("stats", recorder(tmp_path / "still", [still]))[1].splitlines()
    action = out.index("action: 300 frames")
    state = out.index("observation.state: 300 frames")
    assert [i for i, line in enumerate(out) if line.endswith("  never moves")] == [state + 2]
    rare = "  moves in under 2 % of the frames"
    assert [i for i, line in enumerate(out) if line.endswith(rare)] == [action + 4]


def test_statistics_of_version_2_are_not_written(tmp_path, takes, fluxvla):
    root = write_v2(tmp_path / "old", takes)
    code, out, err = fluxvla("stats", root, "--write")
    assert (code, out) == (2, "")
    assert "v2.1 keeps its statistics by episode, without quantiles" in err
    assert f"next: fluxvla data convert {root} OUT" in err
    assert fluxvla("stats", root)[0] == 0


def truncate(path):
    path.write_bytes(path.read_bytes()[:-200])


def test_validate_names_every_damaged_video_of_a_camera(tmp_path, recorder, fluxvla):
    root = recorder(tmp_path / "split", video_file_mb=0.0005)
    files = sorted(root.glob(f"videos/{TOP}/*/*.mp4"))
    assert len(files) == 3
    truncate(files[0])
    files[1].unlink()
    blank(files[2])
    code, _, err = fluxvla("validate", root)
    assert code == 2
    assert "3 findings" in err
    for path in files:
        assert str(path) in err


def test_validate_names_every_damaged_table(tmp_path, recorder, fluxvla):
    root = recorder(tmp_path / "split", data_file_mb=0.0001)
    files = sorted(root.glob("data/*/*.parquet"))
    assert len(files) == 3
    truncate(files[0])
    files[2].unlink()
    code, _, err = fluxvla("validate", root)
    assert code == 2
    assert "2 findings" in err
    assert str(files[0]) in err
    assert str(files[2]) in err


def test_validate_refuses_instructions_that_are_not_there(tmp_path, takes, fluxvla):
    root = write_v2(tmp_path / "old", takes)
    (root / "meta/tasks.jsonl").write_text('{"task_index": 0, "task": "x"}\n')
    code, _, err = fluxvla("validate", root)
    assert code == 2
    assert "task_index runs from 0 to 1, meta/tasks.jsonl lists 1 tasks" in err
