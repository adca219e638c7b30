"""Ids, instructions, and what is neither."""

from __future__ import annotations

import pytest

from fluxvla_core.errors import UsageError
from fluxvla_core.infer.tasks import Task, resolve_task, tasks

KNOWN = {"1": "wave at the camera", "cube": "lift the red cube"}


def test_an_id_is_looked_up():
    assert resolve_task("cube", KNOWN) == Task("cube", "lift the red cube")


def test_words_are_an_instruction_and_a_known_one_keeps_its_id():
    assert resolve_task("stir the soup", KNOWN) == Task("stir the soup", "stir the soup")
    assert resolve_task(" lift  the red cube", KNOWN) == Task("cube", "lift the red cube")


@pytest.mark.parametrize("given", ["2", "wave", "", "99"])
def test_one_word_that_is_no_id_is_refused(given):
    with pytest.raises(UsageError, match=f"unknown task '{given}'; nothing was moved"):
        resolve_task(given, KNOWN)


def test_without_known_tasks_the_message_says_so():
    with pytest.raises(UsageError, match="the config lists no tasks"):
        resolve_task("1", {})


def test_a_given_task_is_the_only_one():
    assert list(tasks("1", KNOWN, terminal=True)) == [Task("1", "wave at the camera")]


def test_a_person_is_asked_until_an_empty_answer():
    said = []
    answers = iter(["1", "77", "open the drawer", ""])

    found = list(tasks(None, KNOWN, ask=lambda text: next(answers), say=said.append, terminal=True))

    assert [task.instruction for task in found] == ["wave at the camera", "open the drawer"]
    assert said.count("  1: wave at the camera") == 4
    assert any("unknown task '77'" in line for line in said)


def test_without_a_terminal_and_without_tasks_words_are_asked_for():
    with pytest.raises(UsageError, match="no task was given") as caught:
        next(tasks(None, {}, terminal=False))
    assert "--task with an instruction in words" in str(caught.value)
