from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from fluxvla_core import build_collator_from_cfg
from fluxvla_core.data.loader import DictCollator
from fluxvla_core.errors import DataError

arrays = hnp.arrays(
    st.sampled_from([np.float32, np.int64, np.uint8, np.bool_]),
    hnp.array_shapes(min_dims=0, max_dims=3, max_side=4),
)


@given(array=arrays, count=st.integers(1, 5))
def test_arrays_are_stacked_with_their_dtype_and_values(array, count):
    batch = DictCollator(["x"])([{"x": array} for _ in range(count)])
    assert batch["x"].shape == (count, *array.shape)
    assert batch["x"].numpy().dtype == array.dtype
    for row in batch["x"].numpy():
        np.testing.assert_array_equal(row, array)


def test_tensors_are_stacked_metas_listed_and_absent_keys_left_out():
    collate = build_collator_from_cfg(
        {"type": "DictCollator", "keys": ["a", "i", "absent"], "meta_keys": ["task", "stats"]}
    )
    batch = collate(
        [
            {"a": torch.ones(2), "i": np.int64(3), "task": "x"},
            {"a": torch.zeros(2), "i": np.int64(4), "task": "y"},
        ]
    )
    assert set(batch) == {"a", "i", "task"}
    assert batch["a"].tolist() == [[1, 1], [0, 0]]
    assert batch["i"].tolist() == [3, 4]
    assert batch["task"] == ["x", "y"]


def test_a_key_in_neither_list_is_refused_with_what_to_do():
    with pytest.raises(DataError) as caught:
        DictCollator(["a"])([{"a": np.zeros(1), "info": {}}])
    assert "sample key 'info' is in neither keys nor meta_keys of the collator" in str(caught.value)
    assert "add 'info' to the collator's keys (to stack) or meta_keys" in str(caught.value)


def test_a_value_that_cannot_be_stacked_is_refused():
    with pytest.raises(DataError, match="'a' is listed in keys, but str cannot be stacked"):
        DictCollator(["a"])([{"a": "text"}])


def test_unequal_shapes_are_named():
    with pytest.raises(DataError, match=r"'a' cannot be stacked: shapes \(2,\), \(3,\)"):
        DictCollator(["a"])([{"a": np.zeros(2)}, {"a": np.zeros(3)}])
    with pytest.raises(DataError, match=r"'a' cannot be stacked: shapes \(2,\), \(3,\)"):
        DictCollator(["a"])([{"a": torch.zeros(2)}, {"a": torch.zeros(3)}])


def test_a_key_that_one_sample_lacks_is_named():
    with pytest.raises(
        DataError, match=r"'a' is missing in one sample of the batch; it has \['b'\]"
    ):
        DictCollator(["a", "b"])([{"a": np.zeros(2)}, {"b": np.zeros(2)}])


@pytest.mark.parametrize("turned", [False, True])
def test_a_key_that_only_some_samples_have_is_an_error_whichever_comes_first(turned):
    """The batch began with one without ``b``: it had none, and there was no error."""
    samples = [{"a": np.zeros(2)}, {"a": np.zeros(2), "b": np.zeros(2)}]
    with pytest.raises(DataError, match=r"'b' is missing in one sample .* it has \['a'\]"):
        DictCollator(["a", "b"])(samples[::-1] if turned else samples)


def test_no_samples():
    with pytest.raises(DataError, match="there are no samples to make a batch of"):
        DictCollator(["a"])([])


def test_images_that_no_transform_has_joined_are_told():
    sample = {"images": [np.zeros((3, 4, 6), np.uint8), np.zeros((3, 8, 6), np.uint8)]}
    with pytest.raises(DataError, match=r"still a list, of shapes \(3, 4, 6\), \(3, 8, 6\)"):
        DictCollator(["images"])([sample])
