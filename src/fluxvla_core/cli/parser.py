"""Argument parser of the commands, and the options that several of them share.

``argparse`` with a did-you-mean for unknown options, without abbreviations and repeats.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any, NoReturn

from fluxvla_core.errors import UsageError, nearest


class Parser(argparse.ArgumentParser):
    """One command's arguments. Errors are raised as UsageError, never printed and exited."""

    def __init__(self, prog: str, description: str) -> None:
        super().__init__(prog=prog, description=description, allow_abbrev=False)

    def error(self, message: str) -> NoReturn:
        raise UsageError(message, where=self.prog, next=f"{self.prog} --help")

    def parse(self, argv: Sequence[str]) -> argparse.Namespace:
        """Parse ``argv``; anything that is not known is an error with a suggestion.

        Raises:
            UsageError: an unknown, repeated, missing or malformed argument.
        """
        args, extra = self.parse_known_args(argv)
        if extra:
            known = [flag for action in self._actions for flag in action.option_strings]
            first = extra[0]
            if first.startswith("-"):
                near = nearest(first.partition("=")[0], known)
                hint = f"; did you mean {near}?" if near else ""
            elif "--config" in known and args.config is None:
                hint = f"; did you mean --config {first}?"
            else:
                hint = ""
            self.error(f"unknown argument {first!r}{hint}")
        return args

    def once(self, *flags: str, **options: Any) -> None:
        """An option that may be given once: of two values one would silently be lost."""
        self.add_argument(*flags, action=_Once, **options)


class _Once(argparse.Action):
    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        seen = namespace.__dict__.setdefault("_seen", set())
        if self.dest in seen:
            parser.error(f"{option_string} is given twice")
        seen.add(self.dest)
        setattr(namespace, self.dest, values)


def positive(text: str) -> int:
    """A whole number from 1."""
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"{text} is less than 1")
    return number


def natural(text: str) -> int:
    """A whole number from 0."""
    number = int(text)
    if number < 0:
        raise argparse.ArgumentTypeError(f"{text} is less than 0")
    return number


def add_config_file(parser: argparse.ArgumentParser) -> None:
    """The positional argument ``FILE``: a config."""
    parser.add_argument("file", help="a .py, .toml or config.resolved.json")


def add_json(parser: argparse.ArgumentParser) -> None:
    """``--json``."""
    parser.add_argument("--json", action="store_true", help="print JSON")


def add_log_format(parser: Parser) -> None:
    """``--log-format``."""
    parser.once(
        "--log-format", choices=("text", "json"), default="text", help="format of progress messages"
    )


def add_overrides(parser: argparse.ArgumentParser) -> None:
    """``--set k=v`` (repeatable) and its alias ``--cfg-options k=v k=v ...``."""
    parser.add_argument(
        "--set",
        dest="overrides",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="set a key of the config (a TOML value); += appends to a list, or adds any key",
    )
    parser.add_argument(
        "--cfg-options",
        dest="overrides",
        action="extend",
        nargs="+",
        default=[],
        metavar="KEY=VALUE",
        help="the same, for several",
    )


def add_plugin_files(parser: argparse.ArgumentParser) -> None:
    """``--plugin FILE`` (repeatable)."""
    parser.add_argument(
        "--plugin",
        dest="plugin_files",
        action="append",
        default=[],
        metavar="FILE",
        help="a Python file that registers classes of its own, executed first",
    )
