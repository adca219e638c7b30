"""``Ring``: every message arrives once, whole and in order, or is counted as dropped."""

from __future__ import annotations

import mmap
import os
import subprocess
import sys
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fluxvla_core.robot.process.ring import Ring

POSITIONS = 64
HEAD = slice(0, 8)


def memory(size):
    return memoryview(bytearray(POSITIONS + size))


def message(number, length):
    return bytes((number + i) % 251 for i in range(length))


@pytest.mark.parametrize("length", range(1, 40))
def test_messages_wrap_around_at_every_offset(length):
    ring = Ring(memory(96))

    for number in range(60):
        assert ring.write(message(number, length))
        assert ring.read() == message(number, length)
    assert ring.read() is None
    assert ring.dropped == 0


@given(st.lists(st.one_of(st.just(None), st.binary(min_size=1, max_size=60)), max_size=200))
def test_it_is_a_queue_with_room_for_so_much(steps):
    ring, waiting, dropped = Ring(memory(128)), [], 0

    for step in steps:
        if step is None:
            assert ring.read() == (waiting.pop(0) if waiting else None)
        elif ring.write(step):
            waiting.append(step)
        else:
            dropped += 1
    while waiting:
        assert ring.read() == waiting.pop(0)
    assert ring.read() is None
    assert ring.dropped == dropped


@pytest.mark.parametrize("size", [64, 65, 71, 72])
def test_a_full_ring_drops_and_counts_and_goes_on(size):
    ring = Ring(memory(size))

    assert ring.write(b"x" * 24)
    assert ring.write(b"y" * 24)
    assert [ring.write(b"z" * 24) for _ in range(3)] == [False] * 3
    assert ring.dropped == 3
    assert [ring.read(), ring.read(), ring.read()] == [b"x" * 24, b"y" * 24, None]
    assert ring.write(b"z" * 24)
    assert ring.read() == b"z" * 24


@pytest.mark.parametrize("size", [64, 65, 71, 72])
def test_the_largest_message_fits_and_a_larger_one_never_does(size):
    ring = Ring(memory(size))

    for _ in range(3):
        assert ring.write(b"x" * ring.largest)
        assert ring.read() == b"x" * ring.largest
        assert not ring.write(b"x" * (ring.largest + 1))
    assert ring.dropped == 3


def test_an_empty_message_is_refused():
    with pytest.raises(ValueError, match="empty"):
        Ring(memory(64)).write(b"")


@given(
    before=st.lists(st.binary(min_size=1, max_size=30), min_size=1, max_size=12),
    new=st.binary(min_size=1, max_size=40),
    seed=st.integers(0, 2**32 - 1),
)
def test_a_record_that_is_half_written_is_not_there(before, new, seed):
    # A processor that reorders its stores may show another one the position first, and the bytes
    # of the record in any order; where it goes there is what the ring had before.
    shared = memory(64)
    ring = Ring(shared)
    for each in before:
        assert ring.write(each)
        assert ring.read() == each
    after = bytearray(shared)
    assert Ring(memoryview(after)).write(new)

    reader = Ring(shared)
    shared[HEAD] = after[HEAD]
    changed = [i for i in range(POSITIONS, len(after)) if after[i] != shared[i]]
    for index in np.random.default_rng(seed).permutation(changed):
        assert reader.read() is None
        shared[index] = after[index]
    assert reader.read() == new
    assert reader.read() is None


def test_a_record_of_the_lap_before_is_not_taken_for_a_new_one():
    shared = memory(32)
    ring = Ring(shared)
    for number in range(2):
        ring.write(message(number, 8))
        ring.read()
    # The position says that the next record is there; what it stands on is the first one, whole.
    shared[HEAD] = (48).to_bytes(8, sys.byteorder)

    assert ring.read() is None


WRITER = """
import mmap, sys, time
import numpy as np
from fluxvla_core.robot.process.ring import Ring

memory = memoryview(mmap.mmap(int(sys.argv[1]), 0))
ring, rng = Ring(memory), np.random.default_rng(7)
tried = 0
for number in range(int(sys.argv[2])):
    record = number.to_bytes(4, "little") * int(rng.integers(1, 60))
    while not ring.write(record):
        tried += 1
        time.sleep(0)
assert ring.dropped == tried
"""


def test_two_processes_and_many_messages_of_random_sizes():
    count = 100_000
    descriptor = os.memfd_create("ring")
    os.ftruncate(descriptor, POSITIONS + 1500)
    ring = Ring(memoryview(mmap.mmap(descriptor, 0)))
    command = [sys.executable, "-c", WRITER, str(descriptor), str(count)]
    rng, number, until = np.random.default_rng(7), 0, time.monotonic() + 90
    with subprocess.Popen(command, pass_fds=(descriptor,)) as writer:
        while number < count and time.monotonic() < until:
            found = ring.read()
            if found is None:
                assert writer.poll() in (None, 0)
                time.sleep(0)
                continue
            assert found == number.to_bytes(4, "little") * int(rng.integers(1, 60))
            number += 1
    os.close(descriptor)
    assert number == count
    assert writer.returncode == 0
    assert ring.read() is None
