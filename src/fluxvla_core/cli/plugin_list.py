"""``fluxvla plugins list``: what is installed, from metadata alone."""

from __future__ import annotations

import argparse
import json
import sys
from typing import Any

from fluxvla_core.cli.parser import Parser
from fluxvla_core.plugins._metadata import Plugin, index


class List:
    api = "1.0"
    help = "List everything that is installed for FluxVLA, without importing it."

    def add_arguments(self, parser: Parser) -> None:
        parser.add_argument("--json", action="store_true", help="for machines")

    def run(self, args: argparse.Namespace) -> int:
        found = index()
        plugins = [p for _, many in sorted(found.plugins.items()) for p in many]
        if args.json:
            print(json.dumps([_record(p) for p in plugins], indent=1))
        else:
            print("\n".join(_table(plugins)) or "nothing is installed")
        if found.broken:
            count = len(found.broken)
            text = f"{count} distribution(s) could not be read; run: fluxvla plugins doctor"
            print(text, file=sys.stderr)
        return 0


def _record(plugin: Plugin) -> dict[str, Any]:
    return {
        "group": plugin.group,
        "name": plugin.name,
        "distribution": plugin.dist,
        "version": plugin.version,
        "value": plugin.value,
    }


def _table(plugins: list[Plugin]) -> list[str]:
    lines: list[str] = []
    width = max((len(p.name) for p in plugins), default=0)
    group = ""
    for plugin in plugins:
        if plugin.group != group:
            group = plugin.group
            lines.append(group)
        lines.append(f"  {plugin.name:{width}}  {plugin.origin}")
    return lines
