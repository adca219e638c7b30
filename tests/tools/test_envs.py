"""An environment is filled once, brought up to date part by part, and made anew when it must."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tools import envs, shell
from tools.envs import Env


class Recorder:
    """An Env whose creation costs nothing, and what was asked to be installed."""

    def __init__(self, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.env = Env(root)
        self.calls: list[object] = []

        def create(env: Env) -> None:
            self.calls.append("create")
            env.bin.mkdir(parents=True, exist_ok=True)
            env.python.touch()

        monkeypatch.setattr(Env, "create", create)

    def fill(self, base: str, **parts: str) -> bool:
        def install(changed: list[str], fresh: bool) -> None:
            self.calls.append((tuple(changed), fresh))

        return self.env.filled({"k": base}, parts, lambda: self.calls.append("base"), install)

    def taken(self) -> list[object]:
        calls, self.calls = self.calls, []
        return calls


@pytest.fixture
def recorder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Recorder:
    return Recorder(tmp_path / "env", monkeypatch)


def test_filled_once(recorder: Recorder) -> None:
    assert recorder.fill("1", core="a", sim="b") is True
    assert recorder.taken() == ["create", "base", (("core", "sim"), True)]
    assert recorder.fill("1", core="a", sim="b") is False
    assert recorder.taken() == []


def test_only_a_changed_part_is_installed_again(recorder: Recorder) -> None:
    recorder.fill("1", core="a", sim="b")
    recorder.taken()
    assert recorder.fill("1", core="a", sim="c", new="d") is True
    assert recorder.taken() == [(("sim", "new"), False)]


@pytest.mark.parametrize(
    ("base", "parts"), [("2", {"core": "a", "sim": "b"}), ("1", {"core": "a"})]
)
def test_another_base_or_a_part_that_left_means_a_new_environment(
    recorder: Recorder, base: str, parts: dict[str, str]
) -> None:
    recorder.fill("1", core="a", sim="b")
    recorder.taken()
    recorder.fill(base, **parts)
    assert recorder.taken() == ["create", "base", (tuple(parts), True)]


@pytest.mark.parametrize("content", ["", "{", "[]"])
def test_a_damaged_stamp_means_a_new_environment(recorder: Recorder, content: str) -> None:
    recorder.fill("1", core="a")
    recorder.taken()
    (recorder.env.root / envs.STAMP).write_text(content)
    recorder.fill("1", core="a")
    assert recorder.taken()[0] == "create"


def test_a_missing_interpreter_means_a_new_environment(recorder: Recorder) -> None:
    recorder.fill("1", core="a")
    recorder.taken()
    recorder.env.python.unlink()
    recorder.fill("1", core="a")
    assert recorder.taken()[0] == "create"


def test_the_environment_of_another_checkout_is_not_emptied(
    tmp_path: Path, recorder: Recorder
) -> None:
    """A checkout may borrow one by a symbolic link until it needs another."""
    other = tmp_path / "other"
    recorder.fill("1", core="a")
    recorder.env.root.rename(other)
    recorder.env.root.symlink_to(other)
    assert recorder.fill("1", core="a") is False
    assert recorder.fill("2", core="a") is True
    assert not recorder.env.root.is_symlink()
    assert json.loads((other / envs.STAMP).read_text())["core"] == "a"


def test_an_interrupted_installation_goes_on_where_it_was(recorder: Recorder) -> None:
    def fail(changed: list[str], fresh: bool) -> None:
        raise shell.StepFailed(["pip"], 1)

    with pytest.raises(shell.StepFailed):
        recorder.env.filled({"k": "1"}, {"core": "a"}, lambda: None, fail)
    recorder.taken()
    assert recorder.fill("1", core="a") is True
    assert recorder.taken() == [(("core",), False)]
    assert json.loads((recorder.env.root / envs.STAMP).read_text())["core"] == "a"


def test_a_real_environment_runs_its_own_programs(tmp_path: Path) -> None:
    env = Env(tmp_path / "env")
    env.create()
    printed = env.run("python", "-c", "import sys; print(sys.prefix)", quiet=True, echo=False)
    assert Path(printed.strip()) == env.root
    assert env.variables()["PATH"].startswith(str(env.bin))
    env.create()  # over an existing one
    assert env.stamp() == {}
