"""The reference of the command line: what each command says with ``--help``."""

from __future__ import annotations

import argparse
import importlib
import os
from collections.abc import Iterator, Mapping
from pathlib import Path

import tomli

from fluxvla_core.cli.main import COMMANDS
from fluxvla_core.cli.parser import Parser

GROUP = "fluxvla.commands"
WIDTH = "96"
"""Columns of a help text: what a block of code shows on a wide screen without scrolling."""


def theirs(root: Path) -> Iterator[tuple[str, str, str]]:
    """Name, target (``module:Class``) and distribution of the commands of the plugins here."""
    for path in sorted((root / "plugins").glob("*/pyproject.toml")):
        project = tomli.loads(path.read_text(encoding="utf-8"))["project"]
        points: Mapping[str, str] = project.get("entry-points", {}).get(GROUP, {})
        for name, target in sorted(points.items()):
            yield name, target, project["name"]


def render(root: Path) -> str:
    """The page, with the core's commands and those of the plugins in ``root``."""
    parts = [
        "# Command line",
        "Exit codes: 0 done, 1 failed, 2 bad input, 130 interrupted. `FLUXVLA_STRICT=1` shows the "
        "traceback of every error. Options cannot be abbreviated.",
    ]
    for name, entry in COMMANDS.items():
        parts += _command(name, entry.target)
    parts += [
        "## Commands of plugins",
        "They are there where the plugin is installed; `fluxvla --help` lists them.",
    ]
    for name, target, dist in theirs(root):
        parts += _command(name, target, f"From `{dist}`.")
    return "\n\n".join(parts) + "\n"


def _command(name: str, target: str, origin: str = "") -> list[str]:
    module, _, cls = target.partition(":")
    command = getattr(importlib.import_module(module), cls)()
    parser = Parser(f"fluxvla {name}", str(command.help))
    command.add_arguments(parser)
    anchor = name.replace(" ", "-")
    text = _help(parser)
    said = [f"### fluxvla {name} {{ #{anchor} }}", origin, f"```text\n{text}\n```"]
    return [part for part in said if part]


def _help(parser: argparse.ArgumentParser) -> str:
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = WIDTH
    try:
        return parser.format_help().rstrip()
    finally:
        if before is None:
            del os.environ["COLUMNS"]
        else:
            os.environ["COLUMNS"] = before
