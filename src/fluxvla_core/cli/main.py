"""``fluxvla``: find the command, run it, turn errors into messages and exit codes.

Exit codes: 0 done, 1 failed, 2 bad input, 130 interrupted.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Sequence
from typing import Any

from fluxvla_core.cli.table import COMMANDS
from fluxvla_core.errors import EXIT_DONE, EXIT_FAILED, EXIT_INTERRUPTED, FluxError, UsageError

STRICT = "FLUXVLA_STRICT"
USAGE = "usage: fluxvla COMMAND ...   (fluxvla COMMAND --help says what it takes)"


def main(argv: Sequence[str] | None = None) -> int:
    """The console script; returns the exit code and never raises.

    ``FLUXVLA_STRICT=1`` prints the traceback of every error, expected ones too.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    try:
        return dispatch(words)
    except BrokenPipeError:  # `fluxvla plugins list | head`
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115 - the interpreter flushes it at exit
        return EXIT_FAILED
    except SystemExit as end:  # argparse's --help, or a plugin's own exit
        if isinstance(end.code, str):
            print(end.code, file=sys.stderr)
            return EXIT_FAILED
        return end.code or EXIT_DONE
    except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001 - reported with its traceback
        return report(error)


def report(error: BaseException) -> int:
    """Say what went wrong on stderr, and give the exit code that belongs to it."""
    from fluxvla_core.cli import ranks

    if isinstance(error, KeyboardInterrupt):
        text, code = f"interrupted{f': {error}' if str(error) else ''}", EXIT_INTERRUPTED
    elif isinstance(error, FluxError):
        text, code = str(error), error.exit_code
        if os.environ.get(STRICT) == "1":
            text = _trace(error).rstrip()
    else:
        text, code = _trace(error).rstrip(), EXIT_FAILED
    if not ranks.record(text, code, expected=isinstance(error, FluxError)):
        print(text, file=sys.stderr)
    return code


def _trace(error: BaseException) -> str:
    import traceback

    return "".join(traceback.format_exception(type(error), error, error.__traceback__))


def dispatch(words: list[str]) -> int:
    """Run the command that ``words`` begin with.

    Raises:
        UsageError: there is no such command, or its arguments are wrong.
    """
    if not words or words[0] in {"-h", "--help", "help"}:
        print(overview())
        return EXIT_DONE
    if words[0] == "--version":
        words = ["version"]
    for length in (2, 1):
        name = " ".join(words[:length])
        if name in COMMANDS and len(words) >= length:
            module, _, attribute = COMMANDS[name].target.partition(":")
            return execute(
                name, getattr(importlib.import_module(module), attribute), words[length:]
            )
    inside = [name for name in COMMANDS if name.startswith(f"{words[0]} ")]
    if inside:
        return _group(words, inside)
    from fluxvla_core.plugins.registry import BY_NAME

    plugins = BY_NAME["commands"]
    if words[0] in plugins:
        return execute(words[0], plugins.get(words[0]), words[1:])
    raise _unknown(words[0], [*COMMANDS, *plugins])


def execute(name: str, command: Any, words: list[str]) -> int:
    """Parse ``words`` for ``command`` (a class of the Command contract) and run it."""
    from fluxvla_core.cli.parser import Parser

    made = command()
    parser = Parser(f"fluxvla {name}", str(made.help))
    made.add_arguments(parser)
    return int(made.run(parser.parse(words)))


def _group(words: list[str], inside: list[str]) -> int:
    if len(words) == 1 or words[1] in {"-h", "--help"}:
        print("\n".join(_rows(inside)))
        return EXIT_DONE
    near = _close(words[1], [name.split()[1] for name in inside])
    hint = f"; did you mean 'fluxvla {words[0]} {near[0]}'?" if near else ""
    raise UsageError(
        f"fluxvla {words[0]} has no {words[1]!r}{hint}", next=f"fluxvla {words[0]} --help"
    )


def _close(word: str, names: list[str]) -> list[str]:
    import difflib  # with traceback above, a tenth of what `fluxvla --help` may take

    return difflib.get_close_matches(word, names, 1)


def _unknown(word: str, names: list[str]) -> UsageError:
    if word.startswith("-"):
        return UsageError(
            f"unknown argument {word!r}: the command comes first", next="fluxvla run --help"
        )
    near = _close(word, [*names, "config", "data", "eval", "plugins"])
    hint = f"; did you mean 'fluxvla {near[0]}'?" if near else ""
    return UsageError(f"no command {word!r}{hint}", next="fluxvla --help")


def overview() -> str:
    """What ``fluxvla --help`` prints; plugins' commands are listed, not imported."""
    from fluxvla_core.plugins._metadata import index

    lines = [USAGE, "", *_rows(list(COMMANDS))]
    theirs = {
        name: providers
        for (group, name), providers in sorted(index().plugins.items())
        if group == "fluxvla.commands"
    }
    width = _width(list(COMMANDS))
    lines += [
        f"  {name:{width}}  (from {', '.join(p.origin for p in providers)})"
        for name, providers in theirs.items()
    ]
    return "\n".join(lines)


def _rows(names: list[str]) -> list[str]:
    width = _width(list(COMMANDS))
    return [f"  {name:{width}}  {COMMANDS[name].help}" for name in names]


def _width(names: list[str]) -> int:
    return max(len(name) for name in names)
