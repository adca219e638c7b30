from __future__ import annotations

import os
import pickle

import av
import numpy as np
import pytest

from fluxvla_core.data.video_decode import ExpectedVideo, FrameReader, VideoFile, check_video
from fluxvla_core.data.video_encode import CODECS, Clip, EpisodeEncoder, find_codec, join_clips
from fluxvla_core.errors import ConfigError, DataError

FPS = 30


def encode(path, count, first=0, codec="h264"):
    """``count`` flat grey images, each 4 brighter than the one before."""
    encoder = EpisodeEncoder(path, 16, 16, FPS, find_codec(codec))
    for i in range(first, first + count):
        encoder.add(np.full((16, 16, 3), 4 * i, np.uint8))
    encoder.close()
    return path


def stated(frames):
    return ExpectedVideo(frames, 16, 16, FPS)


def number(image):
    return round(float(image.mean()) / 4)


@pytest.fixture
def movie(tmp_path):
    return encode(tmp_path / "movie.mp4", 40)


@pytest.mark.parametrize("codec", list(CODECS))
def test_any_frame_in_any_order(tmp_path, codec):
    video = VideoFile(encode(tmp_path / "m.mp4", 40, codec=codec))
    assert video.size == (16, 16)
    assert video.whole_frames() == 40
    rng = np.random.default_rng(0)
    for i in [*range(40), *rng.integers(0, 40, 100), 39, 39, 0, 1, 3, 2]:
        assert number(video.read(i / FPS)) == i
    video.close()


def test_frames_of_a_stream_with_b_frames_and_rare_key_frames(tmp_path):
    path = tmp_path / "b.mp4"
    with av.open(str(path), "w") as out:
        stream = out.add_stream("libx264", rate=FPS, options={"bf": "3", "g": "24", "crf": "5"})
        stream.width = stream.height = 32
        stream.pix_fmt = "yuv420p"
        for i in range(60):
            image = np.full((32, 32, 3), 4 * i, np.uint8)
            out.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        out.mux(stream.encode(None))
    video = VideoFile(path)
    rng = np.random.default_rng(1)
    for i in [*rng.integers(0, 60, 150), *range(60)]:
        assert number(video.read(i / FPS)) == i


def test_reading_on_does_not_seek(movie):
    video = VideoFile(movie)
    seeks = []
    seek = video._seek
    video._seek = lambda want: (seeks.append(want), seek(want))
    for i in range(40):
        video.read(i / FPS)
    assert len(seeks) == 1


def test_a_time_a_little_off_is_the_nearest_frame_and_between_two_is_none(movie):
    video = VideoFile(movie)
    assert number(video.read(7 / FPS + 0.001)) == 7
    assert number(video.read(8 / FPS - 0.001)) == 8
    with pytest.raises(DataError) as caught:
        video.read(2.0)
    text = str(caught.value)
    assert "movie.mp4: no frame at 2.000 s (there is none); 40 frames found" in text
    assert "fluxvla data validate DATASET" in text
    assert number(video.read(3 / FPS)) == 3


def test_clips_are_joined_without_encoding_again(tmp_path):
    parts = [encode(tmp_path / f"{n}.mp4", n, first=n) for n in (5, 8, 3)]
    clips = [Clip(p, n, 0) for p, n in zip(parts, (5, 8, 3), strict=True)]
    join_clips(clips, tmp_path / "all.mp4", FPS)
    video = VideoFile(tmp_path / "all.mp4")
    expected = [*range(5, 10), *range(8, 16), *range(3, 6)]
    assert [number(video.read(i / FPS)) for i in range(16)] == expected
    with av.open(str(tmp_path / "all.mp4")) as file:
        assert file.streams.video[0].average_rate == FPS
    # and cut out again, bit by bit
    join_clips([Clip(tmp_path / "all.mp4", 8, 0, 5 / FPS)], tmp_path / "second.mp4", FPS)
    with av.open(str(parts[1])) as one, av.open(str(tmp_path / "second.mp4")) as two:
        before, after = ([bytes(p) for p in f.demux() if p.pts is not None] for f in (one, two))
    assert before == after


