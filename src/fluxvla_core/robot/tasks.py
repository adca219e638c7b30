"""Tasks of a run, and where they come from: command line, file, terminal, ROS 2 topic.

There is never a default task, and an unknown one is refused. A source is polled for the
next line, so that the caller can hold the robot in between. What came in while the
robot was busy is not taken as an answer.
"""

from __future__ import annotations

import difflib
import os
import select
import sys
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from fluxvla_core.build import RunContext
from fluxvla_core.errors import UsageError
from fluxvla_core.untrusted import read_bytes

_LARGEST_FILE = 1 << 20
"""Bytes of a file of tasks."""
REARM = "rearm"
"""What a person says after a stop, so that the robot may move again."""


@dataclass(frozen=True)
class Task:
    """``name`` goes into file names, ``instruction`` to the policy.

    ``free``: the instruction is none of those that the config knows.
    """

    name: str
    instruction: str
    free: bool = False

    @property
    def warning(self) -> str:
        """The warning about an instruction that the config does not know."""
        return (
            f"{self.instruction!r} is not in the config's task_descriptions: the policy is not "
            "known to be trained on it, and the arm may do anything within its limits"
        )


def resolve_task(given: str, known: Mapping[str, str], free: bool = False) -> Task:
    """The task that ``--task`` means: an id or an instruction of the config.

    A policy takes any text for an instruction, a misspelt one too, and moves. So words that are no
    known instruction are refused unless ``free`` ones are asked for; a single word is always an id.

    Args:
        given: what the user said.
        known: id -> instruction, the config's ``task_descriptions``.
        free: whether other instructions are allowed, of two words or more.

    Raises:
        UsageError: empty, or not known; names the nearest known one, and lists all.
    """
    text = " ".join(given.split())
    if text in known:
        return Task(text, known[text])
    ids = [key for key, instruction in known.items() if instruction == text]
    if ids:
        return Task(ids[0], text)
    if free and " " in text:
        return Task(text, text, free=True)
    lines = [f"  {key}: {instruction}" for key, instruction in known.items()]
    listing = "\n".join(["known tasks:", *lines]) if lines else "the config lists no tasks"
    raise UsageError(
        f"unknown task {text!r}; nothing was moved{_nearest(text, known)}\n{listing}",
        cause=None if known else "the section has no task_descriptions, so no instruction is known",
        next="--task with one of these ids or instructions; --free-task, or free_tasks=True in the "
        "section, allows words that the policy was not trained on"
        if known
        else "task_descriptions in the section; --free-task, or free_tasks=True there, allows any",
    )


def _nearest(text: str, known: Mapping[str, str]) -> str:
    """The known task that is most like ``text``, in words; nothing where none is known."""
    ids = difflib.get_close_matches(text, known, 1)
    if ids:
        key = ids[0]
    else:
        # The nearest there is, however far: it shows what an instruction looks like.
        spelt = {instruction.casefold(): key for key, instruction in known.items()}
        near = difflib.get_close_matches(text.casefold(), spelt, 1, 0.0)
        if not near:
            return ""
        key = spelt[near[0]]
    return f"; the nearest is {key}: {known[key]!r}"


def read_tasks(path: str | Path, known: Mapping[str, str], free: bool = False) -> list[Task]:
    """The tasks of a file, one a line: an id or an instruction; ``#`` begins a comment.

    Raises:
        UsageError: the file cannot be read, is empty, or has a line that is no task; no line of it
            counts then.
    """
    try:
        content = read_bytes(Path(path), UsageError, at_most=_LARGEST_FILE)
        lines = content.decode("utf-8").splitlines()
    except UnicodeDecodeError as error:
        raise UsageError(f"the tasks cannot be read: {error}", where=str(path)) from error
    found = []
    for number, line in enumerate(lines, 1):
        text = line.partition("#")[0].strip()
        if not text:
            continue
        try:
            found.append(resolve_task(text, known, free))
        except UsageError as error:
            raise UsageError(
                error.what, where=f"{path}:{number}", cause=error.cause, next=error.next
            ) from error
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


Say = Callable[[str], None]


class EndOfTasks(Exception):
    """There will be no further task."""


class TaskSource(ABC):
    """Lines that name tasks. ``waits``: more may come while the run continues."""

    waits: ClassVar[bool] = False

    def open(self) -> None:
        """Begin to listen."""
        return

    def close(self) -> None:
        """Release all resources; may be called several times."""
        return

    def ask(self) -> None:
        """The robot is free: the next line is for it."""
        return

    def announce(self, text: str) -> None:
        """Show a message to the person or program that gives the tasks."""
        return

    def report(self, text: str) -> None:
        """Publish an outcome that the terminal shows anyway, for example on the topic's status."""
        return

    @abstractmethod
    def poll(self) -> str | None:
        """The next line, None if there is none yet; returns at once.

        Raises:
            EndOfTasks: there will be none.
        """


class GivenTasks(TaskSource):
    """Tasks that are known beforehand: ``--task`` and ``--tasks``.

    Args:
        tasks: in their order.
        say: shows one line.
    """

    def __init__(self, tasks: Iterable[Task], say: Say = lambda line: None) -> None:
        self._left = deque(tasks)
        self._say = say

    def announce(self, text: str) -> None:
        self._say(text)

    def poll(self) -> str | None:
        if not self._left:
            raise EndOfTasks
        return self._left.popleft().name


