"""``Ring``: messages from one process to another through shared memory, without ever blocking.

One process writes and one reads. Each record is preceded by its length and a CRC-32 of its position
and itself, and the writer's position is stored after the record: a reader never takes a record that
is not complete, nor an earlier one that was in the same place, whatever the order is in which its
processor sees the stores. What finds no room is dropped and counted.
"""

from __future__ import annotations

import struct
import zlib

# Bytes at the beginning: how many were ever written, how many were ever read, messages dropped.
_HEAD, _TAIL, _DROPPED = 0, 1, 2
_POSITIONS = 64
_RECORD = struct.Struct("<II")
_ALIGNED = 8


class Ring:
    """A ring of messages.

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
    def largest(self) -> int:
        """Bytes of the largest message that an empty ring has room for."""
        return self._size - _RECORD.size

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
