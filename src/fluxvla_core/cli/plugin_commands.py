"""``fluxvla plugins list``: what is installed, from metadata alone. ``fluxvla plugins show NAME``:
what a config may say to a class, read from its source.
"""

from __future__ import annotations

import argparse
import json
import sys
from typing import TYPE_CHECKING, Any

from fluxvla_core.cli.parser import Parser
from fluxvla_core.cli.terminal import say
from fluxvla_core.errors import MissingPlugin, PluginError, nearest
from fluxvla_core.plugins import first_party
from fluxvla_core.plugins._metadata import Plugin, canonical, index
from fluxvla_core.registries import PREFIX, REGISTRIES

if TYPE_CHECKING:
    from fluxvla_core.config.signature import Signature


class List:
    api = "1.0"
    help = "List everything that is installed for FluxVLA, without importing it."

    def add_arguments(self, parser: Parser) -> None:
        parser.add_argument("--json", action="store_true", help="for machines")

    def run(self, args: argparse.Namespace) -> int:
        found = index()
        plugins = [p for _, many in sorted(found.plugins.items()) for p in many]
        if args.json:
            say(json.dumps([_record(p) for p in plugins], indent=1))
        else:
            say("\n".join(_table(plugins)) or "nothing is installed")
        if found.broken:
            count = len(found.broken)
            text = f"{count} distribution(s) could not be read; run: fluxvla plugins doctor"
            say(text, sys.stderr)
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
    """What is known of a plugin without importing it."""
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
    return "\n".join([*lines, *_keys(signature)])


def _keys(signature: Signature) -> list[str]:
    import textwrap

    from fluxvla_core.config.resolve import INJECTED

    lines = ["  keys"] if signature.parameters or signature.open else ["  keys         none"]
    for parameter in signature.parameters:
        note = "required" if parameter.required else ""
        if parameter.name in INJECTED:
            note = "filled in when the run starts"
        text = f"    {parameter.name}{parameter.text}"
        lines.append(f"{text}   [{note}]" if note else text)
        meaning = signature.meanings.get(parameter.name, "")
        lines += textwrap.wrap(meaning, 100, initial_indent=" " * 8, subsequent_indent=" " * 8)
    if signature.open:
        lines.append("    ...   [takes further keys, which cannot be checked]")
    return lines
