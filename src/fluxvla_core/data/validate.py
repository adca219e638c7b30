"""Check a dataset down to its last frame: ``python -m fluxvla_core.data.validate DATASET``.

Opening a dataset checks its tables and the indices of its videos; this decodes every frame too,
which takes as long as watching it at a few hundred times its speed.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from fluxvla_core.data import lerobot_v3 as v3
from fluxvla_core.data.recording import Track, load_recorded
from fluxvla_core.data.video import VideoFile
from fluxvla_core.errors import EXIT_BAD_INPUT, EXIT_DONE, DataError, FluxError


def validate(root: Path, say: Callable[[str], None]) -> None:
    """Read all columns and decode all frames of the dataset below ``root``.

    Raises:
        DataError: the first thing that is wrong, with the file's name.
    """
    recorded = load_recorded(root, [], v3.STATE, v3.ACTION, 0, None)
    meta = recorded.meta
    say(f"{root}: {len(meta.episodes)} episodes, {len(recorded.rows)} frames at {meta.fps:g} Hz")
    for camera in meta.cameras:
        track = load_recorded(root, [camera], v3.STATE, v3.ACTION, 0, None).tracks[0]
        for number in range(len(track.files)):
            _decode(track, number)
        say(f"{camera}: {len(track.time)} frames in {len(track.files)} files")


def _decode(track: Track, number: int) -> None:
    video = VideoFile(track.files[number])
    try:
        for time in np.sort(track.time[track.file == number]):
            image = video.read(float(time))
            if image.shape != (track.height, track.width, 3):
                raise DataError(
                    f"{video.path}: the frame at {time:.3f} s is {image.shape[0]} x "
                    f"{image.shape[1]}, info.json says {track.height} x {track.width}"
                )
    finally:
        video.close()


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit code 0 when all is well, 2 with the finding when not."""
    given = sys.argv[1:] if arguments is None else list(arguments)
    if len(given) != 1 or given[0].startswith("-"):
        print("usage: python -m fluxvla_core.data.validate DATASET", file=sys.stderr)
        return EXIT_BAD_INPUT
    try:
        validate(Path(given[0]), print)
    except FluxError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
