"""``fluxvla config show``, ``check``, ``diff`` and ``schema``; the differences of two configs."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from difflib import SequenceMatcher
from pathlib import Path
from typing import Any

from fluxvla_core import atomic
from fluxvla_core.cli.parser import Parser, add_config_file, add_overrides, add_plugin_files
from fluxvla_core.cli.plan import choose_section
from fluxvla_core.cli.terminal import say
from fluxvla_core.config.check import Use, examine
from fluxvla_core.config.load import CONFIG_FILE, load_config
from fluxvla_core.config.overrides import apply_overrides
from fluxvla_core.config.tree import Config, join_key, leaves
from fluxvla_core.errors import EXIT_DONE, UsageError
from fluxvla_core.plugins.registry import load_plugin_files


class Show:
    help = (
        "Print the config as it resolves, one key a line, as --set takes them. A .py config is "
        "executed."
    )

    def add_arguments(self, parser: Parser) -> None:
        add_config_file(parser)
        parser.add_argument("--origin", action="store_true", help="add where each key is written")
        add_overrides(parser)

    def run(self, args: argparse.Namespace) -> int:
        config = apply_overrides(load_config(args.file), args.overrides)
        for line in listing(config, origin=args.origin):
            say(line)
        return 0


class Check:
    help = (
        "Check a config against the classes that it names: types, unknown and missing keys, all "
        "problems at once. No plugin is imported; a .py config is executed."
    )

    def add_arguments(self, parser: Parser) -> None:
        add_config_file(parser)
        parser.once("--section", help="only the plugins of this section have to be installed")
        add_overrides(parser)
        add_plugin_files(parser)

    def run(self, args: argparse.Namespace) -> int:
        load_plugin_files(args.plugin_files)
        config = apply_overrides(load_config(args.file), args.overrides)
        checked = examine(config, args.section)
        if args.section is not None:
            choose_section(config, checked, args.section)
        if checked.problems:
            raise checked.error()
        say(f"{config.file}: no problems; sections: {', '.join(checked.sections) or 'none'}")
        for line in used(checked.uses):
            say(line)
        return 0


class Diff:
    help = (
        "Compare two configs as they resolve: keys that were removed (-), added (+) or changed "
        "(both), each with its file and line. Exit code 0: equal, 1: different, 2: one cannot be "
        "read. A .py config is executed."
    )

    def add_arguments(self, parser: Parser) -> None:
        takes = "a .py, .toml or config.resolved.json; or a work dir or checkpoint, which has one"
        parser.add_argument("old", metavar="A", help=takes)
        parser.add_argument("new", metavar="B", help="the same, to compare with A")

    def run(self, args: argparse.Namespace) -> int:
        old, new = (load_config(_config_of(Path(name))) for name in (args.old, args.new))
        changes = differences(old, new)
        for line in changed(changes):
            say(line)
        return 1 if changes else EXIT_DONE  # as diff(1)


class Schema:
    help = (
        "Print a JSON Schema (draft 2020-12) of the configs that what is installed can run, with "
        "which an editor completes and checks TOML. No plugin is imported."
    )

    def add_arguments(self, parser: Parser) -> None:
        parser.once("--out", metavar="FILE", help="write it to this file instead")
        add_plugin_files(parser)

    def run(self, args: argparse.Namespace) -> int:
        from fluxvla_core.config.schema import config_schema

        load_plugin_files(args.plugin_files)
        schema = config_schema()
        if args.out is None:
            say(atomic.json_text(schema, indent=1))
            return EXIT_DONE
        try:
            atomic.write_json(Path(args.out), schema)
        except OSError as error:
            raise UsageError(f"--out {args.out}: {error.strerror or error}") from error
        say(f"wrote {args.out}")
        return EXIT_DONE


def _config_of(path: Path) -> Path:
    """The config of a work dir or checkpoint; any other path as it is."""
    inside = path / CONFIG_FILE
    return inside if inside.is_file() else path


def changed(changes: Iterable[Change]) -> list[str]:
    """``- key = value`` and ``+ key = value`` lines, each with its ``# file:line``."""
    pairs = [pair for one in changes for pair in (("-", one.old), ("+", one.new))]
    sides = [(sign, side) for sign, side in pairs if side is not None]
    texts = [f"{sign} {side.key} = {literal(side.value)}" for sign, side in sides]
    return _with_places(texts, [side.where for _, side in sides])


def listing(config: Config, origin: bool) -> list[str]:
    """``key = value`` lines; with ``origin`` each ends in its ``# file:line``."""
    found = list(leaves(config.tree))
    texts = [f"{key} = {literal(value)}" for key, value in found]
    if not origin:
        return texts
    return _with_places(texts, [_places(config, key, value) for key, value in found])


