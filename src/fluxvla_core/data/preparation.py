"""A policy's pre- and postprocessing, tried on a blank observation before any weights are read."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from fluxvla_core.errors import CheckpointError, located

INSTRUCTION = "go"
"""As short as any."""


def try_preparation(
    prepare: Callable[[Mapping[str, Any]], Any],
    denormalize: Callable[[Mapping[str, Any]], Any],
    cameras: Mapping[str, tuple[int, int]],
    state_dim: int,
    chunk: tuple[int, int],
    where: str,
) -> None:
    """Prepare a blank observation, and scale a chunk of zeros back.

    What transforms and statistics refuse (a number of images, a width, a statistic that is not
    there) is told at once, and with the checkpoint's name, not when the robot asks the first time.

    Args:
        prepare, denormalize: of a ``LocalPolicy``.
        cameras: name -> height and width of its images.
        state_dim: numbers of a state.
        chunk: actions, and numbers of each.
        where: the checkpoint.

    Raises:
        FluxError: what they raise.
    """
    states = np.zeros(state_dim, np.float32)
    images = {name: np.zeros((*size, 3), np.uint8) for name, size in cameras.items()}
    observation = {"qpos": states, "images": images, "task_description": INSTRUCTION}
    with located(where):
        prepare(observation)
        denormalize({"action": np.zeros((1, *chunk), np.float32), "states": states})


def check_statistics(statistics: Mapping[str, Mapping[str, Any]], where: str) -> None:
    """Refuse statistics that are not finite numbers, as many in each row of an entry.

    Args:
        statistics: ``{"private": {"proprio": {"mean": [...], ...}, "action": {...}}}``.
        where: the checkpoint.

    Raises:
        CheckpointError: names the entry, the statistic, and what is wrong with it.
    """
    for entries in statistics.values():
        for key, entry in entries.items():
            rows = entry.items() if isinstance(entry, Mapping) else ()
            _check_rows(key, {n: r for n, r in rows if isinstance(r, list | tuple)}, where)


def _check_rows(key: str, rows: Mapping[str, Any], where: str) -> None:
    widths: dict[str, int] = {}
    for name, row in rows.items():
        try:
            numbers = np.asarray(row, np.float64)
        except (TypeError, ValueError):
            numbers = np.empty(0)
        wrong = numbers[~np.isfinite(numbers)]
        if not numbers.size or wrong.size:
            found = f"has {wrong[0]}" if wrong.size else f"is {str(row)[:60]}"
            raise CheckpointError(
                f"the statistics' {name!r} of {key!r} {found}; finite numbers are expected",
                where=where,
                cause="they were computed from data with gaps, or the file is damaged",
                next="take the statistics of the training's data, or compute them again",
            )
        widths[name] = int(numbers.shape[-1])
    first = next(iter(widths), "")
    other = next((name for name in widths if widths[name] != widths[first]), None)
    if other is not None:
        raise CheckpointError(
            f"the statistics of {key!r} have {widths[first]} dimensions in {first!r}, "
            f"{widths[other]} in {other!r}",
            where=where,
            cause="the file was changed, or joined of two robots'",
        )
