"""Descriptions of parameters and fields, read from docstrings in Google's style."""

from __future__ import annotations

import ast
import inspect
import re
from itertools import pairwise

_SECTION = re.compile(r"^(\s*)Args:\s*$", re.MULTILINE)
_ENTRY = re.compile(r"^(\*{0,2}\w+(?:, \*{0,2}\w+)*)(?: \([^)]*\))?:\s*(.*)$")


def argument_texts(docstring: str | None) -> dict[str, str]:
    """Parameter -> its description, on one line; empty where there is no such section.

    ``height, width: of the images`` is said of both.
    """
    text = inspect.cleandoc(docstring or "")
    section = _SECTION.search(text)
    if section is None:
        return {}
    margin = len(section[1])
    found: dict[str, str] = {}
    names: list[str] = []
    inner: int | None = None
    for line in text[section.end() :].splitlines():
        if not line.strip():
            continue
        indent = len(line) - len(line.lstrip())
        if indent <= margin:  # the next section, or what is said after it
            break
        inner = indent if inner is None else inner
        entry = _ENTRY.match(line.strip()) if indent == inner else None
        if entry:
            names = [name.strip("* ") for name in entry[1].split(",")]
            found.update(dict.fromkeys(names, entry[2].strip()))
        else:
            for name in names:
                found[name] = f"{found[name]} {line.strip()}".strip()
    return found


def field_texts(node: ast.ClassDef) -> dict[str, str]:
    """Attribute docstrings: the string below ``name: type = default``."""
    found = {}
    for stated, below in pairwise(node.body):
        if (
            isinstance(stated, ast.AnnAssign)
            and isinstance(stated.target, ast.Name)
            and isinstance(below, ast.Expr)
            and isinstance(below.value, ast.Constant)
            and isinstance(below.value.value, str)
        ):
            found[stated.target.id] = " ".join(below.value.value.split())
    return found
