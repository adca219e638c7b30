"""The messages and rules of docs/errors.md are those of the code; all extras are in their table."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

import pytest
import tomli

from fluxvla_core.control.safety import Rule

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "errors.md").read_text(encoding="utf-8")
EXTRAS = (ROOT / "docs" / "installation.md").read_text(encoding="utf-8")
NAMES = 8
"""Characters that a word of a message has at least to be looked for by itself."""


def tables(heading: str) -> list[str]:
    """The first cells of the tables of messages, or of rules."""
    parts = PAGE.split(f"| {heading} |")[1:]
    rows = [row for part in parts for row in part.partition("\n\n")[0].splitlines()]
    return [row.split(" | ")[0].lstrip("| ") for row in rows if row.startswith("| `")]


MESSAGES = [m.strip("`") for m in tables("message")]


@cache
def strings() -> str:
    """Every string of the core, with ``…`` where a value is put in."""
    found = []
    for path in (ROOT / "src" / "fluxvla_core").rglob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        found += [_text(node) for node in ast.walk(tree)]
    return "\n".join(found)


def _text(node: ast.AST) -> str:
    if isinstance(node, ast.Constant):
        return node.value if isinstance(node.value, str) else ""
    if isinstance(node, ast.JoinedStr):
        return "".join(v.value if isinstance(v, ast.Constant) else "…" for v in node.values)
    return ""


@pytest.mark.parametrize("message", MESSAGES)
def test_a_message_is_one_of_the_code(message: str) -> None:
    parts = [re.escape(part) for part in message.split("…")]
    assert re.search("[^\n]*".join(parts), strings()), message


def test_there_are_messages_of_every_subject() -> None:
    assert len(MESSAGES) > 40
    assert len(MESSAGES) == len(set(MESSAGES))


def test_every_safety_rule_is_explained() -> None:
    named = {name for cell in tables("rule") for name in re.findall("`(.+?)`", cell)}
    assert named == {rule.value for rule in Rule} - {Rule.INTERRUPT.value}


def test_every_extra_is_in_the_table() -> None:
    named = set(re.findall(r"^\| `([\w-]+)` \| `([\w-]+)` \|", EXTRAS, re.MULTILINE))
    there = set()
    for path in (ROOT / "pyproject.toml", *(ROOT / "plugins").glob("*/pyproject.toml")):
        project = tomli.loads(path.read_text(encoding="utf-8"))["project"]
        there |= {(project["name"], extra) for extra in project.get("optional-dependencies", {})}
    assert named == there
