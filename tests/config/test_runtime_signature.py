from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Optional

import pytest

from fluxvla_core.config.runtime_signature import type_mismatches


class Base:
    def __init__(self, rate: float = 1.0, unknown: Missing = None):  # noqa: F821
        pass


class Typed:
    def __init__(
        self,
        number: int = 0,
        share: float = 0.0,
        flag: bool = False,
        name: str | Path = "",
        limit: Optional[int] = None,  # noqa: UP045 -- as plugins may write it
        names: Sequence[str] | None = None,
        table: Mapping[str, Any] | None = None,
        free: Any = None,
    ):
        pass


class Child(Typed):
    def __init__(self, own: str = "", **kwargs):
        super().__init__(**kwargs)


@pytest.mark.parametrize(
    "values",
    [
        {"number": 3, "share": 2, "flag": True, "name": "a", "limit": None, "names": ["a"]},
        {"names": ("a",), "table": {}, "free": object(), "limit": 4, "share": 0.5, "name": Path()},
        {"not_taken": 1},
    ],
)
def test_what_fits(values):
    assert type_mismatches(Child, values) == []


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("number", "3"), ("number", 2.0), ("number", True), ("share", "1"), ("flag", 1)),
        *(("limit", "4"), ("names", "top"), ("table", [1]), ("own", 3)),
    ],
)
def test_what_does_not(name, value):
    (found,) = type_mismatches(Child, {name: value})
    assert str(found).startswith(f"{name!r} must be ")
    assert str(found).endswith(f"got {value!r}")


def test_annotations_that_cannot_be_read_count_for_nothing():
    assert type_mismatches(Base, {"rate": "a", "unknown": 3}) == []
