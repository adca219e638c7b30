"""Where the tasks of a run come from: the command line, a file, a person, a ROS 2 topic.

A source is asked for the next line again and again, so that whoever waits for it can keep a robot
where it is in the meantime. What was said while the robot was busy is not taken for an answer.
"""

from __future__ import annotations

import os
import select
import sys
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, ClassVar

from fluxvla_core.build import RunContext
from fluxvla_core.errors import UsageError
from fluxvla_core.infer.tasks import Task, read_tasks, resolve_task

Say = Callable[[str], None]


class EndOfTasks(Exception):
    """There will be no further task."""


class TaskSource(ABC):
    """Lines that name tasks. ``waits``: whoever gives them is there while the run goes on."""

    waits: ClassVar[bool] = False

    def open(self) -> None:
        """Begin to listen."""
        return

    def close(self) -> None:
        """Give everything back; any number of times."""
        return

    def ask(self) -> None:
        """The robot is free: the next line is for it."""
        return

    def tell(self, text: str) -> None:
        """Something that whoever gives the tasks should know."""
        return

    @abstractmethod
    def poll(self) -> str | None:
        """The next line, None if there is none yet; returns at once.

        Raises:
            EndOfTasks: there will be none.
        """


class Given(TaskSource):
    """Tasks that are known beforehand: ``--task`` and ``--tasks``."""

    def __init__(self, tasks: Iterable[Task]) -> None:
        self._left = deque(tasks)

    def poll(self) -> str | None:
        if not self._left:
            raise EndOfTasks
        return self._left.popleft().name


class Prompt(TaskSource):
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

    def tell(self, text: str) -> None:
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


class Topic(TaskSource):
    """``std_msgs/String`` messages on a ROS 2 topic; what becomes of them is on ``<topic>/status``.

    Args:
        topic: for example ``/fluxvla/task``.
        say: shows one line.
        domain_id: the ROS domain; None takes ``ROS_DOMAIN_ID``.
    """

    waits: ClassVar[bool] = True

    def __init__(self, topic: str, say: Say, domain_id: int | None = None) -> None:
        self.topic = topic
        self._say = say
        self._domain_id = domain_id
        self._connection: Any = None
        self._status: Any = None
        self._heard: deque[str] = deque(maxlen=100)

    def open(self) -> None:
        """Begin to listen.

        Raises:
            LoadFailed: there is no ROS 2 here.
        """
        from fluxvla_core.ros2 import qos
        from fluxvla_core.ros2.connection import Connection
        from fluxvla_core.ros2.require import message_class

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
            self.tell(f"refused, the robot was busy: {text}")
        self.tell(f"waiting for a task on {self.topic}")

    def tell(self, text: str) -> None:
        self._say(text)
        self._status.publish(self._string(data=text))

    def poll(self) -> str | None:
        self._connection.check()
        texts = self._news()
        for text in texts[:-1]:
            self.tell(f"refused, a newer task came: {text}")
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
) -> TaskSource:
    """What a run's ``--task``, ``--tasks`` and config say, or else the terminal.

    Args:
        context: of the run.
        known: id -> instruction.
        topic, domain_id: where tasks come from if the command line names none.

    Raises:
        UsageError: a task is unknown, or there is none and nobody to ask.
    """
    say = context.reporter.info
    if context.task is not None:
        return Given([resolve_task(context.task, known)])
    if context.task_file is not None:
        return Given(read_tasks(context.task_file, known))
    if topic is not None:
        return Topic(topic, say, domain_id)
    if sys.stdin is not None and sys.stdin.isatty():
        return Prompt(known, say, getattr(context.reporter, "settle", lambda: None))
    ids = f"one of {', '.join(known)}, or an" if known else "an"
    raise UsageError(
        "no task was given, and there is no terminal to ask at; nothing was moved",
        next=f"--task with {ids} instruction in words; --tasks with a file of them",
    )


def tasks(
    source: TaskSource,
    known: Mapping[str, str],
    idle: Callable[[], None],
    heard: Callable[[str], bool] = lambda line: False,
) -> Iterator[Task]:
    """The tasks of a source, which is open.

    Args:
        source: asked whenever the task before is done.
        known: id -> instruction.
        idle: called again and again while there is no line.
        heard: given each line first; True means that it was none of a task.

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
            task = resolve_task(line, known)
        except UsageError as error:
            if not source.waits:
                raise
            source.tell(str(error))
            continue
        yield task
