"""``fluxvla``: find the command, run it, turn errors into messages and exit codes.

A command is a class with ``help``, ``add_arguments(parser)`` and ``run(args) -> exit code``
(``contracts.runner.Command``); a plugin's own (group ``fluxvla.commands``) is the same.

Exit codes: 0 done, 1 failed, 2 bad input, 130 interrupted.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any, NamedTuple

from fluxvla_core.cli.terminal import OutputFailed, give_up, prepare, say
from fluxvla_core.errors import (
    EXIT_DONE,
    EXIT_FAILED,
    EXIT_INTERRUPTED,
    EndReason,
    FluxError,
    RunFailed,
    UsageError,
    nearest,
)

if TYPE_CHECKING:
    import argparse

    from fluxvla_core.cli.parser import Parser

STRICT = "FLUXVLA_STRICT"
USAGE = "usage: fluxvla COMMAND ...   (fluxvla COMMAND --help says what it takes)"


class Entry(NamedTuple):
    """A command: its class as ``module:Class``, and its line in ``fluxvla --help``."""

    target: str
    help: str


COMMANDS: Mapping[str, Entry] = {
    name: Entry(f"fluxvla_core.cli.{place}", help)
    for name, place, help in (
        ("run", "run:Run", "run a section of a config: train, evaluate, deploy"),
        ("config show", "config_commands:Show", "print the config as it resolves"),
        ("config check", "config_commands:Check", "check a config without importing anything"),
        ("config diff", "config_commands:Diff", "compare two configs, or runs, key by key"),
        ("config schema", "config_commands:Schema", "print a JSON Schema for editors"),
        ("plugins list", "plugin_commands:List", "list what is installed"),
        ("plugins show", "plugin_commands:Show", "show one class: its keys, its origin"),
        ("plugins doctor", "doctor:Doctor", "look for what is wrong with the installation"),
        ("plugins check", "check_plugin:CheckPlugin", "run the conformance kit of one class"),
        ("new-plugin", "new_plugin:NewPlugin", "begin a plugin that builds, is tested and runs"),
        ("data inspect", "data_commands:Inspect", "print what a dataset holds"),
        ("data validate", "data_commands:Validate", "read every row, decode every frame"),
        ("data stats", "data_commands:Stats", "print exact statistics of a dataset"),
        ("data convert", "data_commands:Convert", "write recordings, or LeRobot v2, as v3.0"),
        ("data finish", "data_commands:Finish", "finish a recording that was cut short"),
        ("data collect", "data_commands:Collect", "record demonstrations of a scripted expert"),
        ("eval compare", "policy_commands:Compare", "compare two evaluations, pair by pair"),
        ("export", "policy_commands:Export", "export a checkpoint for inference"),
        (
            "import-checkpoint",
            "policy_commands:Import",
            "import another project's checkpoint",
        ),
        ("bench-policy", "bench_command:BenchPolicy", "measure how long a policy takes to answer"),
        ("version", "main:Version", "print the versions"),
    )
}
"""Every command by its name. Only the one that is called is imported."""

_WIDTH = max(map(len, COMMANDS))

RESERVED = frozenset({*COMMANDS, *(name.partition(" ")[0] for name in COMMANDS), "help"})
"""First words that always mean the core's; a plugin's is run as ``fluxvla distribution:name``."""


def main(argv: Sequence[str] | None = None) -> int:
    """The console script; returns the exit code and never raises.

    ``FLUXVLA_STRICT=1`` prints the traceback of every error, expected ones too.
    """
    prepare()
    code = _run(list(sys.argv[1:] if argv is None else argv))
    try:
        if sys.stdout is not None:  # `fluxvla ... >&-`
            sys.stdout.flush()  # what a plugin's command, or argparse, printed
    except OSError as error:
        return give_up(error)
    return code


def _run(argv: list[str]) -> int:
    try:
        return dispatch(argv)
    except (BrokenPipeError, OutputFailed) as error:
        return give_up(error)
    except SystemExit as end:  # argparse's --help, or a plugin's own exit
        if isinstance(end.code, str):
            return _complain(end.code, EXIT_FAILED)
        return end.code or EXIT_DONE
    except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001 - reported with its traceback
        return report(error)


def report(error: BaseException) -> int:
    """Print an error to stderr; returns its exit code."""
    from fluxvla_core.cli import ranks

    if isinstance(error, KeyboardInterrupt):
        text, code = f"interrupted{f': {error}' if str(error) else ''}", EXIT_INTERRUPTED
    elif isinstance(error, FluxError):
        text, code = str(error), error.exit_code
        if os.environ.get(STRICT) == "1":
            text = _trace(error).rstrip()
    else:
        text, code = _trace(error).rstrip(), EXIT_FAILED
    expected = isinstance(error, FluxError)
    if not ranks.record_failure(text, code, expected=expected, reason=_end_reason(error)):
        _complain(text, code)
    return code


def _end_reason(error: BaseException | None) -> EndReason | None:
    """Why a run ended, if that is known; for an error while closing, what it was closed for."""
    while isinstance(error, Exception) and not isinstance(error, FluxError):
        error = error.__cause__ or error.__context__
    return error.reason if isinstance(error, RunFailed) else None


def _complain(text: str, code: int) -> int:
    with suppress(OSError):  # stderr is full, or gone
        say(text, sys.stderr)
    return code


def _trace(error: BaseException) -> str:
    import traceback

    return "".join(traceback.format_exception(type(error), error, error.__traceback__))


def dispatch(argv: list[str]) -> int:
    """Run the command that ``argv`` begin with.

    Raises:
        UsageError: there is no such command, or its arguments are wrong.
    """
    if not argv or argv[0] in {"-h", "--help", "help"}:
        say(overview())
        return EXIT_DONE
    if argv[0] == "--version":
        argv = ["version"]
    for length in (2, 1):
        name = " ".join(argv[:length])
        if name in COMMANDS and len(argv) >= length:
            module, _, attribute = COMMANDS[name].target.partition(":")
            return execute(name, getattr(importlib.import_module(module), attribute), argv[length:])
    inside = [name for name in COMMANDS if name.startswith(f"{argv[0]} ")]
    if inside:
        return _group(argv, inside)
    from fluxvla_core.plugins.registry import BY_NAME

    plugins = BY_NAME["commands"]
    if argv[0] in plugins:
        return execute(argv[0], plugins.get(argv[0]), argv[1:])
    from fluxvla_core.plugins import first_party
    from fluxvla_core.plugins.load import not_read

    unread = not_read(argv[0])
    if unread:
        raise UsageError(f"no command {argv[0]!r}; {unread}", next="fluxvla --help")
    owner = first_party.owner("commands", argv[0])
    if owner is not None:
        raise UsageError(
            f"fluxvla {argv[0]} comes with {owner}, which is not installed",
            next=f"pip install {owner}",
        )
    raise _unknown(argv[0], [*COMMANDS, *plugins])


def execute(name: str, command: Any, argv: list[str]) -> int:
    """Parse ``argv`` for ``command`` (a class of the Command contract) and run it."""
    from fluxvla_core.cli.parser import Parser

    made = command()
    parser = Parser(f"fluxvla {name}", str(made.help))
    made.add_arguments(parser)
    return int(made.run(parser.parse(argv)))


def _group(argv: list[str], inside: list[str]) -> int:
    if len(argv) == 1 or argv[1] in {"-h", "--help"}:
        say("\n".join(_rows(inside)))
        return EXIT_DONE
    near = nearest(argv[1], [name.split()[1] for name in inside])
    hint = f"; did you mean 'fluxvla {argv[0]} {near}'?" if near else ""
    raise UsageError(
        f"fluxvla {argv[0]} has no {argv[1]!r}{hint}", next=f"fluxvla {argv[0]} --help"
    )


def _unknown(word: str, names: list[str]) -> UsageError:
    if word.startswith("-"):
        return UsageError(
            f"unknown argument {word!r}: the command comes first", next="fluxvla run --help"
        )
    near = nearest(word, [*names, "config", "data", "eval", "plugins"])
    hint = f"; did you mean 'fluxvla {near}'?" if near else ""
    return UsageError(f"no command {word!r}{hint}", next="fluxvla --help")


def overview() -> str:
    """The text of ``fluxvla --help``; plugins' commands are read from source, not imported."""
    from fluxvla_core.config.signature import read_help
    from fluxvla_core.plugins._metadata import index

    lines = [USAGE, "", *_rows(list(COMMANDS))]
    for (group, name), providers in sorted(index().plugins.items()):
        for plugin in providers if group == "fluxvla.commands" else ():
            word = name if len(providers) == 1 and name not in RESERVED else f"{plugin.dist}:{name}"
            about = read_help(plugin).partition(". ")[0].rstrip(".")
            lines.append(f"  {word:{_WIDTH}}  {about + ' ' if about else ''}(from {plugin.origin})")
    return "\n".join(lines)


def _rows(names: list[str]) -> list[str]:
    return [f"  {name:{_WIDTH}}  {COMMANDS[name].help}" for name in names]


class Version:
    help = "Print the versions of the core and of Python."

    def add_arguments(self, parser: Parser) -> None:
        return

    def run(self, args: argparse.Namespace) -> int:
        import platform

        from fluxvla_core import __version__

        say(f"fluxvla-core {__version__}, Python {platform.python_version()}")
        return 0
