"""The reference of registries: which there are, and the classes of this repository in each.

Classes are read from source, as ``fluxvla plugins show`` reads them; nothing of them is imported.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import tomli

from fluxvla_core.cli.plugin_commands import record
from fluxvla_core.plugins._metadata import Plugin
from fluxvla_core.registries import PREFIX, ROWS, RegistryRow
from tools.docs.pages import escaped, pages

_SHORT = ("llm", "vla", "vlm")
COMMANDS = "commands"
"""The registry whose classes have a page of their own."""


def provided(root: Path) -> list[Plugin]:
    """Every class that a distribution of the repository registers, by group and name."""
    found = []
    for path in (root / "pyproject.toml", *sorted((root / "plugins").glob("*/pyproject.toml"))):
        project = tomli.loads(path.read_text(encoding="utf-8"))["project"]
        for group, points in project.get("entry-points", {}).items():
            found += [
                Plugin(group, name, target, project["name"], project["version"])
                for name, target in points.items()
            ]
    return sorted((p for p in found if p.group.startswith(PREFIX)), key=lambda p: p.name.lower())


def listed(root: Path) -> list[RegistryRow]:
    """The registries that have a page of classes."""
    there = {plugin.group for plugin in provided(root)}
    return [row for row in ROWS if row.group in there and row.name != COMMANDS]


def page_of(row: RegistryRow) -> str:
    """The page of the classes of a registry."""
    return f"reference/classes/{row.name.replace('_', '-')}.md"


def title_of(row: RegistryRow) -> str:
    """The registry's name as a heading: ``LLM backbones``."""
    words = row.name.split("_")
    first = words[0].upper().replace("VLAS", "VLAs") if words[0][:3] in _SHORT else words[0].title()
    return " ".join([first, *words[1:]])


def render_registries(root: Path) -> str:
    """The table of registries."""
    known, classes = pages(root), {row.name: page_of(row) for row in listed(root)}
    lines = [
        "# Registries",
        "Every kind of class that a plugin may provide. The entry-point group of a registry is "
        f"`{PREFIX}NAME`, its object in code `fluxvla_core.NAME` in capitals (`RUNNERS`), which "
        "has `register_module()`. A name leads to the classes of this repository. A class without "
        "a page of its contract is called only by the plugin that builds it.",
        "| registry | what its classes are, and what builds one | contract |",
        "|---|---|---|",
    ]
    for row in ROWS:
        module, _, contract = (row.contract or "").partition(":")
        page = known.get(f"src/{module.replace('.', '/')}.py", "")
        link = (
            f"[`{contract}`]({page.removeprefix('reference/')}#{contract}) {row.api}"
            if page
            else ""
        )
        theirs = classes.get(row.name, "").removeprefix("reference/")
        theirs = "commands.md" if row.name == COMMANDS else theirs
        name = f"[`{row.name}`]({theirs})" if theirs else f"`{row.name}`"
        built = f"; `{row.builder}`" if row.builder else ""
        lines.append(f"| {name} | {row.about}{built} | {link} |")
    return "\n\n".join([*lines[:2], "\n".join(lines[2:])]) + "\n"


def render_classes(root: Path, row: RegistryRow) -> str:
    """The classes of one registry, with the keys of each."""
    known = pages(root)
    parts = [
        f"# {title_of(row)}",
        f"Classes of the group `{row.group}` in this repository ({row.about}), and the keys that a "
        "config may give them. `fluxvla plugins show NAME` prints the same of what is installed.",
    ]
    for plugin in (p for p in provided(root) if p.group == row.group):
        parts += _class(plugin, known)
    return "\n\n".join(parts) + "\n"


def _class(plugin: Plugin, known: dict[str, str]) -> Iterator[str]:
    said = record(plugin)
    page = known.get(f"plugins/{plugin.dist}/README.md")
    origin = f"[`{plugin.dist}`](../../{page})" if page else f"`{plugin.dist}`"
    yield f"## {plugin.name} {{ #{plugin.name} }}"
    yield f"From {origin}. {escaped(said['about'] or '')}"
    keys = []
    for one in said["parameters"] or []:
        if one["injected"]:
            continue
        note = f": {one['annotation']}" if one["annotation"] else ""
        given = "" if one["default"] is None else f" = {one['default']}"
        meaning = escaped(one["description"] or "")
        required = " *(required)*" if one["required"] else ""
        keys.append(f"- `{one['name']}{note}{given}`{required}{' – ' if meaning else ''}{meaning}")
    yield "\n".join(keys) if keys else "It takes no keys."
    if said["takes_others"]:
        yield "It takes further keys, which are not checked."
