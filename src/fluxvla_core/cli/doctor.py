"""``fluxvla plugins doctor``: problems of the installation, and facts about the machine.

Metadata and sources are read first, which takes a second; then each plugin is imported, in
processes that may break.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Literal

from packaging.requirements import InvalidRequirement, Requirement

from fluxvla_core.cli.main import RESERVED, STRICT
from fluxvla_core.cli.parser import Parser, add_json, positive
from fluxvla_core.cli.terminal import say
from fluxvla_core.errors import EXIT_DONE, EXIT_FAILED, PluginError
from fluxvla_core.plugins import _metadata
from fluxvla_core.plugins._metadata import CORE, Plugin, canonical, index
from fluxvla_core.plugins.load import choose, is_core, unread_group
from fluxvla_core.registries import GROUPS, PREFIX

FORMAT = "fluxvla-doctor-1"
IMPORT_LIMIT_S = 120
"""Seconds that one import may take."""

Kind = Literal[
    "unreadable",
    "unread group",
    "collision",
    "shadowed",
    "stale",
    "cannot work",
    "requirement",
    "import",
    "machine",
]


@dataclass(frozen=True)
class Finding:
    """One thing that the doctor found.

    Args:
        kind: its subject.
        problem: whether something does not work; else it is a note.
        distribution: the one concerned; None if unknown, or several are.
        text: the finding and what to do, for people.
    """

    kind: Kind
    problem: bool
    distribution: str | None
    text: str


class Doctor:
    help = (
        "Look for distributions that cannot be read, names that collide, requirements that do not "
        "hold, unknown groups, syntax errors, and entry points to nothing; then import every "
        "plugin, each distribution in a process of its own, and check its classes against their "
        "contracts. Then list what the machine has: torch, CUDA, ROS 2, rendering, disks, memory."
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
        add_json(parser)

    def run(self, args: argparse.Namespace) -> int:
        from fluxvla_core.cli import machine

        found = []
        for finding in findings(args.no_import, args.limit):
            found.append(finding)
            if not args.json:
                say(_line(finding))
        facts = machine.facts(None if args.no_import else args.limit)
        for problem, text in machine.remarks(facts):
            found.append(Finding("machine", problem, None, text))
            if not args.json:
                say(_line(found[-1]))
        healthy = not any(finding.problem for finding in found)
        plugins = list(_read_groups())
        dists = {p.dist for p in plugins}
        if args.json:
            report = {
                "format": FORMAT,
                "healthy": healthy,
                "imported": not args.no_import,
                "plugins": len(plugins),
                "distributions": len(dists),
                "findings": [asdict(finding) for finding in found],
                "machine": facts,
            }
            say(json.dumps(report, indent=1))
        else:
            if healthy:
                looked = " in metadata and sources" if args.no_import else ""
                say(
                    f"no problems{looked}: {len(plugins)} plugin(s) of {len(dists)} distribution(s)"
                )
            say("\n".join(["machine", *machine.lines(facts)]))
        return EXIT_DONE if healthy else EXIT_FAILED


def _line(finding: Finding) -> str:
    return finding.text if finding.problem else f"note: {finding.text}"


def findings(no_import: bool, limit_s: float) -> Iterator[Finding]:
    """Problems of everything that is installed, as they are found.

    Args:
        limit_s: seconds that one import may take.
    """
    from fluxvla_core.plugins.editable import stale

    yield from collisions()
    for one in stale(index()):
        yield Finding("stale", True, one.dist, str(one))
    yield from _requirements()
    importable = []
    for plugin in _read_groups():
        text = _cannot_work(plugin)
        if text is None:
            importable.append(plugin)
        else:
            yield Finding("cannot work", True, plugin.dist, f"{plugin.group}: {text}")
    if not no_import:
        from fluxvla_core.plugins import import_check

        traces = os.environ.get(STRICT) == "1"
        for plugin, text in import_check.problems(importable, limit_s, traces, _show_progress):
            yield Finding("import", True, plugin.dist, f"{plugin.group}: {text}")


def collisions() -> Iterator[Finding]:
    """One finding for each distribution, group or name that the index has trouble with."""
    for line in index().broken:
        yield Finding("unreadable", True, None, f"cannot be read: {line}")
    for (group, name), many in sorted(index().plugins.items()):
        if group not in GROUPS:
            for plugin in many:
                yield Finding("unread group", True, plugin.dist, unread_group(plugin))
            continue
        if any(map(is_core, many)):
            strangers = [p for p in many if not is_core(p)]
            for plugin in strangers:
                text = f"{name!r} always means the core's; {plugin.origin} has one, too, "
                text += f"which a config names '{plugin.dist}:{name}'"
                yield Finding("shadowed", False, plugin.dist, f"{group}: {text}")
        elif len(many) > 1:
            who = ", ".join(p.origin for p in many)
            text = f"{group}: {name!r} is provided by {who}; {choose(many)}"
            yield Finding("collision", True, None, text)
        if group == PREFIX + "commands" and name in RESERVED:
            for plugin in many:
                text = f"{plugin.origin}: the command {name!r} is the core's own; this one is run "
                text += f"as fluxvla {plugin.dist}:{name}"
                yield Finding("shadowed", False, plugin.dist, text)


def _requirements() -> Iterator[Finding]:
    """Dependencies that a distribution with plugins declares and that are not there.

    The core's own are looked at where a plugin asks for one of its extras.
    """
    seen: set[str] = set()
    for plugin in _read_groups():
        if plugin.dist not in seen and not is_core(plugin):
            seen.add(plugin.dist)
            for text in unmet_requirements(plugin):
                yield Finding("requirement", True, plugin.dist, text)


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


def unmet_requirements(plugin: Plugin) -> Iterator[str]:
    """One text for each requirement of ``plugin``'s distribution that does not hold.

    Those of extras that it asks of others (``fluxvla-core[data]``) are followed; its own extras are
    the user's choice. What it needs of the core is checked where it is loaded.
    """
    yield from _unmet(plugin.requires, frozenset({""}), plugin.origin, set())


def _unmet(
    requires: tuple[str, ...], extras: frozenset[str], whose: str, seen: set[tuple[str, str]]
) -> Iterator[str]:
    """Requirements of ``requires`` whose markers hold with one of ``extras``."""
    for text in requires:
        try:
            wanted = Requirement(text)
        except InvalidRequirement:  # reported by ``plugins.load.unmet``
            continue
        marker = wanted.marker
        if marker is not None and not any(marker.evaluate({"extra": extra}) for extra in extras):
            continue
        if "" not in extras and (marker is None or marker.evaluate({"extra": ""})):
            continue  # it is required without these extras, too
        have = _metadata.version(wanted.name)
        stated = f"{wanted.name}{wanted.specifier}"
        if have is None:
            yield f"{whose} requires {stated}, which is not installed: pip install '{stated}'"
            continue
        met = wanted.specifier.contains(have, prereleases=True)
        if not met and canonical(wanted.name) != CORE:
            yield f"{whose} requires {stated}, but {wanted.name} {have} is installed"
        new = {e for e in wanted.extras if (canonical(wanted.name), e) not in seen}
        if new:
            seen |= {(canonical(wanted.name), e) for e in new}
            through = f"{whose} requires {wanted.name}[{','.join(sorted(new))}], and that"
            yield from _unmet(_metadata.requirements(wanted.name), frozenset(new), through, seen)
