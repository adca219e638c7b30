"""Where each episode of a dataset is, whichever version of the format says so."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from fluxvla_core.errors import DataError

Ints = npt.NDArray[np.int64]
FileId = tuple[int, int]


@dataclass(frozen=True)
class VideoPlaces:
    """Where each episode's video is: ``(chunk, file)`` and its start in seconds."""

    files: Sequence[FileId]
    starts: npt.NDArray[np.float64]


@dataclass(frozen=True)
class Episodes:
    """The episode table, one entry an episode; rows count over the whole dataset."""

    first_row: Ints
    end_row: Ints
    files: Sequence[FileId]
    videos: Mapping[str, VideoPlaces]

    def __len__(self) -> int:
        return len(self.first_row)

    @property
    def lengths(self) -> Ints:
        return self.end_row - self.first_row


def check_numbering(root: Path, numbers: npt.NDArray[np.int64]) -> None:
    """Refuse an episode table (sorted) that skips or repeats an episode.

    Raises:
        DataError: it does.
    """
    if not np.array_equal(numbers, np.arange(len(numbers))):
        raise DataError(f"{root}: the episode table does not number its episodes 0, 1, 2, …")
