"""Episodes of an evaluation: their keys, and their shards.

An evaluation may be split into shards, one a process. torchrun sets ``RANK`` and ``WORLD_SIZE``, a
SLURM array ``SLURM_ARRAY_TASK_ID`` (with ``_MIN``, ``_COUNT``), ``srun`` ``SLURM_PROCID`` and
``SLURM_NTASKS``; an array of srun steps has both. No process waits for another: each shard has an
evaluation log of its own in the same folder, and whichever finds all episodes finished writes the
results.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

from fluxvla_core.errors import UsageError

T = TypeVar("T")
DONE, ERROR = "done", "error"
"""Status of a record."""
POLICY, SWAPPED, UNTRAINED = "policy", "swapped", "untrained"
"""Groups: the policy, the policy with another task's instruction, its untrained baseline."""


@dataclass(frozen=True, order=True)
class EpisodeKey:
    """Identifies an episode within one evaluation; its outcome follows from it.

    Args:
        group: which policy, with which instruction: ``policy``, ``swapped``, ``untrained``, …
        task: the task whose scene and success are meant.
        seed: seed of everything random in the episode.
    """

    group: str
    task: str
    seed: int


def episode_keys(
    groups: Sequence[tuple[str, int]], tasks: Sequence[str], episodes: int, together: bool
) -> list[EpisodeKey]:
    """Every episode of an evaluation, in the order in which they are given out.

    Args:
        groups: name and first seed of each; those of one number are side by side.
        episodes: for each task and group.
        together: task by task; otherwise in turn, so that progress shows all tasks from the start.
    """
    numbers = range(episodes)
    pairs = [(task, number) for number in numbers for task in tasks]
    if together:
        pairs = [(task, number) for task in tasks for number in numbers]
    return [
        EpisodeKey(group, task, first + number) for task, number in pairs for group, first in groups
    ]


def reason(text: str) -> str:
    """One line of an error message or a traceback: the last that is not advice."""
    lines = text.strip().splitlines()
    said = [line for line in lines if not line.startswith(("  likely cause: ", "  next: "))]
    return (said or lines)[-1].strip()


@dataclass(frozen=True)
class Shard:
    """Part ``index`` of ``count`` of an evaluation's episodes; all of them by default."""

    index: int = 0
    count: int = 1

    def of(self, items: Sequence[T]) -> list[T]:
        """Every ``count``-th item: each part has some of every task."""
        return list(items[self.index :: self.count])

    @property
    def log_name(self) -> str:
        """The file name of this part's evaluation log."""
        if self.count == 1:
            return "episodes.jsonl"
        return f"episodes-{self.index:04d}-of-{self.count:04d}.jsonl"


def shard_of(environment: Mapping[str, str] | None = None) -> Shard:
    """The shard of this process, from its environment variables.

    Raises:
        UsageError: they contradict each other.
    """
    env = os.environ if environment is None else environment
    try:
        array = _array(env)
        step = _pair(env, "RANK", "WORLD_SIZE") or _pair(env, "SLURM_PROCID", "SLURM_NTASKS")
    except ValueError as error:
        raise UsageError(f"this process cannot tell which part of the job it is: {error}") from None
    (a, n), (b, m) = array or (0, 1), step or (0, 1)
    if not (0 <= a < n and 0 <= b < m):
        raise UsageError(
            f"this process is said to be part {a} of {n} and {b} of {m}",
            cause="RANK, WORLD_SIZE or SLURM_* were changed by hand",
        )
    return Shard(a * m + b, n * m)


def _array(env: Mapping[str, str]) -> tuple[int, int] | None:
    if "SLURM_ARRAY_TASK_ID" not in env:
        return None
    if int(env.get("SLURM_ARRAY_TASK_STEP", "1")) != 1:
        raise ValueError("the SLURM array counts in steps; use --array=0-N")
    first = int(env.get("SLURM_ARRAY_TASK_MIN", "0"))
    return int(env["SLURM_ARRAY_TASK_ID"]) - first, int(env["SLURM_ARRAY_TASK_COUNT"])


def _pair(env: Mapping[str, str], index: str, count: str) -> tuple[int, int] | None:
    if index not in env or count not in env:
        return None
    return int(env[index]), int(env[count])
