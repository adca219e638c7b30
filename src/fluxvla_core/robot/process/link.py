"""``Link``: one end of the memory that the main process and the control process share.

Two rings of messages and two times. Each process stores the time at which it last ran; the other
one sees from it that a process was stopped, killed, or kept from running.
"""

from __future__ import annotations

import mmap
import os
import struct
import threading
import time
import zlib
from collections import deque
from collections.abc import Sequence
from typing import Any

from fluxvla_core.robot.process.messages import Array, Message, decode, encode

TO_CONTROL_BYTES = 1024 * 1024
"""Room for chunks and orders."""
TO_MAIN_BYTES = 1024 * 1024
"""Room for what happens: half a minute of commands."""
_TIMES = 64
SIZE = _TIMES + TO_CONTROL_BYTES + TO_MAIN_BYTES
# At the beginning of a ring: bytes ever written, bytes ever read, messages dropped.
_HEAD, _TAIL, _DROPPED = 0, 1, 2
_POSITIONS = 64
_RECORD = struct.Struct("<II")
_ALIGNED = 8


def make_memory() -> int:
    """Memory for both ends, as ``allocate``; it is gone with the processes that have it."""
    return allocate("fluxvla-robot", SIZE)


def allocate(name: str, size: int) -> int:
    """A file descriptor of ``size`` bytes of memory without a file; ``name`` is for people.

    Raises:
        OSError: there is not so much memory. Pages that are missing later would crash a process.
    """
    descriptor = os.memfd_create(name)
    try:
        os.posix_fallocate(descriptor, 0, size)
    except OSError:
        os.close(descriptor)
        raise
    return descriptor


class Link:
    """One end; any thread may send, one thread receives.

    Args:
        descriptor: of ``make_memory``; remains open.
        control: whether this is the control process's end.
    """

    def __init__(self, descriptor: int, control: bool) -> None:
        memory = memoryview(mmap.mmap(descriptor, SIZE))
        self._times = memory[:_TIMES].cast("Q")
        middle = _TIMES + TO_CONTROL_BYTES
        rings = Ring(memory[_TIMES:middle]), Ring(memory[middle:])
        self._in, self._out = rings if control else rings[::-1]
        self._own, self._other = (0, 1) if control else (1, 0)
        self._lock = threading.Lock()
        self._waiting: deque[bytes] = deque()

    def try_send(self, kind: str, arrays: Sequence[Array] = (), **fields: Any) -> bool:
        """Send a message, or drop it if there is no room for it; whether it was sent."""
        self.mark_alive()
        data = encode(Message(kind, fields, arrays))
        with self._lock:
            return self._out.write(data)

    def send(self, kind: str, arrays: Sequence[Array] = (), **fields: Any) -> None:
        """Send a message that must arrive; if there is no room for it, ``flush`` sends it later.

        Returns at once in either case. Messages of ``send`` arrive in their order.
        """
        self.mark_alive()
        with self._lock:
            self._waiting.append(encode(Message(kind, fields, arrays)))
        self.flush()

    def flush(self) -> None:
        """Send the messages that wait for room, as far as there is room now."""
        with self._lock:
            while self._waiting and self._out.fits(self._waiting[0]):
                self._out.write(self._waiting.popleft())

    def receive(self) -> Message | None:
        """The oldest message that came; None if there is none."""
        data = self._in.read()
        return None if data is None else decode(data)

    @property
    def lost(self) -> int:
        """How many messages of the other end's ``try_send`` were dropped."""
        return self._in.dropped

    @property
    def read_by_other(self) -> bool:
        """Whether the other end took all that was sent to it."""
        return self._out.empty and not self._waiting

    def mark_alive(self) -> None:
        """Store the time: this process runs."""
        self._times[self._own] = time.monotonic_ns()

    def silent_s(self) -> float:
        """How many seconds the other process has not run; 0 before it ever did."""
        last = self._times[self._other]
        return (time.monotonic_ns() - last) * 1e-9 if last else 0.0


class Ring:
    """Messages from one process to another through shared memory, without ever blocking.

    One process writes and one reads. Each record is preceded by its length and a CRC-32 of its
    position and itself, and the writer's position is stored after the record: a reader never takes
    a record that is not complete, nor an earlier one that was in the same place, whatever the order
    is in which its processor sees the stores. What finds no room is dropped and counted.

    Args:
        memory: shared by both processes and zero at first; 64 bytes of it hold the positions.
    """

    def __init__(self, memory: memoryview) -> None:
        # Of the machine's own word size: each is read and written in one piece.
        self._positions = memory[:_POSITIONS].cast("Q")
        self._data = memory[_POSITIONS:]
        self._size = len(self._data) // _ALIGNED * _ALIGNED

    @property
    def dropped(self) -> int:
        """How many messages found no room."""
        return self._positions[_DROPPED]

    @property
    def empty(self) -> bool:
        """Whether everything that was written was read."""
        return self._positions[_HEAD] == self._positions[_TAIL]

    def fits(self, message: bytes) -> bool:
        """Whether there is room for a message now."""
        positions = self._positions
        return _stored(len(message)) <= self._size - (positions[_HEAD] - positions[_TAIL])

    def write(self, message: bytes) -> bool:
        """Append a message; False if there is no room for it.

        Raises:
            ValueError: it is empty.
        """
        if not message:
            raise ValueError("an empty message looks like memory that was never written")
        positions = self._positions
        head = positions[_HEAD]
        needed = _stored(len(message))
        if needed > self._size - (head - positions[_TAIL]):
            positions[_DROPPED] += 1
            return False
        self._put(head, _RECORD.pack(len(message), _checksum(head, message)) + message)
        positions[_HEAD] = head + needed
        return True

    def read(self) -> bytes | None:
        """The oldest message; None if there is none yet."""
        positions = self._positions
        tail = positions[_TAIL]
        written = positions[_HEAD] - tail
        if not written:
            return None
        length, checksum = _RECORD.unpack(self._get(tail, _RECORD.size))
        if not 0 < length <= written - _RECORD.size:
            return None
        message = self._get(tail + _RECORD.size, length)
        if _checksum(tail, message) != checksum:
            return None
        positions[_TAIL] = tail + _stored(length)
        return message

    def _put(self, position: int, data: bytes) -> None:
        start = position % self._size
        first = min(len(data), self._size - start)
        self._data[start : start + first] = data[:first]
        self._data[: len(data) - first] = data[first:]

    def _get(self, position: int, length: int) -> bytes:
        start = position % self._size
        first = min(length, self._size - start)
        return bytes(self._data[start : start + first]) + bytes(self._data[: length - first])


def _stored(length: int) -> int:
    """Bytes that a message of ``length`` takes: records begin at multiples of 8."""
    return -(-(_RECORD.size + length) // _ALIGNED) * _ALIGNED


def _checksum(position: int, message: bytes) -> int:
    # Of two positions the seeds differ in all their bytes: a record of before that differs from the
    # new one in a byte has another checksum.
    return zlib.crc32(message, zlib.crc32(position.to_bytes(8, "little")))
