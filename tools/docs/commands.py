"""The reference of the command line: each command's arguments, from its ``--help``."""

from __future__ import annotations

import argparse
import importlib
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from unittest import mock

import tomli

from fluxvla_core.cli.main import COMMANDS
from fluxvla_core.cli.parser import Parser
from tools.docs.pages import escaped

GROUP = "fluxvla.commands"
WIDTH = "72"
"""Columns of a line of usage."""


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
    said = [
        f"### fluxvla {name} {{ #{name.replace(' ', '-')} }}",
        " ".join([escaped(str(command.help)), origin]).strip(),
        f"```text\n{_usage(parser)}\n```",
        "\n".join(_option(parser, action) for action in parser._actions[1:]),
    ]
    return [part for part in said if part]


def _usage(parser: argparse.ArgumentParser) -> str:
    """The line of usage, wrapped at ``WIDTH`` whatever this terminal is."""
    with mock.patch.dict(os.environ, COLUMNS=WIDTH):
        return parser.format_usage().rstrip()


def _option(parser: argparse.ArgumentParser, action: argparse.Action) -> str:
    """An item of a list: the argument as it is typed, and its meaning."""
    metavar = action.metavar
    if metavar is None and action.choices is not None:
        metavar = "{" + ",".join(map(str, action.choices)) + "}"
    takes = "" if action.nargs == 0 else f" {metavar or action.dest.upper()}"
    typed = ", ".join(f"{flag}{takes}" for flag in action.option_strings)
    meaning = (action.help or "") % {**vars(action), "prog": parser.prog}
    return f"- `{typed or metavar or action.dest}`" + (f": {escaped(meaning)}" if meaning else "")
