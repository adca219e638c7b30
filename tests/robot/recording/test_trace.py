"""What an episode leaves behind, also when the disk does not play along."""

from __future__ import annotations

import json
import tracemalloc

import numpy as np
import pytest

from fluxvla_core.errors import RunFailed
from fluxvla_core.robot.recording.episode_log import Timings
from fluxvla_core.robot.recording.trace import EpisodeTrace, next_folder, slug


def test_lines_come_in_order_with_arrays_as_lists(tmp_path):
    trace = EpisodeTrace(tmp_path / "e", None)
    for step in range(3):
        chunk = np.arange(4.0).reshape(2, 2) + step
        event = {"step": step, "command": np.array([0.5, step]), "late": np.float64(0.25)}
        trace.write({**event, "chunk": chunk})
    trace.close({"outcome": "done"})

    lines = (tmp_path / "e" / "trace.jsonl").read_text().splitlines()
    assert [json.loads(line)["command"] for line in lines] == [[0.5, 0], [0.5, 1], [0.5, 2]]
    assert json.loads(lines[2])["chunk"] == [[2.0, 3.0], [4.0, 5.0]]
    assert json.loads((tmp_path / "e" / "episode.json").read_text()) == {
        "outcome": "done",
        "dropped": {"frames": 0, "images": 0, "events": 0},
    }
    assert sorted(p.name for p in (tmp_path / "e").iterdir()) == ["episode.json", "trace.jsonl"]


def test_each_camera_gets_a_video(tmp_path):
    av = pytest.importorskip("av")
    trace = EpisodeTrace(tmp_path, 10)
    for level in (0, 100, 200):
        trace.frames({"front": np.full((16, 16, 3), level, np.uint8),
                      "Left Wrist": np.zeros((32, 16, 3), np.uint8)})  # fmt: skip
    trace.close({})

    for name in ("front.mp4", "left-wrist.mp4"):
        with av.open(str(tmp_path / name)) as video:
            assert sum(1 for _ in video.decode(video=0)) == 3


def test_without_a_rate_there_are_no_videos(tmp_path):
    trace = EpisodeTrace(tmp_path, None)
    trace.frames({"front": np.zeros((16, 16, 3), np.uint8)})
    trace.close({})

    assert not list(tmp_path.glob("*.mp4"))


def test_frames_that_come_too_fast_are_dropped_and_counted(tmp_path, monkeypatch):
    pytest.importorskip("av")
    monkeypatch.setattr("fluxvla_core.robot.recording.trace._WAITING_BYTES", 2 * 240 * 320 * 3)
    trace = EpisodeTrace(tmp_path, 10)
    for _ in range(200):
        trace.frames({"front": np.zeros((240, 320, 3), np.uint8)})
    trace.write({"step": 1})
    trace.close({})

    summary = json.loads((tmp_path / "episode.json").read_text())
    assert summary["dropped"]["frames"] > 0
    assert (tmp_path / "trace.jsonl").read_text() == '{"step": 1}\n'


def test_what_cannot_be_written_is_said_at_the_end_and_the_rest_is_there(tmp_path):
    pytest.importorskip("av")
    trace = EpisodeTrace(tmp_path, 10)
    trace.frames({"front": np.zeros((16, 16, 3), np.uint8)})
    trace.frames({"front": np.zeros((8, 8, 3), np.uint8)})

    with pytest.raises(RunFailed, match=r"recorded completely: this video takes \(16, 16, 3\)"):
        trace.close({"outcome": "done"})
    assert (tmp_path / "episode.json").exists()


def test_a_value_that_is_no_json_is_an_error_not_a_crash(tmp_path):
    trace = EpisodeTrace(tmp_path, None)
    trace.write({"what": {1, 2}})

    with pytest.raises(RunFailed, match="a trace holds JSON values and arrays, not set"):
        trace.close({})


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(RunFailed, match="cannot record the episode") as caught:
        EpisodeTrace(tmp_path / "file" / "x", None)
    assert str(tmp_path / "file" / "x") in str(caught.value)


def test_episodes_are_numbered_on(tmp_path):
    assert next_folder(tmp_path, "1").name == "001-1"
    (tmp_path / "009-wave").mkdir()
    (tmp_path / "notes").mkdir()
    assert next_folder(tmp_path, "Lift the RED cube!").name == "010-lift-the-red-cube"


@pytest.mark.parametrize(
    ("text", "name"), [("../etc", "etc"), ("", "task"), ("a" * 90, "a" * 40), ("ü?", "task")]
)
def test_names_are_safe_for_files(text, name):
    assert slug(text) == name


def test_timings_are_percentiles_in_milliseconds():
    timings = Timings()
    for n in range(1, 101):
        timings.add("send", n / 1000)
    timings.add("policy", 0.5)
    timings.add("sync", 0.0)

    report = timings.summary()
    assert list(report) == ["send", "policy", "sync"]
    assert report["send"] == {
        "count": 100,
        "p50_ms": pytest.approx(50, rel=0.003),
        "p95_ms": pytest.approx(95, rel=0.003),
        "p99_ms": pytest.approx(99, rel=0.003),
        "max_ms": 100.0,
    }
    assert report["policy"]["p99_ms"] == pytest.approx(500, rel=0.003)
    assert set(report["sync"].values()) == {1, 0.0}
    assert Timings().summary() == {}


def test_timings_of_a_long_episode_take_no_more_memory():
    timings = Timings()
    durations = np.random.default_rng(0).lognormal(-4.0, 0.2, 100_000).tolist()
    tracemalloc.start()
    for seconds in durations:
        timings.add("send", seconds)
    taken, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    # As floats they would take 800 kB.
    assert taken < 100_000
    assert timings.summary()["send"]["count"] == 100_000
