"""Syntax of Python 3.12 in an installed copy, rewritten for 3.11 with the same meaning."""

from __future__ import annotations

import collections
import typing

from tools.oracle_env import without_type_parameters

NEW = '''"""A page."""

from __future__ import annotations

import collections

type Name = str | int
type Table = dict[str, list[Name]]


class Bare[T]:
    pass


@staticmethod
class Pipe[A, B](collections.UserDict):
    def get(self) -> Pipe[A, B]:
        return self


def read[T: Name](path: str, made: T) -> T:
    return made
'''


def test_generics_and_aliases() -> None:
    names: dict[str, typing.Any] = {}
    exec(compile(without_type_parameters(NEW), "page.py", "exec", dont_inherit=True), names)
    assert names["__doc__"] == "A page."
    assert names["Table"] == dict[str, list[str | int]]
    pipe = names["Pipe"].__func__
    assert pipe[int, str].__origin__ is pipe
    assert len(pipe.__parameters__) == 2
    assert issubclass(pipe, collections.UserDict)
    assert names["Bare"][int]().__class__ is names["Bare"]
    assert names["read"]("here", 3) == 3


def test_older_syntax_stays_as_it_is() -> None:
    text = "import abc\n\ntype(abc)\nx: list[int] = []\n\n\nclass A(abc.ABC):\n    pass\n"
    assert without_type_parameters(text) == text
    once = without_type_parameters(NEW)
    assert without_type_parameters(once) == once
