"""Parts of a job from the variables that launchers set."""

from __future__ import annotations

import pytest

from fluxvla_core.errors import UsageError
from fluxvla_core.evaluation.episodes import Shard, shard_of

ARRAY = {"SLURM_ARRAY_TASK_ID": "5", "SLURM_ARRAY_TASK_MIN": "3", "SLURM_ARRAY_TASK_COUNT": "4"}


@pytest.mark.parametrize(
    ("variables", "shard"),
    [
        ({}, Shard(0, 1)),
        ({"RANK": "1", "WORLD_SIZE": "3", "LOCAL_RANK": "1"}, Shard(1, 3)),
        ({"SLURM_PROCID": "2", "SLURM_NTASKS": "4"}, Shard(2, 4)),
        (ARRAY, Shard(2, 4)),
        ({**ARRAY, "SLURM_PROCID": "1", "SLURM_NTASKS": "2"}, Shard(5, 8)),
        # torchrun inside of srun: its own ranks count.
        ({"SLURM_PROCID": "0", "SLURM_NTASKS": "1", "RANK": "1", "WORLD_SIZE": "2"}, Shard(1, 2)),
        ({"RANK": "0"}, Shard(0, 1)),
    ],
)
def test_launchers_say_which_part_it_is(variables, shard):
    assert shard_of(variables) == shard


def test_every_episode_is_in_one_part():
    parts = [Shard(index, 3).of(range(8)) for index in range(3)]
    assert parts == [[0, 3, 6], [1, 4, 7], [2, 5]]
    assert Shard(0, 1).log_name == "episodes.jsonl"
    assert Shard(2, 3).log_name == "episodes-0002-of-0003.jsonl"


@pytest.mark.parametrize(
    ("variables", "text"),
    [
        ({"RANK": "3", "WORLD_SIZE": "3"}, "part 0 of 1 and 3 of 3"),
        ({"RANK": "x", "WORLD_SIZE": "3"}, "cannot tell which part of the job it is: invalid"),
        ({**ARRAY, "SLURM_ARRAY_TASK_STEP": "2"}, r"counts in steps; use --array=0-N"),
    ],
)
def test_what_makes_no_sense_is_refused(variables, text):
    with pytest.raises(UsageError, match=text):
        shard_of(variables)
