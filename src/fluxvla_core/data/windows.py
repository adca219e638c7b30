"""Action windows: one slice of a column each, masked and held at the episode's end."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.data.recording import Recorded
from fluxvla_core.data.statistics import Stats, as_lists, column_statistics, joined_statistics

Floats = npt.NDArray[np.float32]


def window(actions: Floats, first: int, end: int, size: int) -> tuple[Floats, Floats]:
    """``size`` rows of ``actions`` ``(N, D)`` from ``first`` on, and which of them are there.

    Rows from ``end`` on are beyond the episode: the last one is repeated, its mask is 0.

    Returns:
        ``(size, D)`` and ``(size,)`` float32, both fresh; ``first`` is below ``end``.
    """
    there = min(size, end - first)
    chunk = np.empty((size, actions.shape[1]), np.float32)
    chunk[:there] = actions[first : first + there]
    chunk[there:] = actions[first + there - 1]
    mask = np.zeros(size, np.float32)
    mask[:there] = 1
    return chunk, mask


def differences(recorded: Recorded) -> Recorded:
    """Actions as the difference to the frame before, 0 at an episode's first frame."""
    actions = np.zeros_like(recorded.actions)
    actions[1:] = np.diff(recorded.actions, axis=0)
    actions[recorded.meta.episodes.first_row] = 0
    return replace(recorded, actions=actions)


def action_statistics(
    recordings: Sequence[Recorded],
    size: int,
    first_action: int,
    relative: npt.NDArray[np.bool_] | None,
    per_step: bool,
) -> dict[str, Any]:
    """Statistics of the actions that samples show, as JSON values.

    Args:
        size, first_action: of the window.
        relative: ``(D,)``; where True, actions are counted from the state at the window's frame.
        per_step: give ``(size, D)`` statistics, one row for each step of the window.

    Plain actions are counted once a frame of the chosen episodes; relative or per-step ones once
    for each window that they occur in.
    """
    if relative is None and not per_step:
        rows = np.concatenate([r.actions[r.chosen] for r in recordings])
        return as_lists(column_statistics(rows))
    if per_step:
        # The last steps of a window longer than every episode occur nowhere.
        each: list[Stats] = []
        for j in range(size):
            rows = _step(recordings, first_action + j, relative, slice(None))
            each.append(column_statistics(rows) if len(rows) else each[0])
        stats = {name: np.stack([s[name] for s in each]) for name in each[0]}
    else:
        stats = joined_statistics(
            lambda dims: (_step(recordings, first_action + j, relative, dims) for j in range(size))
        )
    found = as_lists(stats)
    if relative is not None:
        found["relative"] = relative.astype(int).tolist()
    return found


def _step(
    recordings: Sequence[Recorded],
    ahead: int,
    relative: npt.NDArray[np.bool_] | None,
    dims: slice,
) -> Floats:
    """Actions ``ahead`` rows after each usable one, where they are within the episode."""
    parts = []
    for recorded in recordings:
        rows = recorded.rows[recorded.rows + ahead < recorded.end[recorded.rows]]
        actions = recorded.actions[:, dims][rows + ahead]
        if relative is not None:
            actions = actions - recorded.states[:, : len(relative)][:, dims][rows] * relative[dims]
        parts.append(actions)
    return np.concatenate(parts)
