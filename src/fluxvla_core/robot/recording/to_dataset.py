"""Recorded episodes as a LeRobot v3.0 dataset, to train on what a robot did.

A row is what was known at its time: the newest state and images that had arrived. Its action is
the command that the robot had one row later, where the joints were to be by then: demonstrations
(``fluxvla collect``) are recorded so, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.runner import Reporter, SilentReporter
from fluxvla_core.data.writer import LeRobotWriter
from fluxvla_core.errors import DataError
from fluxvla_core.robot.recording.recorded import (
    ROUNDING_S,
    RecordedEpisode,
    check_same_embodiment,
    find_recordings,
    newest_at,
    open_recording,
)
from fluxvla_core.spec import EmbodimentSpec

Array = npt.NDArray[np.float64]


def recordings_to_dataset(
    sources: Sequence[str | Path],
    out: str | Path,
    fps: float | None = None,
    successes: bool = False,
    reporter: Reporter | None = None,
) -> Path:
    """Write the dataset ``out``: one episode for each recording, in their order.

    Only what was done for the task is in it, not the way to the start pose and the end's hold.

    Args:
        sources: episodes' folders, MCAP files, or folders of them.
        fps: rows a second; the robot's rate by default.
        successes: leave out those that are not known to have succeeded.

    Returns:
        ``out``.

    Raises:
        DataError: a source holds no recording, nothing is left to write, a recording has no
            images, ``fps`` is above the robot's rate, or ``out`` exists.
        SpecMismatch: two recordings are of different robots.
        RunFailed: rosbags is missing, or the disk is full.
    """
    say = reporter or SilentReporter()
    chosen = _choose([p for source in sources for p in find_recordings(source)], successes, say)
    spec = _with_cameras(chosen)
    rate = _checked_rate(fps, spec)
    frames = 0
    with LeRobotWriter(out, rate, spec) as writer:
        for number, recorded in enumerate(chosen, start=1):
            frames += _write(writer, spec.camera_names, recorded, rate, say)
            say.progress("recordings", number, len(chosen), frames=frames)
    return Path(out)


def row_times(recorded: RecordedEpisode, fps: float) -> Array:
    """``(N,)`` times of the rows: from the task's first observation, as long as it was commanded.

    The next row's time is not later than the last command's, so that every row has an action.
    """
    ends, _ = recorded.commands("run")
    if not len(ends):
        return np.zeros(0)
    # A command's time is when it was done; the observation that led to the first one came before.
    first = max((e["t"] for e in recorded.of("observation") if e["t"] < ends[0]), default=ends[0])
    count = int(np.floor((ends[-1] - first) * fps + ROUNDING_S))
    times: Array = first + np.arange(count) / fps
    return times


def _choose(paths: Sequence[Path], successes: bool, say: Reporter) -> list[RecordedEpisode]:
    """The recordings that can be used; the others are reported."""
    found, failed = [], 0
    for path in paths:
        recorded = open_recording(path)
        if successes and recorded.success is not True:
            failed += 1
        elif not len(recorded.commands("run")[0]):
            say.warn(f"{path}: nothing was done in it; left out")
        else:
            found.append(recorded)
    if failed:
        say.info(f"{failed} of {len(paths)} recordings are not known to have succeeded; left out")
    if not found:
        raise DataError(f"of {len(paths)} recordings none is left to make a dataset of")
    return found


def _with_cameras(recordings: Sequence[RecordedEpisode]) -> EmbodimentSpec:
    """The robot of all recordings, with the cameras that all of them have images of."""
    spec = check_same_embodiment(recordings)
    kept = tuple(c for c in spec.cameras if all(c.name in r.images for r in recordings))
    if spec.cameras and not kept:
        bare = next(r for r in recordings if not r.images)
        raise DataError(
            "this episode has no images",
            where=str(bare.path),
            cause="it was run without --record",
            next="record again with fluxvla run … --record DIR",
        )
    return replace(spec, cameras=kept)


def _checked_rate(fps: float | None, spec: EmbodimentSpec) -> float:
    rate = spec.rate_hz if fps is None else fps
    if not 0 < rate <= spec.rate_hz:
        raise DataError(
            f"--fps {rate:g}: {spec.name} was commanded {spec.rate_hz:g} times a second; "
            "there is nothing to put between its commands"
        )
    return rate


def _write(
    writer: LeRobotWriter,
    cameras: Sequence[str],
    recorded: RecordedEpisode,
    fps: float,
    say: Reporter,
) -> int:
    """Add one episode; how many rows it has."""
    times = row_times(recorded, fps)
    if not len(times):
        raise DataError(f"the task took less than one row of {fps:g} Hz", where=str(recorded.path))
    state_times, states = recorded.states()
    command_times, commands = recorded.commands("run")
    at = newest_at(state_times, times)
    then = newest_at(command_times, times + 1.0 / fps)
    shown = _newest_images(recorded, cameras, times, fps, say)
    for row in range(len(times)):
        images = {name: recorded.images[name].read(index[row]) for name, index in shown.items()}
        writer.add_frame(images, states[at[row]], commands[then[row]], recorded.instruction)
    writer.save_episode()
    return len(times)


def _newest_images(
    recorded: RecordedEpisode, cameras: Sequence[str], times: Array, fps: float, say: Reporter
) -> dict[str, npt.NDArray[np.intp]]:
    """Camera -> which of its images is the newest at each of ``times``; warns of sparse ones."""
    found = {}
    for name in cameras:
        index = newest_at(np.array(recorded.images[name].times), times)
        found[name] = index
        fresh = len(np.unique(index))
        if fresh < 0.75 * len(times):
            say.warn(
                f"{recorded.path}: {len(times)} rows show {fresh} images of {name}; "
                f"--fps {fps * fresh / len(times):.2g} would show each once"
            )
    return found
