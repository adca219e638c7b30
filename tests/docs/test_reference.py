"""The generated reference has every registry, every public method of a contract, every command."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import re
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("griffe")

from fluxvla_core import contracts as package
from fluxvla_core.cli.main import COMMANDS
from fluxvla_core.contracts.contract import Contract, attribute
from fluxvla_core.registries import ROWS
from tools.docs import classes, commands, contracts, pages

ROOT = Path(__file__).parents[2]
CORE = ROOT / "src" / "fluxvla_core"
PRIVATE = {"Contract", "_Adapter", "_AnyTransform"}
# Where classes inherit, the reference has a method with the class that defines it.
OWNERS = {"_AnyTransform": "Transform"}


def every_contract() -> dict[str, type[Contract]]:
    found: dict[str, type[Contract]] = {}
    for module in pkgutil.iter_modules(package.__path__, f"{package.__name__}."):
        for name, value in vars(importlib.import_module(module.name)).items():
            if inspect.isclass(value) and issubclass(value, Contract):
                found[name] = value
    return found


CONTRACTS = {n: c for n, c in every_contract().items() if n not in PRIVATE}


def public(cls: type) -> set[str]:
    """Methods and attributes that ``cls`` itself defines."""
    bodies = [vars(cls)]
    if cls.__name__ in OWNERS.values():
        bodies += [vars(base) for base in cls.__mro__ if OWNERS.get(base.__name__) == cls.__name__]
    names = {name for body in bodies for name, value in body.items() if shown(name, value)}
    return names | {n for n in inspect.get_annotations(cls) if not n.startswith("_")}


def shown(name: str, value: object) -> bool:
    if name.startswith("__"):
        return name in {"__call__", "__len__", "__getitem__"} and inspect.isfunction(value)
    return not name.startswith("_") and not isinstance(value, classmethod | staticmethod)


@pytest.fixture(scope="module")
def reference() -> dict[str, str]:
    return {page.name: contracts.render(page, CORE) for page in contracts.PAGES}


def test_every_contract_has_a_place() -> None:
    listed = {name for page in contracts.PAGES for names in page.classes.values() for name in names}
    assert set(CONTRACTS) <= listed
    assert len(CONTRACTS) > 15


@pytest.mark.parametrize("name", CONTRACTS)
def test_who_calls_each_method_is_said(name: str) -> None:
    assert set(contracts.calls()[name]) == public(CONTRACTS[name]) | extra(name)


def extra(name: str) -> set[str]:
    """Calls that a contract has besides its methods: a dataset for a robot's observations."""
    return set(CONTRACTS[name]._besides)


@pytest.mark.parametrize("name", CONTRACTS)
def test_every_method_is_in_the_reference(name: str, reference: dict[str, str]) -> None:
    text = "".join(reference.values())
    for member in public(CONTRACTS[name]):
        assert f"### `{member}` {{ #{name}.{member.strip('_')} }}" in text
        function = vars(CONTRACTS[name]).get(member)
        if isinstance(function, attribute) or inspect.isfunction(function):
            doc = (inspect.getdoc(function) or "").partition("\n")[0]
            assert contracts.as_markdown(doc) in text, member


def test_every_registry_and_its_builder_are_in_the_reference() -> None:
    text = classes.render_registries(ROOT)
    for row in ROWS:
        assert re.search(rf"^\| \[?`{row.name}`.* \| {row.about}", text, re.MULTILINE)
        assert row.builder is None or f"`{row.builder}`" in text


def test_every_class_of_the_repository_is_in_the_reference() -> None:
    text = "".join(classes.render_classes(ROOT, row) for row in classes.listed(ROOT))
    named = [p.name for p in classes.provided(ROOT) if p.group != "fluxvla.commands"]
    assert len(named) > 80
    assert [n for n in named if f"## {n} {{ #{n} }}" not in text] == []
    # Its keys are read from source: a class whose source cannot be read would have none.
    assert "- `max_keep_ckpts" in text


def test_commands_describe_themselves_without_torch() -> None:
    """As the site is built, in an environment that has the core's dependencies alone."""
    code = (
        "import sys; sys.modules['torch'] = None\n"
        "from pathlib import Path\n"
        "from tools.docs import commands\n"
        "commands.render(Path())"
    )
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)


def test_every_command_is_in_the_reference() -> None:
    text = commands.render(ROOT)
    for name in [*COMMANDS, *(name for name, _, _ in commands.theirs(ROOT))]:
        assert f"### fluxvla {name} {{" in text
        assert f"usage: fluxvla {name} " in text
    assert "- `--resume auto|PATH`: resume from the newest checkpoint" in text


def test_a_link_to_a_contract_leads_to_the_reference() -> None:
    known = pages.pages(ROOT)
    for page in contracts.PAGES:
        for module in page.classes:
            if module.startswith(("contracts/", "spec/")):
                assert known[f"src/fluxvla_core/{module}"] == f"reference/{page.name}.md"
