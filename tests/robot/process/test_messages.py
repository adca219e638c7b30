"""Messages between the two processes: what goes in comes out, and errors keep their rule."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from fluxvla_core import errors
from fluxvla_core.control import policy_client, safety
from fluxvla_core.control.safety import RuleStop, rule_of
from fluxvla_core.errors import Faulted, FluxError, RunFailed
from fluxvla_core.robot.process.messages import (
    Kind,
    Message,
    decode,
    encode,
    error_fields,
    error_of,
)

VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=8,
)
ARRAYS = st.lists(
    arrays(
        np.float64,
        array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=4),
        elements=st.floats(),
    ),
    max_size=4,
)
FLUX_ERRORS = sorted(
    {
        value
        for module in (errors, safety, policy_client)
        for value in vars(module).values()
        if isinstance(value, type) and issubclass(value, FluxError)
    },
    key=lambda cls: cls.__name__,
)


@given(kind=st.sampled_from(Kind), fields=st.dictionaries(st.text(), VALUES), given_=ARRAYS)
def test_whatever_goes_in_comes_out(kind, fields, given_):
    found = decode(encode(Message(kind, fields, given_)))

    assert (found.kind, found.fields) == (kind, fields)
    assert len(found.arrays) == len(given_)
    for got, wanted in zip(found.arrays, given_, strict=True):
        assert got.shape == wanted.shape
        # Bytes: NaN is what it was, and minus zero, too.
        assert got.tobytes() == wanted.tobytes()


@pytest.mark.parametrize("name", ["", "a", "ab", "abc", "Ünïcødé 手 🦾", "\ud800", "\0\n"])
def test_arrays_can_be_read_as_any_other(name):
    # The header before them has any length; torch and C code take aligned numbers only.
    actions = np.arange(6.0).reshape(2, 3)

    (got,) = decode(encode(Message("answer", {"name": name}, (actions,)))).arrays

    assert got.flags.aligned
    assert not got.flags.writeable
    assert got.dtype == np.float64
    np.testing.assert_array_equal(got, actions)


def test_arrays_of_other_layouts_and_types_arrive_as_float64():
    given_ = (
        np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        np.arange(20.0)[::-3],
        np.arange(6, dtype=np.int16).reshape(3, 2).T,
        np.array([True, False]),
        np.arange(3, dtype=">f8"),
        [1, 2.5],
    )

    found = decode(encode(Message("x", {}, given_))).arrays

    for got, wanted in zip(found, given_, strict=True):
        assert got.dtype == np.float64
        np.testing.assert_array_equal(got, wanted)


def test_numbers_that_are_none_are_told():
    fields = {"values": [float("nan"), float("inf"), -float("inf")]}

    nan, inf, minus = decode(encode(Message("x", fields)))["values"]

    assert np.isnan(nan)
    assert (inf, minus) == (float("inf"), -float("inf"))


def test_an_object_is_refused_and_nothing_is_pickled():
    with pytest.raises(TypeError, match="not JSON serializable"):
        encode(Message("x", {"thing": object()}))


@pytest.mark.parametrize("cls", FLUX_ERRORS, ids=lambda cls: cls.__name__)
def test_each_error_arrives_as_itself(cls):
    error = cls("it broke: 手", where="here", cause="a reason", next="do this")

    found = error_of(json.loads(json.dumps(error_fields(error))))

    assert type(found) is cls
    assert str(found) == str(error)
    assert found.args == error.args
    assert (found.rule, found.exit_code) == (error.rule, error.exit_code)
    assert rule_of(found) == rule_of(error)


def test_an_error_without_more_to_say():
    found = error_of(error_fields(Faulted("it broke")))

    assert (found.where, found.cause, found.next) == (None, None, None)


def test_an_error_of_a_plugin_arrives_as_its_base_with_its_rule():
    class TooWarm(RuleStop):
        rule = "temperature"

    class Cooked(TooWarm):
        exit_code = 7

    found = error_of(json.loads(json.dumps(error_fields(Cooked("the elbow is at 90 C")))))

    assert type(found) is RuleStop
    assert (found.what, found.rule) == ("the elbow is at 90 C", "temperature")
    assert rule_of(found) == "temperature"
    # It is this one error's rule, not its class's.
    assert RuleStop("x").rule == "safety"


def test_a_driver_error_of_a_plugin_is_still_the_operators():
    class MotorOff(Faulted):
        pass

    found = error_of(error_fields(MotorOff("motor 3 is off")))

    assert type(found) is Faulted
    assert rule_of(found) == "operator"


@pytest.mark.parametrize(
    ("error", "what"),
    [
        (ValueError("no"), "ValueError: no"),
        (KeyError("joint"), "KeyError: 'joint'"),
        (SystemExit(3), "SystemExit: 3"),
        (RecursionError(), "RecursionError: "),
    ],
)
def test_any_other_error_is_named(error, what):
    found = error_of(error_fields(error))

    assert type(found) is RunFailed
    assert found.what == what
    assert rule_of(found) == "run"
