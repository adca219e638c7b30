"""Ids, instructions, files of them, and what is neither."""

from __future__ import annotations

import os

import pytest

from fluxvla_core.errors import UsageError
from fluxvla_core.robot.tasks import Task, check_descriptions, read_tasks, resolve_task

KNOWN = {"1": "wave at the camera", "cube": "lift the red cube"}


def test_an_id_is_looked_up():
    assert resolve_task("cube", KNOWN) == Task("cube", "lift the red cube")


def test_a_known_instruction_keeps_its_id():
    assert resolve_task(" lift  the red cube", KNOWN) == Task("cube", "lift the red cube")
    assert resolve_task("lift the red cube", KNOWN, free=True) == Task("cube", "lift the red cube")


@pytest.mark.parametrize(
    ("given", "nearest"),
    [
        ("lift teh red cube", "cube: 'lift the red cube'"),
        ("Wave at the camera.", "1: 'wave at the camera'"),
        ("cub", "cube: 'lift the red cube'"),
        ("make me a coffee", ""),
    ],
)
def test_words_that_are_no_known_instruction_are_refused_with_the_nearest(given, nearest):
    with pytest.raises(UsageError) as caught:
        resolve_task(given, KNOWN)
    assert f"unknown task '{given}'; nothing was moved; the nearest is {nearest}" in str(caught)
    assert "--free-task, or free_tasks=True" in str(caught.value)
    assert caught.value.exit_code == 2


def test_other_words_are_taken_where_they_are_asked_for_and_said_to_be_untrained():
    task = resolve_task("stir the soup", KNOWN, free=True)

    assert task == Task("stir the soup", "stir the soup", free=True)
    assert "not known to be trained on it" in task.warning
    with pytest.raises(UsageError, match="unknown task 'soup'"):
        resolve_task("soup", KNOWN, free=True)


@pytest.mark.parametrize("given", ["2", "wave", "", "99"])
def test_one_word_that_is_no_id_is_refused(given):
    with pytest.raises(UsageError, match=f"unknown task '{given}'; nothing was moved"):
        resolve_task(given, KNOWN)


def test_without_known_tasks_the_message_says_so():
    for given in ("1", "lift the red cube"):
        with pytest.raises(UsageError, match="the config lists no tasks") as caught:
            resolve_task(given, {})
        assert "the section has no task_descriptions" in str(caught.value)
    assert resolve_task("lift the red cube", {}, free=True).free


def test_a_file_has_a_task_a_line(tmp_path):
    file = tmp_path / "tasks.txt"
    file.write_text("# the morning\ncube\n\n  stir the soup   # slowly\nwave at the camera\n")

    with pytest.raises(UsageError, match=r"tasks.txt:4: unknown task 'stir the soup'"):
        read_tasks(file, KNOWN)
    assert [task.name for task in read_tasks(file, KNOWN, free=True)] == [
        "cube",
        "stir the soup",
        "1",
    ]


def test_a_line_that_is_no_task_is_named_and_none_of_the_file_counts(tmp_path):
    file = tmp_path / "tasks.txt"
    file.write_text("cube\n\ncbue\n")

    with pytest.raises(UsageError) as caught:
        read_tasks(file, KNOWN)
    assert str(caught.value).startswith(f"{file}:3: unknown task 'cbue'; nothing was moved; the")
    assert "cube: lift the red cube" in str(caught.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"# nothing\n\n", "the file has no task in it; nothing was moved"),
        (b"\xff\xfe", "the tasks cannot be read: 'utf-8' codec"),
        (None, r"tasks\.txt: cannot be read: No such file"),
        (b"1\n" * 600_000, r"tasks\.txt: holds more than 1 MiB"),
    ],
)
def test_a_file_that_is_none(tmp_path, content, message):
    file = tmp_path / "tasks.txt"
    if content is not None:
        file.write_bytes(content)

    with pytest.raises(UsageError, match=message):
        read_tasks(file, KNOWN)


@pytest.mark.parametrize("make", [os.mkfifo, lambda path: path.symlink_to("/dev/zero")])
def test_a_file_of_tasks_without_an_end_is_refused_at_once(tmp_path, make):
    make(tmp_path / "tasks.txt")
    with pytest.raises(UsageError, match=r"tasks\.txt: is not a regular file"):
        read_tasks(tmp_path / "tasks.txt", KNOWN)


def test_the_word_that_allows_motion_again_is_no_task():
    with pytest.raises(UsageError, match="'rearm' means something else; rename the task"):
        check_descriptions({"rearm": "put the arms back on"})
