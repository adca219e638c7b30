"""Ranges, ticks and how numbers are written."""

from __future__ import annotations

import math

import pytest
from fluxvla_report.svg import Axis, axis, duration, round_step, short
from hypothesis import given
from hypothesis import strategies as st

numbers = st.floats(-1e6, 1e6).map(lambda v: round(v, 6))


@given(st.lists(numbers, min_size=1, max_size=30), st.integers(2, 9))
def test_a_linear_axis_holds_all_values_between_its_end_ticks(
    values: list[float], count: int
) -> None:
    found = axis(values, count=count)
    assert found.ticks[0] == found.low < found.high == found.ticks[-1]
    slack = 1e-6 * (found.high - found.low)
    assert found.low - slack <= min(values)
    assert max(values) <= found.high + slack
    assert len(found.ticks) <= count + 2


@given(st.lists(st.floats(1e-6, 1e6), min_size=1, max_size=30))
def test_a_log_axis_holds_all_values(values: list[float]) -> None:
    found = axis(values, log=True)
    assert found.log
    assert 0 < found.low < found.high
    assert found.low <= min(values) * (1 + 1e-6)
    assert max(values) <= found.high * (1 + 1e-6)


def test_known_axes() -> None:
    assert axis([0, 97], count=6).ticks == (0, 20, 40, 60, 80, 100)
    assert axis([0.03, 2.0], log=True).ticks == pytest.approx((0.02, 0.05, 0.1, 0.2, 0.5, 1, 2))
    assert axis([3.0, 3.0]).low < 3.0 < axis([3.0, 3.0]).high
    assert axis([0.0]).ticks[0] == -1.0


def test_a_tight_axis_ends_at_the_values() -> None:
    found = axis([1, 97], count=6, tight=True)
    assert (found.low, found.high) == (1, 97)
    assert found.ticks == (20, 40, 60, 80)


def test_a_flat_line_is_shown_as_one() -> None:
    found = axis([0.500, 0.502], least=0.1)
    assert found.high - found.low >= 0.1
    assert axis([0.0, 3.0], least=0.1).high == 3.0


@pytest.mark.parametrize("values", [[], [math.nan, math.inf]])
def test_nothing_to_show_is_an_empty_axis(values: list[float]) -> None:
    assert axis(values) == Axis(0.0, 1.0, (0.0, 0.5, 1.0))
    assert axis([-1.0, 0.0], log=True).log is False


def test_place() -> None:
    assert Axis(0, 10, ()).place(2.5) == 0.25
    assert Axis(0, 10, ()).place(-3) == 0.0
    assert Axis(0, 10, ()).place(30) == 1.0
    assert Axis(0.01, 100, (), log=True).place(1) == pytest.approx(0.5)
    assert Axis(0.01, 100, (), log=True).place(0) == 0.0


@pytest.mark.parametrize(("rough", "step"), [(0.9, 1), (1, 1), (1.1, 2), (30, 50), (0.06, 0.1)])
def test_round_step(rough: float, step: float) -> None:
    assert round_step(rough) == pytest.approx(step)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0, "0"),
        (0.25, "0.25"),
        (1234.5, "1234"),
        (12000, "12k"),
        (2000, "2k"),
        (2.5e6, "2.5M"),
        (3e-4, "0.0003"),
        (3.2e-5, "3.2e-05"),
        (-1500, "-1.5k"),
        (math.nan, "nan"),
    ],
)
def test_short(value: float, text: str) -> None:
    assert short(value) == text


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.84, "0.8 s"),
        (41.6, "42 s"),
        (185, "3 min 05 s"),
        (7810, "2 h 10 min"),
        (59.9, "1 min 00 s"),
    ],
)
def test_duration(seconds: float, text: str) -> None:
    assert duration(seconds) == text
