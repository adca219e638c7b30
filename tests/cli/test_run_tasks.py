"""``--task`` and ``--tasks``: what reaches a runner, and what is a slip."""

from __future__ import annotations

import pytest

from .conftest import Fluxvla


@pytest.mark.parametrize("words", [("--task", "1"), ("--tasks", "list.txt")])
def test_a_training_has_no_task(run: Fluxvla, words: tuple[str, ...]) -> None:
    ended = run("--config", "c.py", "--section", "runner", *words)

    assert ended.code == 2
    assert "--task says what a robot is to do, and section 'runner' trains" in ended.err


def test_one_of_both_is_enough(run: Fluxvla) -> None:
    ended = run("--config", "c.py", "--section", "eval", "--task", "1", "--tasks", "list.txt")

    assert ended.code == 2
    assert "--task and --tasks both say what to do: give one of them" in ended.err


def test_a_training_takes_no_free_task(run: Fluxvla) -> None:
    ended = run("--config", "c.py", "--section", "runner", "--free-task")

    assert ended.code == 2
    assert "--free-task is for a robot, and section 'runner' trains" in ended.err
