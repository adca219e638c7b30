"""Seconds of the parts of an answer, taken without waiting for the device between them."""

from __future__ import annotations

import time
from typing import Any, Protocol


class Clock(Protocol):
    """Notes the ends of parts."""

    def mark(self, part: str) -> None:
        """``part`` ends here, where the next one begins."""

    def seconds(self) -> dict[str, float]:
        """Part -> seconds; once the device has done all that it was given."""


class HostClock:
    """Clock of a device that has done an operation when the call returns."""

    def __init__(self) -> None:
        self._last = time.perf_counter()
        self._seconds: dict[str, float] = {}

    def mark(self, part: str) -> None:
        now = time.perf_counter()
        self._seconds[part] = now - self._last
        self._last = now

    def seconds(self) -> dict[str, float]:
        return dict(self._seconds)


class CudaClock:
    """Clock of a GPU, by CUDA events: a part that waits for the host to launch operations takes as
    long as that does."""

    def __init__(self) -> None:
        self._marks: list[tuple[str, Any]] = [("", _event())]

    def mark(self, part: str) -> None:
        self._marks.append((part, _event()))

    def seconds(self) -> dict[str, float]:
        pairs = zip(self._marks, self._marks[1:], strict=False)
        return {part: begun.elapsed_time(ended) / 1e3 for (_, begun), (part, ended) in pairs}


def clock_of(device: str) -> Clock:
    """A clock that starts now, for ``device``."""
    import torch

    return CudaClock() if torch.device(device).type == "cuda" else HostClock()


def _event() -> Any:
    import torch

    event = torch.cuda.Event(enable_timing=True)  # type: ignore[no-untyped-call]
    event.record()
    return event
