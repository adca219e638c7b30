"""``fluxvla plugins list``, ``show`` and ``doctor``.

``list`` reads metadata alone, ``show`` the source of a class. ``doctor`` looks for what is wrong
with the installation: in metadata and sources first, which takes a second; then each plugin is
imported, in processes that may break.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from fluxvla_core.cli.main import COMMANDS, STRICT
from fluxvla_core.cli.parser import Parser, positive
from fluxvla_core.cli.terminal import say
from fluxvla_core.errors import EXIT_DONE, EXIT_FAILED, MissingPlugin, PluginError, nearest
from fluxvla_core.plugins import first_party
from fluxvla_core.plugins._metadata import Plugin, canonical, index
from fluxvla_core.registries import GROUPS, PREFIX, REGISTRIES

if TYPE_CHECKING:
    from fluxvla_core.config.signature import Signature

IMPORT_LIMIT_S = 120
"""Seconds that ``doctor`` gives one import."""


class List:
    api = "1.0"
    help = "List everything that is installed for FluxVLA, without importing it."

    def add_arguments(self, parser: Parser) -> None:
        parser.add_argument("--json", action="store_true", help="for machines")

    def run(self, args: argparse.Namespace) -> int:
        found = index()
        plugins = [p for _, many in sorted(found.plugins.items()) for p in many]
        if args.json:
            say(json.dumps([p.to_dict() for p in plugins], indent=1))
        else:
            say("\n".join(_table(plugins)) or "nothing is installed")
        if found.broken:
            count = len(found.broken)
            text = f"{count} distribution(s) could not be read; run: fluxvla plugins doctor"
            say(text, sys.stderr)
        return 0


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


class Show:
    api = "1.0"
    help = "Show one class: what a config may say to it, and where it comes from."

    def add_arguments(self, parser: Parser) -> None:
        parser.add_argument("name", help="a class's name, or distribution:name")

    def run(self, args: argparse.Namespace) -> int:
        found = providers(args.name)
        say("\n\n".join(describe(plugin) for plugin in found))
        return 0


def providers(name: str) -> list[Plugin]:
    """Every installed plugin called ``name`` (or ``distribution:name``), in any registry.

    Raises:
        MissingPlugin: there is none; with a did-you-mean or the pip command.
    """
    dist, _, short = name.rpartition(":")
    every = index().plugins
    hits = [
        plugin
        for (_, n), many in sorted(every.items())
        for plugin in many
        if n == short and (not dist or canonical(plugin.dist) == canonical(dist))
    ]
    if hits:
        return hits
    for registry in REGISTRIES:
        owner = first_party.owner(registry, short)
        if owner:
            raise MissingPlugin(
                f"{short!r} is provided by {owner}, which is not installed: pip install {owner}"
            )
    from fluxvla_core.plugins.load import LIST

    near = nearest(short, sorted({n for _, n in every}))
    hint = f"; did you mean {near!r}?" if near else ""
    raise MissingPlugin(f"nothing installed is called {name!r}{hint}", next=LIST)


def describe(plugin: Plugin) -> str:
    """Description of a plugin without importing it."""
    from fluxvla_core.config.resolve import installed

    lines = [f"{plugin.group} {plugin.name}", f"  provided by  {plugin.origin} ({plugin.value})"]
    try:
        signature = installed(plugin).signature
    except PluginError as error:
        return "\n".join([*lines, f"  cannot work  {error.what}"])
    if signature is None:
        return "\n".join([*lines, "  source       cannot be read; its keys are not checked"])
    lines.append(f"  defined at   {signature.place}")
    if signature.api:
        lines.append(f"  contract     {plugin.group.removeprefix(PREFIX)} {signature.api}")
    if signature.doc:
        lines.append(f"  about        {signature.doc}")
    if plugin.group == PREFIX + "operators":
        lines.append(f"  process      {_process(plugin)}")
    return "\n".join([*lines, *_keys(signature)])


def _process(plugin: Plugin) -> str:
    """What sends an operator's commands (docs/control.md, Control process)."""
    from fluxvla_core.config.signature import implements

    divided = implements(plugin, "fluxvla_core.contracts.robot", "without_cameras")
    if divided is None:
        return "not known: its source, or that of a base class, cannot be read"
    if divided:
        return "can be divided: commands are sent from a process of its own"
    return (
        "runs as a whole in a process of its own, which sends commands and also copies its images: "
        "its own code that keeps the interpreter's lock delays commands"
    )


def _keys(signature: Signature) -> list[str]:
    import textwrap

    from fluxvla_core.config.resolve import INJECTED

    lines = ["  keys"] if signature.parameters or signature.open else ["  keys         none"]
    meanings = signature.meanings
    for parameter in signature.parameters:
        note = "required" if parameter.required else ""
        if parameter.name in INJECTED:
            note = "filled in when the run starts"
        text = f"    {parameter.name}{parameter.text}"
        lines.append(f"{text}   [{note}]" if note else text)
        meaning = meanings.get(parameter.name, "")
        lines += textwrap.wrap(meaning, 100, initial_indent=" " * 8, subsequent_indent=" " * 8)
    if signature.open:
        lines.append("    ...   [takes further keys, which cannot be checked]")
    return lines


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
            default=IMPORT_LIMIT_S,
            metavar="SECONDS",
            help=f"how long one import may take (default {IMPORT_LIMIT_S})",
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
            from fluxvla_core.plugins import import_check

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
    from fluxvla_core.config.resolve import installed

    try:
        installed(plugin)
    except PluginError as error:
        from fluxvla_core.plugins.import_check import in_one_line

        return in_one_line(error)
    return None


def _show_progress(plugins: Sequence[Plugin]) -> None:
    if sys.stderr.isatty():
        say(f"importing {plugins[0].origin} ({len(plugins)} plugin(s)) ...", sys.stderr)


def _unknown_group(plugin: Plugin) -> str:
    near = nearest(plugin.group, GROUPS)
    hint = f"; did its author mean {near!r}?" if near else ""
    return f"{plugin.origin}: {plugin.name} is in {plugin.group!r}, which nothing reads{hint}"
