from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from fluxvla_core.data.statistics import (
    QUANTILES,
    as_lists,
    column_statistics,
    histogram_statistics,
    image_histogram,
    joined_statistics,
    moments,
)

rows = hnp.arrays(
    np.float32,
    st.tuples(st.integers(1, 50), st.integers(1, 4)),
    elements=st.floats(-1000, 1000, width=32),
)
images = hnp.arrays(np.uint8, st.tuples(st.integers(1, 9), st.integers(1, 9), st.just(3)))


@given(data=rows, chunk=st.integers(1, 20))
def test_columns_match_numpy_whatever_the_chunks(data, chunk):
    stats = column_statistics(data, chunk=chunk)
    wide = data.astype(np.float64)
    np.testing.assert_allclose(stats["mean"], wide.mean(0), rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(stats["std"], wide.std(0), rtol=1e-9, atol=1e-7)
    np.testing.assert_array_equal(stats["min"], wide.min(0))
    np.testing.assert_array_equal(stats["max"], wide.max(0))
    for name, level in QUANTILES.items():
        np.testing.assert_array_equal(stats[name], np.quantile(wide, level, axis=0))
    assert stats["count"].tolist() == [len(data)]


@given(data=rows, chunk=st.integers(1, 20), cuts=st.lists(st.integers(0, 50)))
def test_parts_give_what_all_rows_give_to_the_last_bit(data, chunk, cuts):
    parts = np.split(data, sorted(min(cut, len(data)) for cut in cuts))
    found = joined_statistics(lambda dims: (part[:, dims] for part in parts), chunk)
    for name, expected in column_statistics(data, chunk).items():
        np.testing.assert_array_equal(found[name], expected)
        assert found[name].dtype == expected.dtype


def test_merged_std_is_that_of_all_rows_in_any_number_of_dimensions():
    """Flaw D1: a merged std that is sqrt(D) too small."""
    data = np.random.default_rng(0).normal(3, 2, (1000, 14))
    total = moments([data[:100], data[100:900], data[900:]])
    np.testing.assert_allclose(total.std, data.std(0), rtol=1e-12)
    assert total.std.shape == (14,)


def test_a_large_offset_does_not_eat_the_variance():
    data = (np.random.default_rng(0).normal(0, 1e-3, (10000, 1)) + 1e6).astype(np.float64)
    np.testing.assert_allclose(column_statistics(data, 100)["std"], data.std(0), rtol=1e-9)


@settings(max_examples=40)
@given(first=images, second=images)
def test_pixels_match_numpy_on_all_pixels_together(first, second):
    stats = histogram_statistics(image_histogram(first) + image_histogram(second), frames=2)
    pixels = np.concatenate([first.reshape(-1, 3), second.reshape(-1, 3)]).astype(np.float64) / 255
    for name, expected in {
        "mean": pixels.mean(0),
        "std": pixels.std(0),
        "min": pixels.min(0),
        "max": pixels.max(0),
        **{name: np.quantile(pixels, level, axis=0) for name, level in QUANTILES.items()},
    }.items():
        assert stats[name].shape == (3, 1, 1)
        np.testing.assert_allclose(stats[name].ravel(), expected, atol=1e-12)
    assert stats["count"].tolist() == [2]


def test_no_rows_have_no_statistics():
    with pytest.raises(ValueError, match="statistics of no rows"):
        moments([np.zeros((0, 3))])


def test_lists_are_plain_json():
    assert as_lists({"min": np.array([1.5]), "count": np.array([3])}) == {
        "min": [1.5],
        "count": [3],
    }