class TerminalTasks(TaskSource):
    """A person at the terminal; an empty line or Ctrl-D ends.

    Args:
        known: id -> instruction.
        say: shows one line.
        settle: called before each question: whatever draws on the terminal makes room.
        descriptor: of the terminal; stdin by default.
    """

    waits: ClassVar[bool] = True

    def __init__(
        self,
        known: Mapping[str, str],
        say: Say,
        settle: Callable[[], None] = lambda: None,
        descriptor: int | None = None,
    ) -> None:
        self._known = known
        self._say = say
        self._settle = settle
        self._file = sys.stdin.fileno() if descriptor is None else descriptor
        self._asked = False

    def ask(self) -> None:
        self._settle()
        if self._asked:
            import termios

            # What was typed while the arm moved was not meant for this question.
            termios.tcflush(self._file, termios.TCIFLUSH)
        self._asked = True
        for key, instruction in self._known.items():
            self._say(f"  {key}: {instruction}")
        self._say("task id or instruction (empty ends):")

    def announce(self, text: str) -> None:
        self._say(text)

    def poll(self) -> str | None:
        # Not input(): that would wait, and this has a robot to look after. The terminal hands over
        # whole lines.
        if not select.select([self._file], [], [], 0.0)[0]:
            return None
        try:
            line = os.read(self._file, 4096).decode(errors="replace").strip()
        except OSError as error:
            raise EndOfTasks from error
        if not line:
            raise EndOfTasks
        return line


class TopicTasks(TaskSource):
    """``std_msgs/String`` messages on a ROS 2 topic; what becomes of them is on ``<topic>/status``.

    Args:
        topic: for example ``/fluxvla/task``.
        say: shows one line.
        domain_id: the ROS domain; None takes ``ROS_DOMAIN_ID``.
        settle: called before a task is waited for, however long that takes.
    """

    waits: ClassVar[bool] = True

    def __init__(
        self,
        topic: str,
        say: Say,
        domain_id: int | None = None,
        settle: Callable[[], None] = lambda: None,
    ) -> None:
        self.topic = topic
        self._say = say
        self._settle = settle
        self._domain_id = domain_id
        self._connection: Any = None
        self._status: Any = None
        self._heard: deque[str] = deque(maxlen=100)

    def open(self) -> None:
        """Begin to listen.

        Raises:
            LoadFailed: there is no ROS 2 here.
        """
        from fluxvla_core.ros2 import Connection, message_class, qos

        self._connection = Connection("fluxvla_tasks", self._domain_id)
        self._string = message_class("std_msgs.msg:String")
        # Latched: that tasks are waited for is said once, perhaps before anybody is found.
        self._status = self._connection.publisher(
            f"{self.topic}/status", self._string, depth=10, latched=True
        )
        self._connection.node.create_subscription(
            self._string, self.topic, self._hear, qos.profile(qos.RELIABLE, 10)
        )

    def close(self) -> None:
        if self._connection is not None:
            self._connection.close()

    def ask(self) -> None:
        for text in self._news():
            self.announce(f"refused, the robot was busy: {text}")
        self._settle()
        self.announce(f"waiting for a task on {self.topic}")

    def announce(self, text: str) -> None:
        self._say(text)
        self.report(text)

    def report(self, text: str) -> None:
        self._status.publish(self._string(data=text))

    def poll(self) -> str | None:
        self._connection.check()
        texts = self._news()
        for text in texts[:-1]:
            self.announce(f"refused, a newer task came: {text}")
        return texts[-1] if texts else None

    def _news(self) -> list[str]:
        return [self._heard.popleft() for _ in range(len(self._heard))]

    def _hear(self, message: Any) -> None:
        self._heard.append(str(message.data).strip())


def task_source(
    context: RunContext,
    known: Mapping[str, str],
    topic: str | None = None,
    domain_id: int | None = None,
    free: bool = False,
) -> TaskSource:
    """The task source that ``--task``, ``--tasks`` or the config name; the terminal by default.

    Args:
        context: of the run.
        known: id -> instruction.
        topic, domain_id: where tasks come from if the command line names none.
        free: whether other instructions than those are allowed.

    Raises:
        UsageError: a task is unknown, or there is none and nobody to ask.
    """
    say = context.reporter.info
    if context.task is not None:
        return GivenTasks([resolve_task(context.task, known, free)], context.reporter.warn)
    if context.task_file is not None:
        return GivenTasks(read_tasks(context.task_file, known, free), context.reporter.warn)
    if topic is not None:
        return TopicTasks(topic, say, domain_id, context.reporter.settle)
    if sys.stdin is not None and sys.stdin.isatty():
        return TerminalTasks(known, say, context.reporter.settle)
    ids = f"one of {', '.join(known)}" if known else "an instruction, and --free-task"
    raise UsageError(
        "no task was given, and there is no terminal to ask at; nothing was moved",
        next=f"--task with {ids}; --tasks with a file of them",
    )


def tasks(
    source: TaskSource,
    known: Mapping[str, str],
    idle: Callable[[], None],
    heard: Callable[[str], bool] = lambda line: False,
    free: bool = False,
) -> Iterator[Task]:
    """The tasks of a source, which is open.

    Args:
        source: asked whenever the task before is done.
        known: id -> instruction.
        idle: called again and again while there is no line.
        heard: given each line first; True means that it was none of a task.
        free: whether other instructions than the known ones are allowed; a warning is announced.

    Raises:
        UsageError: an unknown task, where nobody is there to say another.
    """
    while True:
        source.ask()
        try:
            while (line := source.poll()) is None:
                idle()
        except EndOfTasks:
            return
        if heard(line):
            continue
        try:
            task = resolve_task(line, known, free)
        except UsageError as error:
            if not source.waits:
                raise
            source.announce(str(error))
            continue
        if task.free:
            source.announce(task.warning)
        yield task
