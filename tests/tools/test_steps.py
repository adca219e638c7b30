"""All parts run; the session fails when one of them did, by name."""

from __future__ import annotations

import pytest

from tools.shell import StepFailed
from tools.steps import Steps


class Session:
    def __init__(self) -> None:
        self.said: list[str] = []

    def log(self, text: str) -> None:
        self.said.append(text)

    def warn(self, text: str) -> None:
        self.said.append(f"warning: {text}")

    def error(self, text: str) -> None:
        raise RuntimeError(text)


def fail() -> None:
    raise StepFailed(["mypy"], 1)


def test_parts_run_in_order_and_are_timed() -> None:
    session, ran = Session(), []
    with Steps(session) as step:
        step("one", lambda: ran.append(1))
        step("two", lambda: ran.append(2))
    assert ran == [1, 2]
    assert session.said == ["== one", "== two", "took: one 0 s, two 0 s"]


def test_a_failing_part_is_named_after_the_others_ran() -> None:
    session, ran = Session(), []

    def run() -> None:
        with Steps(session) as step:
            step("types", fail)
            step("layers", fail)
            step("pytest", lambda: ran.append(1))

    with pytest.raises(RuntimeError, match=r"^failed: types, layers$"):
        run()
    assert ran == [1]
    assert "warning: types: exit status 1 from: mypy" in session.said


def test_without_an_environment_nothing_runs() -> None:
    with pytest.raises(RuntimeError, match=r"^exit status 1 from: mypy$"), Steps(Session()):
        fail()


def test_other_errors_are_no_failed_parts() -> None:
    with pytest.raises(ZeroDivisionError), Steps(Session()) as step:
        step("wrong", lambda: 1 / 0)
