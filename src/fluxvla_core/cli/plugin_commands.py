"""``fluxvla plugins list``, from metadata, and ``plugins show``, from a class's source."""

from __future__ import annotations

import argparse
import json
import sys
from typing import TYPE_CHECKING, Any

from fluxvla_core.cli.parser import Parser, add_json
from fluxvla_core.cli.terminal import say
from fluxvla_core.errors import MissingPlugin, PluginError, nearest
from fluxvla_core.plugins import first_party
from fluxvla_core.plugins._metadata import Plugin, canonical, index
from fluxvla_core.registries import GROUPS, PREFIX, REGISTRIES

if TYPE_CHECKING:
    from fluxvla_core.config.signature import Signature


class List:
    help = "List everything that is installed for FluxVLA, without importing it."

    def add_arguments(self, parser: Parser) -> None:
        add_json(parser)

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
    help = "Show one class: the keys that a config may set, and where it comes from."

    def add_arguments(self, parser: Parser) -> None:
        parser.add_argument("name", help="a class's name, or distribution:name")
        add_json(parser)

    def run(self, args: argparse.Namespace) -> int:
        found = providers(args.name)
        if args.json:
            say(json.dumps([record(plugin) for plugin in found], indent=1))
        else:
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
    lines = [f"{plugin.group} {plugin.name}", f"  provided by  {plugin.origin} ({plugin.value})"]
    signature, problem = _signature(plugin)
    if problem:
        return "\n".join([*lines, f"  cannot work  {problem}"])
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


def record(plugin: Plugin) -> dict[str, Any]:
    """JSON values for ``plugins show --json``; docs/files.md has its keys."""
    from fluxvla_core.config.resolve import INJECTED

    signature, problem = _signature(plugin)
    found: dict[str, Any] = {
        **plugin.to_dict(),
        "problem": problem or None,
        "defined_at": None,
        "contract": None,
        "about": None,
        "parameters": None,
        "takes_others": None,
    }
    if signature is not None:
        meanings = signature.meanings
        found |= {
            "defined_at": signature.place,
            "contract": signature.api,
            "about": signature.doc or None,
            "parameters": [
                {
                    "name": one.name,
                    "required": one.required,
                    "injected": one.name in INJECTED,
                    "annotation": one.annotation,
                    "default": one.default,
                    "description": meanings.get(one.name),
                }
                for one in signature.parameters
            ],
            "takes_others": signature.open,
        }
    return found


def _signature(plugin: Plugin) -> tuple[Signature | None, str]:
    """The signature of a plugin's class, if it can be read, and why the plugin cannot work."""
    from fluxvla_core.config.resolve import installed
    from fluxvla_core.plugins.load import unread_group

    if plugin.group not in GROUPS:
        return None, unread_group(plugin)
    try:
        return installed(plugin).signature, ""
    except PluginError as error:
        return None, error.what


def _process(plugin: Plugin) -> str:
    """The process that sends an operator's commands (docs/control.md, Control process)."""
    from fluxvla_core.config.signature import implements

    divided = implements(plugin, "fluxvla_core.contracts.robot", "without_cameras")
    if divided is None:
        return "not known: its source, or that of a base class, cannot be read"
    if divided:
        return "can be divided: commands are sent from a process of its own"
    return (
        "runs as a whole in a process of its own, which sends commands and also copies its images: "
        "code of its own that holds the GIL delays commands"
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
