"""Differences between two configs."""

from __future__ import annotations

from typing import Any

from fluxvla_core.cli.config_commands import differences
from fluxvla_core.config.tree import Config


def said(old: dict[str, Any], new: dict[str, Any]) -> list[tuple[Any, Any]]:
    """(key, value) on each side of each change; None where there is none."""
    found = differences(Config(old, file="a"), Config(new, file="b"))
    return [tuple(side and (side.key, side.value) for side in (c.old, c.new)) for c in found]


def test_equal_trees_have_none() -> None:
    tree = {"a": {"b": [1, {"c": float("nan")}]}, "d": None, "e": {}}
    assert said(tree, tree) == []
    assert said(tree, dict(reversed(tree.items()))) == []


def test_added_removed_and_changed() -> None:
    old = {"a": {"x": 1, "y": 2}, "b": 3}
    new = {"a": {"x": 1, "y": 4, "z": {"w": 5}}}
    assert said(old, new) == [
        (("a.y", 2), ("a.y", 4)),
        (None, ("a.z.w", 5)),
        (("b", 3), None),
    ]


def test_values_differ_as_they_are_written() -> None:
    old, new = {"a": 1, "b": 1, "c": "1", "d": []}, {"a": 1.0, "b": True, "c": 1, "d": {}}
    assert [a for a, _ in said(old, new)] == [("a", 1), ("b", 1), ("c", "1"), ("d", [])]


def test_a_list_of_numbers_is_one_value() -> None:
    assert said({"a": [1, 2]}, {"a": [1, 3]}) == [(("a", [1, 2]), ("a", [1, 3]))]


def test_an_inserted_transform_is_one_change() -> None:
    crop, resize = {"type": "Crop", "top": 3}, {"type": "Resize"}
    noise = {"type": "Noise", "std": 0.1}
    assert said({"t": [crop, resize]}, {"t": [noise, crop, resize]}) == [
        (None, ("t.0.type", "Noise")),
        (None, ("t.0.std", 0.1)),
    ]
    assert said({"t": [noise, crop]}, {"t": [{**crop, "top": 4}]}) == [
        (("t.0.type", "Noise"), ("t.0.type", "Crop")),
        (None, ("t.0.top", 4)),
        (("t.0.std", 0.1), None),
        (("t.1.type", "Crop"), None),
        (("t.1.top", 3), None),
    ]
    assert said({"t": [crop, resize]}, {"t": [{**crop, "top": 4}, resize]}) == [
        (("t.0.top", 3), ("t.0.top", 4))
    ]


def test_a_table_that_became_a_value() -> None:
    assert said({"a": {"x": 1, "y": 2}}, {"a": None}) == [
        (("a.x", 1), None),
        (("a.y", 2), None),
        (None, ("a", None)),
    ]


def test_each_side_has_its_place() -> None:
    old = Config({"a": {"x": 1}}, {"a": "a.py:1", "a.x": "a.py:2"}, "a.py")
    new = Config({"a": {"x": 2}}, {"a": "b.py:7"}, "b.py")
    (change,) = differences(old, new)
    assert change.old is not None
    assert change.new is not None
    assert (change.old.where, change.new.where) == ("a.py:2", "b.py:7")
