"""Which joiner a config gets, and what it is told when it asks for one that is not there."""

from __future__ import annotations

import pytest

from fluxvla_core.control.joiners import (
    METHODS,
    LatestOnly,
    Overlap,
    RealTime,
    Synchronous,
    TemporalEnsemble,
    make_joiner,
)
from fluxvla_core.errors import ConfigError


@pytest.mark.parametrize(
    ("value", "kind"),
    [
        (None, Synchronous),
        ("synchronous", Synchronous),
        ("latest_only", LatestOnly),
        ("temporal_ensemble", TemporalEnsemble),
        ("overlap", Overlap),
        ("rtc", RealTime),
    ],
)
def test_every_method_has_a_name(value, kind):
    assert type(make_joiner(value)) is kind
    assert value is None or type(make_joiner({"method": value})) is kind


def test_only_the_synchronous_one_is_played_in_one_piece():
    assert [m for m in METHODS if not make_joiner(m).streamed] == ["synchronous"]


def test_parameters_reach_the_joiner():
    joiner = make_joiner({"method": "rtc", "max_guidance_weight": 2.5, "window": 3}, every_s=0.4)

    assert isinstance(joiner, RealTime)
    assert (joiner.max_guidance_weight, joiner.every_s) == (2.5, 0.4)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("latest-only", "method 'latest-only'; did you mean 'latest_only'?"),
        ("best", "method 'best'; there are synchronous, latest_only, temporal_"),
        ({"fade_s": 1}, "method None; there are"),
        (
            {"method": "overlap", "fades": 1},
            "overlap takes no 'fades'; did you mean 'fade_s'?",
        ),
        (
            {"method": "synchronous", "fade_s": 1},
            "synchronous takes no 'fade_s'; it takes nothing",
        ),
        (
            {"method": "latest_only", "every_s": 1},
            "latest_only takes no 'every_s'; it takes nothing",
        ),
        ({"method": "overlap", "fade_s": 0}, "overlap: fade_s must be a positive"),
        ({"method": "overlap", "fade_s": "x"}, "overlap: must be real number"),
        (
            {"method": "temporal_ensemble", "coefficient": float("nan")},
            "temporal_ensemble: coefficient must be a number, got nan",
        ),
        (
            {"method": "rtc", "schedule": "expo"},
            "schedule 'expo' is unknown; choose one of exp, linear, ones, zeros; "
            "did you mean 'exp'?",
        ),
        (
            {"method": "rtc", "schedule": "?"},
            "schedule '?' is unknown; choose one of exp, linear, ones, zeros",
        ),
        ({"method": "rtc", "max_guidance_weight": 0}, "max_guidance_weight must be positive"),
        ({"method": "rtc", "window": 0}, "rtc: window must be at least 1, got 0"),
    ],
)
def test_what_is_not_there_is_named_with_the_nearest(value, message):
    with pytest.raises(ConfigError) as caught:
        make_joiner(value)
    assert message in str(caught.value)
