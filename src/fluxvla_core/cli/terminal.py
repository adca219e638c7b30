"""Print to a terminal: messages without tracebacks, and escape sequences made harmless."""

from __future__ import annotations

import io
import os
import sys
from contextlib import suppress
from typing import TextIO

from fluxvla_core.errors import EXIT_FAILED, printable


class OutputFailed(OSError):
    """stdout takes no more: its disk is full, or its reader has gone."""


def say(text: str, stream: TextIO | None = None) -> None:
    """Print text that may hold names from files: terminal escapes in it are shown, not obeyed.

    Raises:
        OutputFailed: it cannot be written.
    """
    try:
        print(printable(text), file=stream, flush=True)
    except OSError as error:
        raise OutputFailed(error.errno, error.strerror) from error


def prepare() -> None:
    """Make stdout and stderr accept any text: characters that they cannot encode become escapes.

    A standard stream that is closed (``fluxvla ... <&-``) becomes the null device: the next file
    that is opened would get its number otherwise, and be another process's stdin.
    """
    for descriptor, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        if getattr(sys, name) is None and not _is_open(descriptor):
            null = open(os.devnull, mode)  # noqa: SIM115 - as long as the process
            os.set_inheritable(null.fileno(), True)
            setattr(sys, name, null)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _is_open(descriptor: int) -> bool:
    try:
        os.fstat(descriptor)
    except OSError:
        return False
    return True


def give_up(error: OSError) -> int:
    """The exit code where stdout takes no more; said on stderr, unless its reader just left."""
    broken = isinstance(error, BrokenPipeError) or isinstance(error.__cause__, BrokenPipeError)
    if not broken:  # `fluxvla plugins list | head`
        with suppress(OSError):  # stderr is full as well: there is nowhere to say it
            print(f"the output cannot be written: {error.strerror or error}", file=sys.stderr)
    sys.stdout = open(os.devnull, "w")  # noqa: SIM115 - the interpreter flushes it at exit
    return EXIT_FAILED