def _with_places(texts: list[str], places: list[str]) -> list[str]:
    width = min(max(map(len, texts), default=0), 60)
    return [f"{text:{width}}  # {place}" for text, place in zip(texts, places, strict=True)]


def _places(config: Config, key: str, value: Any) -> str:
    """Where ``key`` was written, and what was appended to it on the command line."""
    items = range(len(value)) if isinstance(value, list) else ()
    appended = [place for i in items if (place := config.where(join_key(key, i))).startswith("--")]
    return ", ".join(dict.fromkeys([config.where(key), *appended]))


def literal(value: Any) -> str:
    """``value`` as ``--set`` would take it."""
    if value is None:
        return "None"
    if isinstance(value, list):
        return f"[{', '.join(map(literal, value))}]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{k} = {literal(v)}" for k, v in value.items()) + "}"
    if isinstance(value, (bool, str)):
        return json.dumps(value, ensure_ascii=False)
    return repr(value)


def used(uses: Iterable[Use]) -> list[str]:
    """A table of the classes that a config names and who provides them."""
    rows = [(use.key, use.found.title, use.found.origin) for use in uses]
    if not rows:
        return []
    widths = [max(len(row[i]) for row in rows) for i in range(2)]
    return [f"  {key:{widths[0]}}  {name:{widths[1]}}  {origin}" for key, name, origin in rows]


@dataclass(frozen=True)
class Side:
    """One key of one config: its leaf value and ``file:line``."""

    key: str
    value: Any
    where: str


@dataclass(frozen=True)
class Change:
    """A key that one of two configs lacks (its side is None), or that has another value."""

    old: Side | None
    new: Side | None


def differences(old: Config, new: Config) -> list[Change]:
    """The keys that differ between ``old`` and ``new``, in the order of ``new``, then removed ones.

    Values are compared as they are written: ``1`` and ``1.0`` and ``True`` differ, NaN equals NaN.
    Items of lists of tables (transforms) are aligned, so that an inserted one is one change; a key
    then has another number on each side.
    """
    return list(_Compare(old, new).tables(old.tree, new.tree, "", ""))


class _Compare:
    def __init__(self, old: Config, new: Config) -> None:
        self.old, self.new = old, new

    def tables(
        self, old: dict[str, Any], new: dict[str, Any], old_key: str, new_key: str
    ) -> Iterator[Change]:
        for name, value in new.items():
            inner = join_key(new_key, name)
            if name in old:
                yield from self.values(old[name], value, join_key(old_key, name), inner)
            else:
                yield from self.added(value, inner)
        for name, value in old.items():
            if name not in new:
                yield from self.removed(value, join_key(old_key, name))

    def values(self, old: Any, new: Any, old_key: str, new_key: str) -> Iterator[Change]:
        if isinstance(old, dict) and isinstance(new, dict) and old and new:
            yield from self.tables(old, new, old_key, new_key)
        elif isinstance(old, list) and isinstance(new, list) and _nested(old) and _nested(new):
            yield from self.lists(old, new, old_key, new_key)
        elif _text(old) != _text(new):
            if _leaf(old) and _leaf(new):
                yield Change(self._old(old_key, old), self._new(new_key, new))
            else:
                yield from self.removed(old, old_key)
                yield from self.added(new, new_key)

    def lists(self, old: list[Any], new: list[Any], old_key: str, new_key: str) -> Iterator[Change]:
        matcher = SequenceMatcher(None, [_text(v) for v in old], [_text(v) for v in new], False)
        for kind, a, a_end, b, b_end in matcher.get_opcodes():
            if kind == "equal":
                continue
            both = min(a_end - a, b_end - b)
            for i in range(both):
                keys = join_key(old_key, a + i), join_key(new_key, b + i)
                yield from self.values(old[a + i], new[b + i], *keys)
            for i in range(a + both, a_end):
                yield from self.removed(old[i], join_key(old_key, i))
            for i in range(b + both, b_end):
                yield from self.added(new[i], join_key(new_key, i))

    def added(self, value: Any, key: str) -> Iterator[Change]:
        yield from (Change(None, self._new(k, v)) for k, v in leaves(value, key))

    def removed(self, value: Any, key: str) -> Iterator[Change]:
        yield from (Change(self._old(k, v), None) for k, v in leaves(value, key))

    def _old(self, key: str, value: Any) -> Side:
        return Side(key, value, self.old.where(key))

    def _new(self, key: str, value: Any) -> Side:
        return Side(key, value, self.new.where(key))


def _nested(value: list[Any]) -> bool:
    return any(isinstance(item, (dict, list)) for item in value)


def _leaf(value: Any) -> bool:
    """Whether ``leaves`` takes it as one value."""
    return not value or (
        not isinstance(value, dict) and not (isinstance(value, list) and _nested(value))
    )


def _text(value: Any) -> str:
    return json.dumps(value, sort_keys=True)
