"""Where tasks come from: given ones, a person at a terminal, a ROS 2 topic."""

from __future__ import annotations

import os
import pty
import time

import pytest

from fluxvla_core.build import RunContext
from fluxvla_core.errors import UsageError
from fluxvla_core.robot.tasks import (
    EndOfTasks,
    GivenTasks,
    Task,
    TaskSource,
    TerminalTasks,
    task_source,
    tasks,
)

KNOWN = {"1": "wave at the camera", "cube": "lift the red cube"}


class Person(TaskSource):
    """Says the next line when asked, and takes its time: a few polls find nothing."""

    waits = True

    def __init__(self, *lines):
        self.lines = list(lines)
        self.asked = 0
        self.told = []
        self.thinking = 0

    def ask(self):
        self.asked += 1
        self.thinking = 2

    def announce(self, text):
        self.told.append(text)

    def poll(self):
        if self.thinking:
            self.thinking -= 1
            return None
        if not self.lines:
            raise EndOfTasks
        return self.lines.pop(0)


class Slow(Person):
    """Thinks for so many polls before each line."""

    def __init__(self, *lines, polls=10):
        super().__init__(*lines)
        self.polls = polls

    def ask(self):
        super().ask()
        self.thinking = self.polls


def test_given_tasks_come_in_order_and_once():
    said = []
    given = [Task("cube", KNOWN["cube"]), Task("stir the soup", "stir the soup", free=True)]
    source = GivenTasks(given, said.append)

    found = list(
        tasks(source, KNOWN, lambda: pytest.fail("there is nothing to wait for"), free=True)
    )

    assert [task.instruction for task in found] == ["lift the red cube", "stir the soup"]
    assert said == [given[1].warning]
    assert list(tasks(source, KNOWN, idle=lambda: None)) == []


def test_a_person_is_asked_again_after_each_task_and_after_a_mistake():
    person, waited = Person("1", "77", "wave at the camera"), []

    found = [t.name for t in tasks(person, KNOWN, idle=lambda: waited.append(len(person.lines)))]

    assert found == ["1", "1"]
    assert person.asked == 4
    assert waited == [3, 3, 2, 2, 1, 1, 0, 0]
    (told,) = person.told
    assert "unknown task '77'; nothing was moved" in told
    assert "cube: lift the red cube" in told


def test_what_was_heard_otherwise_is_no_task():
    found = list(tasks(Person("stop", "1"), KNOWN, lambda: None, heard=lambda line: line == "stop"))

    assert [task.name for task in found] == ["1"]


def test_an_unknown_task_that_nobody_can_mend_is_an_error():
    with pytest.raises(UsageError, match="unknown task '77'"):
        list(tasks(GivenTasks([Task("77", "?")]), KNOWN, lambda: None))


@pytest.fixture
def terminal():
    """A terminal: what is typed goes into ``keys``; the other end is what the program reads."""
    keys, descriptor = pty.openpty()
    yield keys, descriptor
    for end in (keys, descriptor):
        try:
            os.close(end)
        except OSError:
            assert end == keys, "only a test closes the keyboard"


def test_whatever_draws_on_the_terminal_makes_room_first(terminal):
    said = []
    prompt = TerminalTasks({}, said.append, lambda: said.append("settled"), terminal[1])
    prompt.ask()

    assert said == ["settled", "task id or instruction (empty ends):"]


def test_the_reporters_own_way_to_make_room_is_used(monkeypatch):
    class Drawing:
        def info(self, text):
            said.append(text)

        def settle(self):
            said.append("settled")

    said = []
    monkeypatch.setattr("sys.stdin", Terminal())
    task_source(context(reporter=Drawing()), {}).ask()

    assert said == ["settled", "task id or instruction (empty ends):"]


def typed(prompt, seconds=5.0):
    until = time.monotonic() + seconds
    while (line := prompt.poll()) is None:
        assert time.monotonic() < until, "nothing was heard"
        time.sleep(0.005)
    return line


def test_a_person_types_a_line(terminal):
    keys, descriptor = terminal
    said = []
    prompt = TerminalTasks(KNOWN, said.append, descriptor=descriptor)
    prompt.ask()
    assert said == [
        "  1: wave at the camera",
        "  cube: lift the red cube",
        "task id or instruction (empty ends):",
    ]
    assert prompt.poll() is None
    os.write(keys, b"cu")
    assert prompt.poll() is None, "the line is not ended yet"
    os.write(keys, b"be \n")

    assert typed(prompt) == "cube"


@pytest.mark.parametrize("ending", [b"\n", b"  \n", b"\x04"], ids=["empty", "blank", "ctrl-d"])
def test_an_empty_line_or_the_end_of_file_ends(terminal, ending):
    keys, descriptor = terminal
    prompt = TerminalTasks(KNOWN, lambda text: None, descriptor=descriptor)
    os.write(keys, ending)

    with pytest.raises(EndOfTasks):
        typed(prompt)


def test_a_terminal_that_went_away_ends(terminal):
    keys, descriptor = terminal
    prompt = TerminalTasks(KNOWN, lambda text: None, descriptor=descriptor)
    os.close(keys)

    with pytest.raises(EndOfTasks):
        typed(prompt)


def test_what_was_typed_while_the_arm_moved_is_no_answer(terminal):
    keys, descriptor = terminal
    prompt = TerminalTasks(KNOWN, lambda text: None, descriptor=descriptor)
    prompt.ask()
    os.write(keys, b"1\n")
    assert typed(prompt) == "1"
    os.write(keys, b"cube\n")
    time.sleep(0.05)
    prompt.ask()
    assert prompt.poll() is None
    os.write(keys, b"1\n")

    assert typed(prompt) == "1"


def test_bytes_that_are_no_text_are_refused_like_any_slip(terminal):
    keys, descriptor = terminal
    prompt = TerminalTasks(KNOWN, lambda text: None, descriptor=descriptor)
    os.write(keys, b"\xc3(\n")

    assert typed(prompt) == "\ufffd("


class Terminal:
    def isatty(self):
        return True

    def fileno(self):
        return 0


def context(**changes):
    return RunContext(config={}, section="inference", **changes)


def test_the_command_line_comes_first_then_the_config_then_the_terminal(monkeypatch, tmp_path):
    file = tmp_path / "tasks.txt"
    file.write_text("1\ncube\n")
    monkeypatch.setattr("sys.stdin", Terminal())

    given = task_source(context(task="1"), KNOWN, topic="/task")
    assert [task.name for task in tasks(given, KNOWN, lambda: None)] == ["1"]
    listed = task_source(context(task_file=str(file)), KNOWN, topic="/task")
    assert [task.name for task in tasks(listed, KNOWN, lambda: None)] == ["1", "cube"]
    assert type(task_source(context(), KNOWN, topic="/task")).__name__ == "TopicTasks"
    assert isinstance(task_source(context(), KNOWN), TerminalTasks)


@pytest.mark.parametrize(
    ("known", "advice"),
    [
        (KNOWN, "--task with one of 1, cube; --tasks with a file"),
        ({}, "--task with an instruction, and --free-task"),
    ],
)
def test_with_nobody_to_ask_it_is_an_error(monkeypatch, known, advice):
    monkeypatch.setattr("sys.stdin.isatty", lambda: False)

    with pytest.raises(UsageError, match="no task was given, and there is no terminal") as caught:
        task_source(context(), known)
    assert advice in str(caught.value)


def test_without_a_stdin_it_is_an_error_too(monkeypatch):
    monkeypatch.setattr("sys.stdin", None)

    with pytest.raises(UsageError, match="no task was given"):
        task_source(context(), KNOWN)