def test_a_clip_that_is_too_short_or_no_video(tmp_path, movie):
    with pytest.raises(DataError, match=r"movie\.mp4: 41 frames expected, 40 found"):
        join_clips([Clip(movie, 41, 0)], tmp_path / "out.mp4", FPS)
    (tmp_path / "text.mp4").write_text("no video")
    with pytest.raises(DataError, match=r"text\.mp4: cannot be read as video"):
        join_clips([Clip(movie, 40, 0), Clip(tmp_path / "text.mp4", 1, 0)], tmp_path / "o.mp4", FPS)


def test_only_so_many_files_stay_open(tmp_path):
    paths = [encode(tmp_path / f"{i}.mp4", 3, first=i) for i in range(4)]
    files = FrameReader(capacity=2)
    for _ in range(2):
        for i, path in enumerate(paths):
            assert number(files.read(path, 1 / FPS)) == i + 1
    assert [p.name for p in files._open] == ["2.mp4", "3.mp4"]
    files.read(paths[2], 0)
    files.read(paths[0], 0)
    assert [p.name for p in files._open] == ["2.mp4", "0.mp4"]
    files.close()
    assert not files._open
    assert number(files.read(paths[3], 0)) == 3


def test_open_files_are_not_shared_with_a_forked_or_spawned_worker(movie):
    files = FrameReader()
    files.read(movie, 0)
    copy = pickle.loads(pickle.dumps(files))  # noqa: S301
    assert not copy._open
    assert number(copy.read(movie, 5 / FPS)) == 5
    inherited = files._open[movie]
    files._owner = os.getpid() + 1
    assert number(files.read(movie, 6 / FPS)) == 6
    assert files._open[movie] is not inherited


def test_whole_files_pass_and_missing_ones_are_named(movie, tmp_path):
    check_video(movie, stated(40))
    check_video(movie, stated(30))
    with pytest.raises(DataError, match=r"none\.mp4: the video file is missing; 3 frames expected"):
        check_video(tmp_path / "none.mp4", stated(3))
    with pytest.raises(DataError) as caught:
        check_video(movie, stated(41))
    assert "movie.mp4: 41 frames expected, 40 found" in str(caught.value)
    assert "belongs to another dataset" in str(caught.value)


@pytest.mark.parametrize(
    ("front", "keep"),
    [*((True, keep) for keep in (0, 10, 0.5, -1)), *((False, keep) for keep in (0, 10, 0.5, -500))],
)
def test_a_truncated_file_is_found_by_its_index(front, keep, tmp_path):
    whole = encode(tmp_path / "whole.mp4", 40)
    if front:
        join_clips([Clip(whole, 40, 0)], tmp_path / "front.mp4", FPS)
        whole = tmp_path / "front.mp4"
    data = whole.read_bytes()
    size = int(keep * len(data)) if keep == 0.5 else keep % len(data)
    cut = tmp_path / "cut.mp4"
    cut.write_bytes(data[:size])
    with pytest.raises(DataError) as caught:
        check_video(cut, stated(40))
    text = str(caught.value)
    assert f"{cut}: " in text
    assert "40 frames expected, " in text
    assert "found" in text
    assert "truncated" in text or "the file is empty or missing" in text
    assert "fluxvla data validate DATASET" in text
    if front and keep in (0.5, -1):
        assert "its index points beyond its end" in text


def test_a_container_without_video(tmp_path):
    with av.open(str(tmp_path / "sound.mp4"), "w") as out:
        stream = out.add_stream("aac", rate=44100)
        frame = av.AudioFrame.from_ndarray(
            np.zeros((1, 1024), np.float32), format="fltp", layout="mono"
        )
        frame.sample_rate = 44100
        out.mux(stream.encode(frame))
        out.mux(stream.encode(None))
    with pytest.raises(DataError, match=r"sound\.mp4: holds no video stream"):
        VideoFile(tmp_path / "sound.mp4")


def test_an_encoder_that_this_build_lacks(monkeypatch):
    monkeypatch.setattr(av, "codecs_available", {"libsvtav1"})
    with pytest.raises(ConfigError) as caught:
        find_codec("h264")
    assert "this PyAV has no encoder libx264" in str(caught.value)
    assert "use one of: libsvtav1" in str(caught.value)
