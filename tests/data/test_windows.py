from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from fluxvla_core.data.windows import window


@given(rows=st.integers(1, 30), data=st.data(), size=st.integers(1, 12))
def test_a_window_holds_its_last_action_and_masks_what_is_not_there(rows, data, size):
    actions = np.arange(2 * rows, dtype=np.float32).reshape(rows, 2)
    actions.flags.writeable = False
    end = data.draw(st.integers(1, rows))
    first = data.draw(st.integers(0, end - 1))
    chunk, mask = window(actions, first, end, size)
    for j in range(size):
        assert mask[j] == (first + j < end)
        np.testing.assert_array_equal(chunk[j], actions[min(first + j, end - 1)])
    assert chunk.dtype == mask.dtype == np.float32
    chunk[:] = -1
    assert (actions >= 0).all()
