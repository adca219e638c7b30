"""Which samples come together when only a few episodes are mixed at a time."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fluxvla_core.data.dataset import ParquetDataset
from fluxvla_core.data.sampler import EpisodeShards, StepPlan, StepSampler, epoch_order
from fluxvla_core.errors import ConfigError

lengths = st.lists(st.integers(1, 9), min_size=1, max_size=12)


@given(lengths, st.integers(2, 5), st.integers(0, 3))
def test_every_sample_once_and_few_episodes_at_a_time(episodes, together, epoch):
    ends = np.cumsum(episodes)
    order = epoch_order(int(ends[-1]), 42, epoch, EpisodeShards(ends, together))
    assert sorted(order) == list(range(ends[-1]))
    of_episode = np.searchsorted(ends, order, side="right")
    # Cut where the first sample of an episode that has not been seen in this shard comes: within
    # a shard there are at most so many, and no episode is in two shards.
    first = {e: int(np.argmax(of_episode == e)) for e in set(of_episode.tolist())}
    last = {e: len(order) - 1 - int(np.argmax(of_episode[::-1] == e)) for e in first}
    for position in range(len(order)):
        under_way = [e for e in first if first[e] <= position <= last[e]]
        assert len(under_way) <= together


def test_epochs_mix_other_episodes_and_other_samples():
    shards = EpisodeShards(np.arange(1, 101) * 10, 4)
    first, second = (epoch_order(1000, 42, epoch, shards) for epoch in (0, 1))
    np.testing.assert_array_equal(first, epoch_order(1000, 42, 0, shards))
    pairs = [
        {frozenset(np.unique(o[i : i + 40] // 10)) for i in range(0, 1000, 40)}
        for o in (first, second)
    ]
    assert not pairs[0] & pairs[1]


def test_all_episodes_together_mix_everything():
    shards = EpisodeShards(np.array([500, 1000]), 2)
    order = epoch_order(1000, 42, 0, shards)
    assert 200 < np.count_nonzero(order[:500] < 500) < 300


def test_ranks_share_the_order_out():
    shards = EpisodeShards(np.array([5, 11, 16, 24]), 2)
    whole = StepPlan(24, 4, shards=shards).order(0)
    plan = StepPlan(24, 2, world=2, shards=shards)
    ranks = [StepSampler(plan, rank).epoch(0) for rank in range(2)]
    joined = [k.index for both in zip(*ranks, strict=True) for keys in both for k in keys]
    assert joined == whole.tolist()


def test_one_at_a_time_is_no_mixing():
    with pytest.raises(ConfigError, match="shuffle_episodes must be at least 2, got 1"):
        EpisodeShards(np.array([5]), 1)


def test_a_dataset_says_where_its_episodes_end(shared, takes):
    lengths = [len(take.state) for take in takes]
    dataset = ParquetDataset(str(shared), [], [])
    assert dataset.episode_ends.tolist() == np.cumsum(lengths).tolist()
    twice = ParquetDataset([str(shared)] * 2, [], [], episodes=[[0, 2], [1]])
    assert twice.episode_ends.tolist() == np.cumsum([lengths[0], lengths[2], lengths[1]]).tolist()
    assert twice.episode_ends[-1] == len(twice)
