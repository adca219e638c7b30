"""A bag as it is written, cut short, damaged and finished."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fluxvla_core.cli.main import main
from fluxvla_core.errors import DataError, RunFailed
from fluxvla_core.robot.recording.bag import Bag, McapFile
from fluxvla_core.robot.recording.recorded import (
    finish_recording,
    open_recording,
    read_bag,
    read_lines,
)
from fluxvla_core.robot.recording.trace import EpisodeTrace, JsonLines, Recording
from fluxvla_core.spec import Camera, EmbodimentSpec, Joint

pytest.importorskip("rosbags")

SPEC = EmbodimentSpec(
    "arm", (Joint("a", "rad", -1, 1, 1, 1),), (Camera("left/wrist cam", 4, 6),), 10.0
)
NAMES = {"state": ("a",), "action": ("a",)}
START = {"event": "start", "t": 5.0, "format": "fluxvla-episode-1", "native": False}
CAMERA = "left/wrist cam"


def solid(level: int) -> np.ndarray[Any, np.dtype[np.uint8]]:
    return np.full((4, 6, 3), level, np.uint8)


def write(folder: Path, count: int = 20, flush: int | None = None) -> None:
    bag = Bag(folder, NAMES)
    bag.add({**START, "embodiment": SPEC.to_dict(), "instruction": "wave"})
    for n in range(count):
        t = 5.0 + n / 10
        bag.image(CAMERA, t, solid(n))
        bag.add({"event": "command", "t": t, "command": np.array([n / 7]), "phase": "run"})
        if n == flush:
            bag.flush()
    bag.close()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write(tmp_path / "001-1", flush=9)
    return tmp_path / "001-1"


def test_values_come_back_exactly_and_in_order(folder: Path) -> None:
    found = open_recording(folder)
    assert found.finished
    assert [e["event"] for e in found.events] == ["start"] + ["command"] * 20
    assert found.commands()[1][:, 0].tolist() == [n / 7 for n in range(20)]
    assert found.images[CAMERA].read(7).tolist() == solid(7).tolist()
    assert found.images[CAMERA].times == pytest.approx([5 + n / 10 for n in range(20)])


def test_an_image_is_written_once(tmp_path: Path) -> None:
    bag = Bag(tmp_path / "b", NAMES)
    bag.add({**START, "embodiment": SPEC.to_dict()})
    for _ in range(3):
        bag.image(CAMERA, 5.0, solid(1))
    bag.close()
    assert len(open_recording(tmp_path / "b").images[CAMERA]) == 1


def test_an_image_that_nobody_looked_at_loses_a_little_until_somebody_does(tmp_path: Path) -> None:
    pytest.importorskip("cv2")
    noise = np.random.default_rng(0).integers(100, 140, (4, 6, 3), dtype=np.uint8)
    bag = Bag(tmp_path / "b", NAMES)
    bag.add({**START, "embodiment": SPEC.to_dict()})
    for t in (5.0, 5.1, 5.1):
        bag.image(CAMERA, t, noise, exact=False)
    bag.image(CAMERA, 5.1, noise)
    bag.image(CAMERA, 5.2, noise)
    bag.image(CAMERA, 5.2, noise, exact=False)
    bag.close()

    kinds = [(kind, ns) for _, kind, ns, _ in read_bag(tmp_path / "b" / "b.mcap").images]
    assert len(kinds) == 4  # 5.0 and 5.1 as JPEG, 5.1 and 5.2 as they were
    found = open_recording(tmp_path / "b").images[CAMERA]
    assert found.times == pytest.approx([5.0, 5.1, 5.2])
    lossy = found.read(0).astype(int)
    assert 0 < np.abs(lossy - noise).max() < 40
    assert (found.read(1) == noise).all()
    assert (found.read(2) == noise).all()


@pytest.mark.parametrize(
    ("metres", "kept"),
    [(0.0014, 0.001), (65.535, 65.535), (65.536, None), (-1, None), (np.inf, None), (None, None)],
)
def test_depth_is_whole_millimetres_or_nothing(
    tmp_path: Path, metres: float | None, kept: float | None
) -> None:
    given = np.full((4, 6), np.nan if metres is None else metres, np.float32)
    bag = Bag(tmp_path / "b", NAMES)
    bag.add({**START, "embodiment": SPEC.to_dict()})
    for _ in range(2):
        bag.depth(CAMERA, 5.0, given)
    bag.close()

    found = open_recording(tmp_path / "b")
    assert len(found.depths[CAMERA]) == 1
    assert found.images == {}
    read = found.depths[CAMERA].read(0)
    assert read.dtype == np.float32
    assert np.isnan(read).all() if kept is None else read == pytest.approx(np.float32(kept))


def test_without_opencv_every_image_is_exact(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fluxvla_core.robot.recording.ros_messages.has_jpeg", lambda: False)
    bag = Bag(tmp_path / "b", NAMES)
    bag.add({**START, "embodiment": SPEC.to_dict()})
    bag.image(CAMERA, 5.0, solid(7), exact=False)
    bag.close()
    assert (open_recording(tmp_path / "b").images[CAMERA].read(0) == 7).all()


def test_jpegs_need_opencv_to_be_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("cv2")
    bag = Bag(tmp_path / "b", NAMES)
    bag.add({**START, "embodiment": SPEC.to_dict()})
    bag.image(CAMERA, 5.0, solid(7), exact=False)
    bag.close()
    monkeypatch.setattr("fluxvla_core.robot.recording.ros_messages.has_jpeg", lambda: False)
    with pytest.raises(DataError, match="the package 'cv2' is not installed"):
        open_recording(tmp_path / "b").images[CAMERA].read(0)


def test_pictures_is_a_deprecated_name_of_images(folder: Path) -> None:
    recorded, content = open_recording(folder), read_bag(folder / f"{folder.name}.mcap")
    with pytest.warns(
        DeprecationWarning, match=r"RecordedEpisode.pictures is deprecated, use images"
    ):
        assert recorded.pictures is recorded.images
    with pytest.warns(DeprecationWarning, match=r"BagContent.pictures is deprecated, use images"):
        assert content.pictures is content.images
    with pytest.warns(DeprecationWarning, match=r"BagContent.whole is deprecated, use finished"):
        assert content.whole is content.finished
    with pytest.warns(DeprecationWarning, match=r"Episode.whole is deprecated, use finished"):
        assert recorded.whole is recorded.finished


def test_the_newest_image_by_a_time(folder: Path) -> None:
    images = open_recording(folder).images[CAMERA]
    assert [images.newest(t) for t in (4.9, 5.0, 5.05, 5.1, 99.0)] == [None, 0, 0, 1, 19]


def test_what_is_cut_anywhere_is_read_up_to_there_and_can_be_finished(folder: Path) -> None:
    bag = folder / "001-1.mcap"
    content = bag.read_bytes()
    whole = open_recording(folder).events
    lengths = []
    for size in range(len(content) - 1, 700, -211):
        bag.write_bytes(content[:size])
        found = read_bag(bag)
        assert found.events == whole[: len(found.events)]
        lengths.append(len(found.events))
    assert sorted(set(lengths)) == [0, 11, 21]  # two chunks: one was flushed
    bag.write_bytes(content[: len(content) // 2])
    (folder / "metadata.yaml").unlink()
    left = open_recording(folder)
    assert not left.finished

    assert finish_recording(folder) is True

    again = open_recording(folder)
    assert again.finished
    assert again.events == left.events
    assert json.loads((folder / "episode.json").read_text())["outcome"] == "cut short"
    assert finish_recording(folder) is False


def test_the_command_finishes_all_in_a_folder(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write(folder.parent / "002-1")
    (folder / "metadata.yaml").unlink()
    assert main(["data", "finish", str(folder.parent)]) == 0
    assert capsys.readouterr().out.splitlines() == [
        f"{folder}: finished",
        f"{folder.parent / '002-1'}: is complete",
    ]
    assert main(["data", "finish", str(folder / "001-1.mcap")]) == 2
    assert "only an episode's folder with a bag can be finished" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda b: b"x" * 100, "this is no MCAP file"),
        (lambda b: b.replace(b"\x28\xb5\x2f\xfd", bytes(4), 1), "a chunk cannot be decompressed"),
        (lambda b: b.replace(b"zstd", b"lz4 ", 1), "a chunk is compressed with 'lz4 '"),
    ],
)
def test_damage_before_the_end_is_said(folder: Path, damage: Any, said: str) -> None:
    bag = folder / "001-1.mcap"
    bag.write_bytes(damage(bag.read_bytes()))
    with pytest.raises(DataError, match=said) as caught:
        open_recording(folder)
    assert str(bag) in str(caught.value)


def test_a_file_that_is_gone_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="cannot be read: No such file"):
        list(McapFile(tmp_path / "x.mcap").entries())


def test_a_record_that_does_not_say_what_it_is_of(tmp_path: Path) -> None:
    bag = Bag(tmp_path / "b", NAMES)
    bag.add({"event": "command", "t": 1.0, "command": np.array([1.0])})
    bag.close()
    with pytest.raises(DataError, match="the record does not say what it is of"):
        open_recording(tmp_path / "b")
    lines = JsonLines(tmp_path)
    lines.add({**START, "format": "fluxvla-episode-9"})
    lines.close()
    with pytest.raises(DataError, match="is of format 'fluxvla-episode-9'"):
        open_recording(tmp_path)


def test_a_line_that_is_no_event_is_named(tmp_path: Path) -> None:
    file = tmp_path / "trace.jsonl"
    file.write_text('{"event": "start", "t": 0}\n{"ev')
    assert read_lines(file) == ([{"event": "start", "t": 0}], False)
    file.write_text('{"event": "start", "t": 0}\n{"ev\n')
    with pytest.raises(DataError, match="this line is no event") as caught:
        read_lines(file)
    assert f"{file}:2" in str(caught.value)
    for line, fact in (('{"event": "start"}', "t: "), ('{"event": 1, "t": 0}', "event: ")):
        file.write_text(line + "\n")
        with pytest.raises(DataError, match=fact):
            read_lines(file)


def test_a_folder_that_is_there_is_not_written_over(folder: Path) -> None:
    with pytest.raises(RunFailed, match=r"cannot record the episode: .* is there already"):
        EpisodeTrace(folder, None, Recording(NAMES))


def test_what_the_robot_cannot_give_hurts_nothing_else(tmp_path: Path) -> None:
    def broken(camera: str, after: float) -> Any:
        raise DataError("the image has another size")

    trace = EpisodeTrace(tmp_path / "e", 10.0, Recording(NAMES, (CAMERA,), broken))
    trace.write({**START, "embodiment": SPEC.to_dict()})
    trace.close({})
    assert open_recording(tmp_path / "e").finished


def test_events_beyond_the_limit_are_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fluxvla_core.robot.recording.trace._WAITING_EVENTS", 0)
    trace = EpisodeTrace(tmp_path / "e", None)
    trace.write({"event": "start", "t": 0.0})
    assert trace.close({})["dropped"] == {"frames": 0, "images": 0, "events": 1}


def test_images_that_a_robot_lost_before_they_were_asked_for_are_counted(tmp_path: Path) -> None:
    asked: list[float] = []

    def source(camera: str, after: float) -> Any:
        asked.append(after)
        new = after + 0.01
        return [(new, solid(len(asked)))], 3 * len(asked)

    trace = EpisodeTrace(tmp_path / "e", 10.0, Recording(NAMES, (CAMERA,), source))
    trace.write({**START, "embodiment": SPEC.to_dict()})
    while len(asked) < 3:
        time.sleep(0.01)
    summary = trace.close({})
    assert summary["dropped"]["images"] == 2 * (len(asked) - 1)
    assert len(open_recording(tmp_path / "e").images[CAMERA]) == len(asked)
