"""Demonstrations in parallel, written as one LeRobot v3.0 dataset.

Workers act episodes out; one process writes them, in the order of their numbers. What episode ``k``
shows must follow from ``k`` alone: then the dataset is the same for any number of workers, and a
collection that was interrupted can go on.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.reporter import Reporter
from fluxvla_core.errors import RunFailed, UsageError
from fluxvla_core.evaluate.pool import Outcome, run_jobs
from fluxvla_core.spec.embodiment import EmbodimentSpec

SETTINGS = "collection.json"


@dataclass(frozen=True)
class Recorded:
    """One episode.

    Args:
        images: camera name -> ``(N, H, W, 3)`` uint8.
        states: ``(N, S)``; actions: ``(N, D)``, in the embodiment's units.
        instruction: what was done.
        retried: how many attempts failed before.
    """

    images: Mapping[str, npt.NDArray[np.uint8]]
    states: npt.NDArray[np.float64]
    actions: npt.NDArray[np.float64]
    instruction: str
    retried: int = 0


def collect_episodes(
    out: Path,
    fps: float,
    embodiment: EmbodimentSpec,
    factory: Callable[[], Callable[[int], Recorded]],
    episodes: int,
    settings: Mapping[str, Any],
    workers: int,
    resume: bool,
    reporter: Reporter,
) -> dict[str, Any]:
    """Collect ``episodes`` episodes into the dataset ``out``.

    Args:
        out: the dataset's folder; it must not exist yet.
        fps: frames a second.
        factory: makes, in a worker process, a function from an episode's number to the episode.
        settings: what the dataset follows from, as JSON values; going on with other ones is
            refused.
        workers: processes that act, beside this one, which writes.
        resume: go on with a collection into ``out`` that was interrupted.

    Returns:
        JSON values: ``episodes``; ``collected``, ``frames`` and ``retried`` of this call;
        ``seconds``, ``frames_per_s``, ``workers``.

    Raises:
        DataError: there is a dataset already.
        UsageError: there is an interrupted collection, or it had other settings.
        RunFailed: an episode fails, workers cannot be started, or the disk is full.
    """
    from fluxvla_core.data.files import write_json
    from fluxvla_core.data.writer import LeRobotWriter, staging_of

    note = staging_of(out) / SETTINGS
    if resume:
        _check_same(note, settings)
    elif note.parent.exists():
        raise UsageError(
            f"a collection into {out} was interrupted, or is under way",
            next=f"add --resume to go on with it, or delete {note.parent}",
        )
    began, retried, frames = time.monotonic(), 0, 0
    with LeRobotWriter(out, fps, embodiment, recover=resume) as writer:
        write_json(note, dict(settings))
        kept = writer.episodes
        jobs = range(kept, episodes)
        with closing(run_jobs(factory, jobs, workers)) as outcomes:
            for number, found in _in_order(outcomes, jobs):
                for frame in range(len(found.states)):
                    pictures = {name: stack[frame] for name, stack in found.images.items()}
                    writer.add_frame(
                        pictures, found.states[frame], found.actions[frame], found.instruction
                    )
                writer.save_episode(key=number)
                retried += found.retried
                frames += len(found.states)
                pace = (number + 1 - kept) / (time.monotonic() - began)
                reporter.progress("demonstrations", number + 1, episodes, per_s=round(pace, 2))
    seconds = time.monotonic() - began
    result = {
        "episodes": episodes,
        "collected": episodes - kept,
        "frames": frames,
        "retried": retried,
        "seconds": seconds,
        "frames_per_s": frames / max(seconds, 1e-9),
        "workers": workers,
    }
    reporter.event("collected", **result)
    reporter.artifact("dataset", out)
    return result


def _in_order(outcomes: Iterator[Outcome], jobs: Sequence[int]) -> Iterator[tuple[int, Recorded]]:
    """Episodes in the order of their numbers; early ones wait."""
    early: dict[int, Recorded] = {}
    following = 0
    for outcome in outcomes:
        if outcome.error is not None:
            raise RunFailed(f"episode {jobs[outcome.index]} failed: {outcome.error}")
        early[outcome.index] = outcome.result
        while following in early:
            yield jobs[following], early.pop(following)
            following += 1


def _check_same(note: Path, settings: Mapping[str, Any]) -> None:
    if not note.exists():
        return
    before = json.loads(note.read_text(encoding="utf-8"))
    now = json.loads(json.dumps(dict(settings)))
    other = [f"{k}: {before.get(k)} / {now[k]}" for k in now if before.get(k) != now[k]]
    if other:
        raise UsageError(
            f"the interrupted collection had other settings: {'; '.join(other)}",
            next=f"use the same settings, or delete {note.parent} and begin anew",
        )
