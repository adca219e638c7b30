"""``fluxvla plugins doctor``: what is wrong with the installation.

From metadata and sources first, which takes a second; then each plugin is imported, in processes
that may break.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator

from fluxvla_core.cli.main import COMMANDS, STRICT
from fluxvla_core.cli.parser import Parser, positive
from fluxvla_core.cli.terminal import say
from fluxvla_core.config.resolve import installed
from fluxvla_core.errors import EXIT_DONE, EXIT_FAILED, PluginError, nearest
from fluxvla_core.plugins import import_check
from fluxvla_core.plugins._metadata import Plugin, index
from fluxvla_core.registries import GROUPS, PREFIX


class Doctor:
    api = "1.0"
    help = (
        "Look for distributions that cannot be read, names that collide, requirements on the "
        "core that do not hold, unknown groups, syntax errors, and entry points to nothing; then "
        "import every plugin, each distribution in a process of its own, and check its classes "
        "against their contracts."
    )

    def add_arguments(self, parser: Parser) -> None:
        parser.add_argument(
            "--no-import", action="store_true", help="look at metadata and sources only"
        )
        parser.once(
            "--limit",
            type=positive,
            default=import_check.LIMIT_S,
            metavar="SECONDS",
            help=f"how long one import may take (default {import_check.LIMIT_S})",
        )

    def run(self, args: argparse.Namespace) -> int:
        healthy = True
        for text in self._findings(args):
            healthy = False
            say(text)
        if not healthy:
            return EXIT_FAILED
        plugins = [p for many in index().plugins.values() for p in many]
        dists = {p.dist for p in plugins}
        looked = " in metadata and sources" if args.no_import else ""
        say(f"no problems{looked}: {len(plugins)} plugin(s) of {len(dists)} distribution(s)")
        return EXIT_DONE

    def _findings(self, args: argparse.Namespace) -> Iterator[str]:
        yield from collisions()
        importable = []
        for plugin in _read_groups():
            text = _cannot_work(plugin)
            if text is None:
                importable.append(plugin)
            else:
                yield f"{plugin.group}: {text}"
        if not args.no_import:
            traces = os.environ.get(STRICT) == "1"
            yield from import_check.problems(importable, args.limit, traces, _show_progress)


def collisions() -> Iterator[str]:
    """One line for each distribution, group or name that the index has trouble with."""
    yield from (f"cannot be read: {line}" for line in index().broken)
    for (group, name), many in sorted(index().plugins.items()):
        if group not in GROUPS:
            yield from (_unknown_group(plugin) for plugin in many)
            continue
        if len(many) > 1:
            who = ", ".join(p.origin for p in many)
            yield (
                f"{group}: {name!r} is provided by {who}; "
                f"write type='<distribution>:{name}' to choose, or uninstall one"
            )
        if group == PREFIX + "commands" and name in COMMANDS:
            yield f"{many[0].origin}: the command {name!r} is the core's own; rename it"


def _read_groups() -> Iterator[Plugin]:
    """Every plugin in a group that the core reads."""
    for (group, _), many in sorted(index().plugins.items()):
        if group in GROUPS:
            yield from many


def _cannot_work(plugin: Plugin) -> str | None:
    try:
        installed(plugin)
    except PluginError as error:
        return import_check.in_one_line(error)
    return None


def _show_progress(plugins: import_check.Plugins) -> None:
    if sys.stderr.isatty():
        say(f"importing {plugins[0].origin} ({len(plugins)} plugin(s)) ...", sys.stderr)


def _unknown_group(plugin: Plugin) -> str:
    near = nearest(plugin.group, GROUPS)
    hint = f"; did its author mean {near!r}?" if near else ""
    return f"{plugin.origin}: {plugin.name} is in {plugin.group!r}, which nothing reads{hint}"
