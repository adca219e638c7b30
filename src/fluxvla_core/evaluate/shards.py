"""Which part of an evaluation this process runs, when several were started for it.

torchrun sets ``RANK`` and ``WORLD_SIZE``, a SLURM array ``SLURM_ARRAY_TASK_ID`` (with ``_MIN``,
``_COUNT``), ``srun`` ``SLURM_PROCID`` and ``SLURM_NTASKS``; an array of srun steps has both. Nobody
has to wait for anybody: each part has a ledger of its own in the same folder, and whoever finds all
episodes finished writes the results.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

from fluxvla_core.errors import UsageError

T = TypeVar("T")


@dataclass(frozen=True)
class Shard:
    """Part ``index`` of ``count``; all of it by default."""

    index: int = 0
    count: int = 1

    def of(self, items: Sequence[T]) -> list[T]:
        """Every ``count``-th item: each part has some of every task."""
        return list(items[self.index :: self.count])

    @property
    def ledger(self) -> str:
        """The name of this part's ledger."""
        if self.count == 1:
            return "episodes.jsonl"
        return f"episodes-{self.index:04d}-of-{self.count:04d}.jsonl"


def shard_of(environment: Mapping[str, str] | None = None) -> Shard:
    """The part that the process's environment variables say it is.

    Raises:
        UsageError: they make no sense.
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
