"""Which task a robot is asked to do: never a default one, and what is unknown is refused."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

from fluxvla_core.errors import UsageError


@dataclass(frozen=True)
class Task:
    """``name`` goes into file names, ``instruction`` to the policy."""

    name: str
    instruction: str


def resolve_task(given: str, known: Mapping[str, str]) -> Task:
    """The task that ``--task`` means: an id of the config, or an instruction in words.

    A single word is always an id, so that a mistyped one never becomes an instruction.

    Args:
        given: what the user said.
        known: id -> instruction, the config's ``task_descriptions``.

    Raises:
        UsageError: empty, or an id that is not known; lists those that are.
    """
    text = " ".join(given.split())
    if text in known:
        return Task(text, known[text])
    if " " in text:
        ids = [key for key, instruction in known.items() if instruction == text]
        return Task(ids[0] if ids else text, text)
    lines = [f"  {key}: {instruction}" for key, instruction in known.items()]
    listing = "\n".join(["known tasks:", *lines]) if lines else "the config lists no tasks"
    raise UsageError(
        f"unknown task {text!r}; nothing was moved\n{listing}",
        next="--task ID, or --task 'an instruction of two words or more'",
    )


def tasks(
    given: str | None,
    known: Mapping[str, str],
    ask: Callable[[str], str] = input,
    say: Callable[[str], None] = print,
    terminal: bool | None = None,
) -> Iterator[Task]:
    """The tasks of a run: the one that was given, or what a person at the terminal asks for.

    Args:
        given: ``--task``, or None.
        known: id -> instruction.
        ask: reads one line.
        say: shows one line.
        terminal: whether somebody can answer; by default whether stdin is a terminal.

    Raises:
        UsageError: the task is unknown, or there is none and nobody to ask.
    """
    if given is not None:
        yield resolve_task(given, known)
        return
    if not (sys.stdin.isatty() if terminal is None else terminal):
        ids = f"one of {', '.join(known)}, or an" if known else "an"
        raise UsageError(
            "no task was given, and there is no terminal to ask at; nothing was moved",
            next=f"--task with {ids} instruction in words",
        )
    while True:
        for key, instruction in known.items():
            say(f"  {key}: {instruction}")
        line = ask("task id or instruction (empty ends): ").strip()
        if not line:
            return
        try:
            task = resolve_task(line, known)
        except UsageError as error:
            say(str(error))
            continue
        yield task


def check_descriptions(known: Mapping[str, str] | None) -> dict[str, str]:
    """``task_descriptions`` as id -> instruction; ids are compared as text.

    Raises:
        UsageError: an instruction is empty, or an id is empty or has a blank in it.
    """
    checked: dict[str, str] = {}
    for key, instruction in (known or {}).items():
        name = str(key)
        if not name or " " in name:
            raise UsageError(f"task_descriptions: an id is one word, got {name!r}")
        if not isinstance(instruction, str) or not instruction.strip():
            raise UsageError(f"task_descriptions: task {name!r} has no instruction")
        checked[name] = " ".join(instruction.split())
    return checked
