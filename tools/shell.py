"""Run commands with their output shown; an interrupt leaves them time to save."""

from __future__ import annotations

import os
import shlex
import subprocess
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

# A training run that is interrupted writes one last checkpoint; on two slow cores that takes
# seconds, and a minute is what a full disk or a network drive may need.
INTERRUPT_SECONDS = 60.0


class StepFailed(Exception):
    """A command ended with an exit status other than 0.

    ``status`` is the exit status of ``command``; ``output`` its output if it was captured
    (``quiet=True``), else the empty string.
    """

    def __init__(self, command: Sequence[str], status: int, output: str = "") -> None:
        self.command = tuple(command)
        self.status = status
        self.output = output
        shown = f"\n{output.rstrip()}" if output else ""
        super().__init__(f"exit status {status} from: {shlex.join(self.command)}{shown}")


def child_environment(extra: Mapping[str, str] | None = None) -> dict[str, str]:
    """The environment of this process without what would leak another Python into a child.

    Nor may it keep a child from writing bytecode: every process would compile torch again.
    """
    left_out = ("PYTHONPATH", "PYTHONHOME", "PYTHONDONTWRITEBYTECODE", "__PYVENV_LAUNCHER__")
    env = {k: v for k, v in os.environ.items() if k not in left_out}
    env["PYTHONUNBUFFERED"] = "1"
    env.update(extra or {})
    return env


def run(
    command: Sequence[str | os.PathLike[str]],
    *,
    cwd: Path | None = None,
    env: Mapping[str, str] | None = None,
    quiet: bool = False,
    echo: bool = True,
) -> str:
    """Run one command and return what it printed (the empty string unless ``quiet``).

    ``env`` is added to ``child_environment()``. With ``quiet`` stdout and stderr are kept back and
    come with the error. On Ctrl-C the child, which got the same signal, is given
    ``INTERRUPT_SECONDS`` to end by itself, then it is terminated; ``KeyboardInterrupt`` goes on.
    Raises StepFailed on any exit status but 0, and on a program that cannot be started (127).
    """
    words = [os.fspath(word) for word in command]
    if echo:
        print(f"$ {shlex.join(words)}", flush=True)
    sink = subprocess.PIPE if quiet else None
    try:
        child = subprocess.Popen(
            words,
            cwd=cwd,
            env=child_environment(env),
            stdout=sink,
            stderr=subprocess.STDOUT if quiet else None,
            text=True,
        )
    except OSError as error:
        raise StepFailed(words, 127, str(error)) from error
    try:
        output, _ = child.communicate()
    except KeyboardInterrupt:
        _let_it_end(child)
        raise
    if child.returncode:
        raise StepFailed(words, child.returncode, output or "")
    return output or ""


@contextmanager
def alongside(command: Sequence[str | os.PathLike[str]], *, cwd: Path) -> Iterator[None]:
    """Run a command while the body does something else, and wait for it after that.

    Its output is captured, and shown if it fails, which raises nothing. A body that fails ends it.
    """
    words = [os.fspath(word) for word in command]
    print(f"$ {shlex.join(words)} &", flush=True)
    with tempfile.TemporaryFile("w+", encoding="utf-8") as output:
        child = subprocess.Popen(
            words, cwd=cwd, env=child_environment(), stdout=output, stderr=subprocess.STDOUT
        )
        try:
            yield
            child.wait()
        finally:
            if child.poll() is None:
                child.terminate()
                _let_it_end(child)
        if child.returncode:
            output.seek(0)
            print(f"exit status {child.returncode} from: {shlex.join(words)}\n{output.read()}")


def _let_it_end(child: subprocess.Popen[Any]) -> None:
    for stop, seconds in ((None, INTERRUPT_SECONDS), (child.terminate, 10.0), (child.kill, None)):
        if stop is not None:
            stop()
        try:
            child.wait(timeout=seconds)
            return
        except (subprocess.TimeoutExpired, KeyboardInterrupt):
            continue
