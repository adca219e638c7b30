"""Pictures that stand in the tables themselves, a file's bytes in every row: LeRobot's ``image``.

A row's value is ``{"bytes": PNG or JPEG, "path": its name}``, as the Image feature of Hugging
Face's ``datasets`` stores it. Rows are read by row group, of which the last one is kept.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.data.optional import arrow, opencv, parquet
from fluxvla_core.errors import DataError

Image = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class ImageColumn:
    """The pictures of camera ``key`` in the parquet file ``path``, one a row."""

    path: Path
    key: str

    def __str__(self) -> str:
        return f"{self.path}: {self.key}"


class StoredImages:
    """An :class:`ImageColumn`, open; a picture's time is its row.

    Raises:
        DataError: the file cannot be read, or the column holds no pictures.
    """

    def __init__(self, column: ImageColumn) -> None:
        pa = arrow()

        self.path = column
        try:
            self._file: Any = parquet().ParquetFile(column.path)
        except (pa.ArrowException, OSError) as error:
            raise DataError(f"{column.path}: cannot be read as parquet ({error})") from error
        schema = self._file.schema_arrow
        kind = schema.field(column.key).type if column.key in schema.names else pa.null()
        if not pa.types.is_struct(kind) or kind.get_field_index("bytes") < 0:
            self.close()
            raise DataError(f"{column} holds {kind}, not the bytes of pictures")
        about = self._file.metadata
        sizes = [about.row_group(i).num_rows for i in range(about.num_row_groups)]
        self._ends = np.cumsum(sizes)
        self._group = -1
        self._rows: Any = None

    def read(self, time: float) -> Image:
        """The picture of row ``time``, ``(height, width, 3)`` uint8 RGB.

        Raises:
            DataError: there is none, or it cannot be decoded.
        """
        row = round(time)
        data = self._bytes(row)
        if data is None:
            raise DataError(
                f"{self.path}: row {row} holds no picture, at most the name of one",
                cause="the pictures were left in files of their own when this was written",
            )
        cv2 = opencv()
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data else None
        if image is None:
            raise DataError(f"{self.path}: the picture of row {row} cannot be decoded")
        out: Image = cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
        return out

    def close(self) -> None:
        self._rows = None
        self._file.close()

    def _bytes(self, row: int) -> bytes | None:
        group = int(np.searchsorted(self._ends, row, side="right"))
        if group != self._group:
            self._rows, self._group = self._read_group(group), group
        first = int(self._ends[group]) - len(self._rows)
        found: bytes | None = self._rows[row - first].as_py()
        return found

    def _read_group(self, group: int) -> Any:
        try:
            table = self._file.read_row_group(group, columns=[self.path.key], use_threads=False)
        except (arrow().ArrowException, OSError) as error:
            raise DataError(
                f"{self.path}: cannot be read ({str(error).splitlines()[0]})",
                cause="the file is damaged",
                next="copy the file again from where it came from",
            ) from error
        return table[self.path.key].combine_chunks().field("bytes")
