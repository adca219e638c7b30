"""Frames that several threads decode are those that one thread reads."""

from __future__ import annotations

import multiprocessing
import threading

import numpy as np
import pytest
import torch

from fluxvla_core.data import frames as frames_module
from fluxvla_core.data.frames import MAX_OPEN_FILES, MAX_THREADS, DecoderThreads, thread_count
from fluxvla_core.data.video_decode import FrameReader
from fluxvla_core.data.video_encode import EpisodeEncoder, find_codec
from fluxvla_core.errors import DataError

FPS = 30


@pytest.fixture(scope="module")
def movies(tmp_path_factory):
    """Three files of 20 flat images; image ``i`` of file ``k`` is as grey as ``60 k + 3 i``."""
    folder = tmp_path_factory.mktemp("movies")
    for k in range(3):
        encoder = EpisodeEncoder(folder / f"{k}.mp4", 16, 16, FPS, find_codec("h264"))
        for i in range(20):
            encoder.add(np.full((16, 16, 3), 60 * k + 3 * i, np.uint8))
        encoder.close()
    return [folder / f"{k}.mp4" for k in range(3)]


@pytest.fixture
def allowed():
    """Sets how many threads torch may use, until the test is over."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


def wish(movies, count, seed=0):
    rng = np.random.default_rng(seed)
    drawn = sorted((int(rng.integers(3)), int(rng.integers(20))) for _ in range(count))
    return [(movies[k], i / FPS) for k, i in drawn], [60 * k + 3 * i for k, i in drawn]


def greys(images):
    return [image.mean() for image in images]


@pytest.mark.parametrize("count", [1, 2, 3, MAX_THREADS, 2 * MAX_THREADS])
def test_every_image_is_the_one_asked_for(movies, allowed, count):
    allowed(count)
    decoders = DecoderThreads()
    for size in (24, 0, 1, 2, 3, 24, 7):
        wanted, expected = wish(movies, size, size)
        assert greys(decoders.read(wanted)) == pytest.approx(expected, abs=1)
    assert len(decoders._readers) == min(count, MAX_THREADS)
    decoders.close()


def test_threads_decode_at_the_same_time(movies, allowed, monkeypatch):
    """Each waits until the other is there as well."""
    allowed(2)
    together = threading.Barrier(2, timeout=30)
    read = FrameReader.read

    def wait_then_read(self, source, time):
        together.wait()
        return read(self, source, time)

    monkeypatch.setattr(FrameReader, "read", wait_then_read)
    wanted, expected = wish(movies, 8)
    assert greys(DecoderThreads().read(wanted)) == pytest.approx(expected, abs=1)


def test_nothing_to_share_out_starts_no_thread(movies, allowed, monkeypatch):
    """Without cameras, every batch had threads started for it."""
    allowed(4)
    monkeypatch.setattr(frames_module, "ThreadPoolExecutor", None)
    wanted, expected = wish(movies, 1)
    assert DecoderThreads().read([]) == []
    assert greys(DecoderThreads().read(wanted)) == pytest.approx(expected, abs=1)


def test_they_are_as_many_as_torch_may_use_and_share_the_open_files(movies, allowed):
    decoders = DecoderThreads()
    for count in (3, 1):
        allowed(count)
        assert thread_count() == count
        decoders.read(wish(movies, 3)[0])
        assert [files.capacity for files in decoders._readers] == [MAX_OPEN_FILES // count] * count


def read_in_child(decoders, wanted, answers):
    answers.put((thread_count(), greys(decoders.read(wanted))))


@pytest.mark.parametrize("context", ["fork", "spawn"])
def test_a_child_reads_with_files_of_its_own(movies, allowed, context):
    allowed(2)
    decoders = DecoderThreads()
    wanted, expected = wish(movies, 12)
    decoders.read(wanted)
    start = multiprocessing.get_context(context)
    answers = start.SimpleQueue()
    child = start.Process(target=read_in_child, args=(decoders, wanted, answers))
    child.start()
    found = answers.get()[1]
    child.join(60)
    assert found == pytest.approx(expected, abs=1)
    assert greys(decoders.read(wanted)) == pytest.approx(expected, abs=1)


def test_what_cannot_be_read_is_told_whichever_thread_meets_it(movies, allowed, tmp_path):
    allowed(3)
    wanted, expected = wish(movies, 6)
    decoders = DecoderThreads()
    for place in (0, 3, 6):
        with pytest.raises(DataError, match=r"gone\.mp4: cannot be opened as video"):
            decoders.read([*wanted[:place], (tmp_path / "gone.mp4", 0.0), *wanted[place:]])
    assert greys(decoders.read(wanted)) == pytest.approx(expected, abs=1)
