from __future__ import annotations

import tracemalloc
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fluxvla_core.data.dataset import action_statistics, window


@given(rows=st.integers(1, 30), data=st.data(), size=st.integers(1, 12))
def test_a_window_holds_its_last_action_and_masks_what_is_not_there(rows, data, size):
    actions = np.arange(2 * rows, dtype=np.float32).reshape(rows, 2)
    actions.flags.writeable = False
    end = data.draw(st.integers(1, rows))
    begin = data.draw(st.integers(0, end - 1))
    first = data.draw(st.integers(begin - 3, end - 1))
    chunk, mask = window(actions, first, (begin, end), size)
    for j in range(size):
        assert mask[j] == (begin <= first + j < end)
        np.testing.assert_array_equal(chunk[j], actions[min(max(first + j, begin), end - 1)])
    assert chunk.dtype == mask.dtype == np.float32
    chunk[:] = -1
    assert (actions >= 0).all()


@pytest.mark.parametrize("per_step", [False, True])
def test_statistics_of_windows_do_not_hold_a_copy_for_each_step(per_step):
    """Fifty copies in float64 were 100 times the actions; one dimension of them is 100/D."""
    frames, dims, size = 20_000, 14, 50
    rng = np.random.default_rng(0)
    recorded: Any = SimpleNamespace(
        actions=rng.standard_normal((frames, dims)).astype(np.float32),
        states=rng.standard_normal((frames, dims)).astype(np.float32),
        rows=np.arange(frames),
        start=np.zeros(frames, np.int64),
        end=np.full(frames, frames),
    )
    tracemalloc.start()
    action_statistics([recorded], size, 0, np.ones(dims, np.bool_), per_step)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 30 * recorded.actions.nbytes
