"""``fluxvla plugins doctor``: what is wrong with the installation, from metadata and sources."""

from __future__ import annotations

import argparse
import difflib

from fluxvla_core.cli.parser import Parser
from fluxvla_core.cli.table import COMMANDS
from fluxvla_core.config.resolve import installed
from fluxvla_core.errors import EXIT_DONE, EXIT_FAILED, PluginError
from fluxvla_core.plugins._metadata import Plugin, index
from fluxvla_core.plugins.groups import GROUPS, PREFIX


class Doctor:
    api = "1.0"
    help = (
        "Look for distributions that cannot be read, names that collide, requirements on the "
        "core that do not hold, unknown groups, and entry points to nothing. Imports no plugin."
    )

    def add_arguments(self, parser: Parser) -> None:
        return

    def run(self, args: argparse.Namespace) -> int:
        found = findings()
        for text in found:
            print(text)
        if found:
            return EXIT_FAILED
        plugins = [p for many in index().plugins.values() for p in many]
        dists = {p.dist for p in plugins}
        print(f"no problems: {len(plugins)} plugin(s) of {len(dists)} distribution(s)")
        return EXIT_DONE


def findings() -> list[str]:
    """One line a problem, with what mends it; empty if all is well."""
    out = [f"cannot be read: {line}" for line in index().broken]
    for (group, name), many in sorted(index().plugins.items()):
        if group not in GROUPS:
            out += [_unknown_group(plugin) for plugin in many]
            continue
        if len(many) > 1:
            who = ", ".join(p.origin for p in many)
            out.append(
                f"{group}: {name!r} is provided by {who}; "
                f"write type='<distribution>:{name}' to choose, or uninstall one"
            )
        if group == PREFIX + "commands" and name in COMMANDS:
            out.append(f"{many[0].origin}: the command {name!r} is the core's own; rename it")
        out += [f"{group}: {text}" for plugin in many if (text := _cannot_work(plugin))]
    return out


def _cannot_work(plugin: Plugin) -> str | None:
    try:
        installed(plugin)
    except PluginError as error:
        return error.what + (f"; {error.next}" if error.next else "")
    return None


def _unknown_group(plugin: Plugin) -> str:
    near = difflib.get_close_matches(plugin.group, GROUPS, 1)
    hint = f"; did its author mean {near[0]!r}?" if near else ""
    return f"{plugin.origin}: {plugin.name} is in {plugin.group!r}, which nothing reads{hint}"
