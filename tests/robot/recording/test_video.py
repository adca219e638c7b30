"""What the writer writes can be read back; what it cannot take is refused by name."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from fluxvla_core.errors import DataError, RunFailed
from fluxvla_core.robot.recording.video import VideoWriter

av = pytest.importorskip("av")


def read(path):
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        return [f.to_ndarray(format="rgb24") for f in container.decode(stream)], stream.average_rate


def test_frames_come_back_in_order_at_the_rate(tmp_path):
    path = tmp_path / "deep" / "clip.mp4"
    with VideoWriter(path, 10, 48, 64) as video:
        for level in (20, 120, 220):
            video.add(np.full((48, 64, 3), level, np.uint8))
        assert not path.exists()

    frames, rate = read(path)
    assert [f.shape for f in frames] == [(48, 64, 3)] * 3
    assert [int(f.mean()) for f in frames] == pytest.approx([20, 120, 220], abs=4)
    assert rate == 10
    assert list(path.parent.iterdir()) == [path]


def test_colours_are_rgb(tmp_path):
    red = np.zeros((32, 32, 3), np.uint8)
    red[..., 0] = 255
    with VideoWriter(tmp_path / "red.mp4", 5, 32, 32) as video:
        video.add(red)

    (frame,), _ = read(tmp_path / "red.mp4")
    assert frame[..., 0].mean() > 200
    assert frame[..., 2].mean() < 60


def test_an_odd_last_row_and_column_are_dropped(tmp_path):
    with VideoWriter(tmp_path / "odd.mp4", 5, 31, 33) as video:
        video.add(np.zeros((31, 33, 3), np.uint8))

    frames, _ = read(tmp_path / "odd.mp4")
    assert frames[0].shape == (30, 32, 3)


def test_a_video_without_frames_leaves_no_file(tmp_path):
    VideoWriter(tmp_path / "none.mp4", 5, 32, 32).close()

    assert list(tmp_path.iterdir()) == []


def test_closing_twice_is_harmless(tmp_path):
    video = VideoWriter(tmp_path / "v.mp4", 5, 32, 32)
    video.add(np.zeros((32, 32, 3), np.uint8))
    video.close()
    video.close()

    assert (tmp_path / "v.mp4").exists()


@pytest.mark.parametrize(
    "frame", [np.zeros((32, 30, 3), np.uint8), np.zeros((32, 32, 3), np.float32)]
)
def test_a_frame_of_another_shape_or_dtype_is_refused(tmp_path, frame):
    with (
        VideoWriter(tmp_path / "v.mp4", 5, 32, 32) as video,
        pytest.raises(DataError, match=r"takes \(32, 32, 3\) uint8 frames, got"),
    ):
        video.add(frame)


def test_a_place_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("not a folder")

    with pytest.raises(RunFailed, match="cannot write a video"):
        VideoWriter(tmp_path / "file" / "v.mp4", 5, 32, 32)


def test_without_pyav_the_message_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)

    with pytest.raises(RunFailed, match=r"pip install 'fluxvla-core\[data\]'"):
        VideoWriter(tmp_path / "v.mp4", 5, 32, 32)
