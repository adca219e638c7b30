"""Seeds, and the state of all random generators."""

from __future__ import annotations

import random

import numpy as np
import torch

from fluxvla_core.training.state import rank_seed, rng_state, seed_all, set_rng_state


def draw():
    return (
        [random.random() for _ in range(3)],
        random.gauss(0, 1),
        np.random.rand(3).tolist(),
        np.random.randn(),
        torch.rand(3).tolist(),
        torch.randn(5).tolist(),
    )


def test_every_generator_goes_on_where_it_was():
    seed_all(7)
    draw()  # leaves half a pair of normal numbers behind in python and numpy
    state = {key: tensor.clone() for key, tensor in rng_state().items()}
    expected = [draw(), draw()]
    seed_all(8)
    set_rng_state(state)
    assert [draw(), draw()] == expected


def test_the_state_has_one_size():
    """All ranks' states are gathered in one operation."""
    seed_all(1)
    first = {key: tensor.shape for key, tensor in rng_state().items()}
    draw()
    assert {key: tensor.shape for key, tensor in rng_state().items()} == first


def test_seeding_repeats():
    seed_all(2**63 - 1)
    once = draw()
    seed_all(2**63 - 1)
    assert draw() == once


def test_no_two_ranks_or_steps_share_a_seed():
    """Equal seeds on every rank mean equal dropout and noise on every rank."""
    seeds = {rank_seed(42, rank, step) for rank in range(64) for step in (0, 1, 500)}
    assert len(seeds) == 64 * 3
    assert all(0 <= seed < 2**63 for seed in seeds)
    assert rank_seed(42, 3, 5) == rank_seed(42, 3, 5)
