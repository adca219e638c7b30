"""The read-only view that objects are built from."""

from __future__ import annotations

import copy
import json
from typing import Any

import pytest

from fluxvla_core.config.tree import freeze, thaw

TREE: dict[str, Any] = {"a": {"b": [1, {"c": 2}]}, "d": None}


def test_it_reads_like_what_it_was() -> None:
    frozen = freeze(TREE)
    assert frozen == TREE
    assert isinstance(frozen["a"], dict)
    assert isinstance(frozen["a"]["b"], list)
    assert json.loads(json.dumps(frozen)) == TREE
    assert {**frozen["a"]} == TREE["a"]


@pytest.mark.parametrize(
    "change",
    [
        lambda t: t.__setitem__("d", 1),
        lambda t: t["a"].update(b=1),
        lambda t: t["a"].setdefault("x", 1),
        lambda t: t["a"].pop("b"),
        lambda t: t["a"]["b"].append(1),
        lambda t: t["a"]["b"][1].clear(),
        lambda t: t["a"]["b"].__delitem__(0),
        lambda t: t["a"]["b"].sort(),
    ],
)
def test_it_refuses_changes_and_says_what_to_do(change: Any) -> None:
    frozen = freeze(TREE)
    with pytest.raises(TypeError, match=r"read-only.*work on a copy"):
        change(frozen)
    assert frozen == TREE


def _sent_to_a_worker(value: Any) -> Any:
    make, arguments = value.__reduce__()
    return make(*arguments)


@pytest.mark.parametrize("make", [copy.deepcopy, thaw, _sent_to_a_worker])
def test_copies_are_free_all_the_way_down(make: Any) -> None:
    free = make(freeze(TREE))
    free["a"]["b"][1]["c"] = 3
    free["a"]["b"].append(4)
    assert free["a"]["b"] == [1, {"c": 3}, 4]
    assert TREE["a"]["b"] == [1, {"c": 2}]


def test_shallow_copies_are_free_on_top() -> None:
    frozen = freeze(TREE)
    for free in (frozen.copy(), dict(frozen), copy.copy(frozen)):
        free["d"] = 1
    items = frozen["a"]["b"].copy()
    items.append(1)
    assert frozen == TREE


def test_tuples_become_lists() -> None:
    assert freeze({"a": (1, 2)}) == thaw({"a": (1, 2)}) == {"a": [1, 2]}
