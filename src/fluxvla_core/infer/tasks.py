"""Which task a robot is asked to do: never a default one, and what is unknown is refused."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from fluxvla_core.errors import UsageError

REARM = "rearm"
"""What a person says after a stop, so that the robot may move again."""


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


def read_tasks(path: str | Path, known: Mapping[str, str]) -> list[Task]:
    """The tasks of a file, one a line: an id or an instruction; ``#`` begins a comment.

    Raises:
        UsageError: the file cannot be read, is empty, or has a line that is no task; no line of it
            counts then.
    """
    try:
        lines = Path(path).read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"the tasks cannot be read: {error}", where=str(path)) from error
    found = []
    for number, line in enumerate(lines, 1):
        text = line.partition("#")[0].strip()
        if not text:
            continue
        try:
            found.append(resolve_task(text, known))
        except UsageError as error:
            raise UsageError(error.what, where=f"{path}:{number}", next=error.next) from error
    if not found:
        raise UsageError("the file has no task in it; nothing was moved", where=str(path))
    return found


def check_descriptions(known: Mapping[str, str] | None) -> dict[str, str]:
    """``task_descriptions`` as id -> instruction; ids are compared as text.

    Raises:
        UsageError: an instruction is empty, or an id is empty, has a blank in it, or is the word
            that allows motion again after a stop.
    """
    checked: dict[str, str] = {}
    for key, instruction in (known or {}).items():
        name = str(key)
        if not name or " " in name:
            raise UsageError(f"task_descriptions: an id is one word, got {name!r}")
        if name == REARM:
            raise UsageError(f"task_descriptions: {REARM!r} means something else; rename the task")
        if not isinstance(instruction, str) or not instruction.strip():
            raise UsageError(f"task_descriptions: task {name!r} has no instruction")
        checked[name] = " ".join(instruction.split())
    return checked
