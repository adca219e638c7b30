"""docs/porting/upstream.md: every name is there, with the methods and the keys that it says."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

import pytest

import fluxvla_core
from fluxvla_core import BaseInferenceRunner, BaseTrainRunner
from fluxvla_core.config.resolve import resolve
from fluxvla_core.plugins import first_party
from fluxvla_core.registries import REGISTRIES

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "porting" / "upstream.md").read_text(encoding="utf-8")
EXAMPLES = {"MyTrainRunner", "MyRobotInferenceRunner", "MyRobotOperator", "MySimEvalRunner"}


def rows(title: str) -> list[tuple[str, str]]:
    """The cells of the table below a heading."""
    text = re.split(r"\n#+ ", PAGE.partition(f"# {title}\n")[2], maxsplit=1)[0]
    lines = [
        line for line in text.splitlines() if line.startswith("| `") or "| the imports" in line
    ]
    return [tuple(cell.strip() for cell in line.strip("|").split(" | ", 1)) for line in lines]  # type: ignore[misc]


def owners(name: str) -> set[str]:
    return {o for o in (first_party.owner(registry, name) for registry in REGISTRIES) if o}


NAMES = [
    (name, there)
    for theirs, there in rows("Names and where they are")
    for name in re.findall(r"`([A-Z]\w+)`", theirs)
]


@pytest.mark.parametrize(("name", "there"), NAMES)
def test_a_name_lives_where_the_page_says(name: str, there: str) -> None:
    if "`fluxvla-" in there:
        assert f"`{owners(name).pop()}`" in there
    elif there == "the core":
        assert resolve(name).origin.startswith("fluxvla-core ")
    elif name in EXAMPLES:
        files = (ROOT / "examples").rglob("*.py")
        assert any(f"class {name}" in file.read_text(encoding="utf-8") for file in files)
    else:
        assert hasattr(fluxvla_core, name)


@pytest.mark.parametrize(
    ("title", "cls"),
    [
        ("Methods of a train runner", BaseTrainRunner),
        ("Methods of an inference runner", BaseInferenceRunner),
    ],
)
def test_a_method_takes_what_the_page_says(title: str, cls: type) -> None:
    calls = [c for theirs, _ in rows(title) for c in re.findall(r"`(\w+)\(([^)]*)\)`", theirs)]
    assert len(calls) > 4
    for name, given in calls:
        taken = list(inspect.signature(getattr(cls, name)).parameters)[1:]
        assert taken[: len(given.split(","))] == [g.strip() for g in given.split(",")] or not given


KEYS = [
    (cls, key)
    for theirs, _ in rows("Keys of a config")
    for classes, _, keys in [theirs.partition(":")]
    for cls in re.findall(r"`(\w+)`", classes)
    for key in re.findall(r"`(\w+)`", keys)
]


@pytest.mark.parametrize(("cls", "key"), KEYS)
def test_a_key_is_one_of_the_class(cls: str, key: str) -> None:
    signature = resolve(cls).signature
    assert signature is not None
    assert key in {one.name for one in signature.parameters}


def test_nothing_is_left_out_of_the_tables() -> None:
    assert len(NAMES) > 25
    assert len(KEYS) > 50


@pytest.mark.parametrize("path", re.findall(r"`(src/[\w/.]+)`", PAGE))
def test_a_folder_is_there(path: str) -> None:
    assert (ROOT / path).exists()
