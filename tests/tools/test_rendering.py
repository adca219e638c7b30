"""MuJoCo renders, or the user is told the one line to type."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from tools import rendering, shell
from tools.envs import Env
from tools.shell import StepFailed

ENV = Env(Path("some-env"))


class Machine:
    """A machine whose renderer works after apt-get ran (``mends``), or never."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *, apt: bool, root: bool, mends: bool):
        self.ran: list[str] = []
        self.said: list[str] = []
        self.mended = False

        def probe(env: Env) -> str | None:
            return None if self.mended else "ImportError: cannot load libEGL"

        def run(command: list[str], **options: object) -> str:
            self.ran.append(" ".join(command))
            self.mended = mends and "install" in command
            return ""

        monkeypatch.setattr(rendering, "probe", probe)
        monkeypatch.setattr(shell, "run", run)
        monkeypatch.setattr(rendering, "administrator", lambda: [] if root else None)
        monkeypatch.setattr(rendering.shutil, "which", lambda name: name if apt else None)

    def ensure(self) -> None:
        rendering.ensure(ENV, self.said.append)


def test_root_gets_mesa_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    machine = Machine(monkeypatch, apt=True, root=True, mends=True)
    machine.ensure()
    assert machine.ran == [
        "apt-get update -q",
        "apt-get install -y -q --no-install-recommends "
        "libegl1 libegl-mesa0 libgl1-mesa-dri libopengl0",
    ]
    assert "cannot load libEGL" in machine.said[0]
    machine.ensure()
    assert len(machine.ran) == 2, "a renderer that works is left alone"


def test_others_get_the_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    machine = Machine(monkeypatch, apt=True, root=False, mends=True)
    with pytest.raises(rendering.CannotRender) as told:
        machine.ensure()
    assert "cannot load libEGL" in str(told.value)
    assert (
        "\n    sudo apt-get update -q && sudo apt-get install -y -q --no-install-recommends "
        "libegl1 libegl-mesa0 libgl1-mesa-dri libopengl0\n" in str(told.value)
    )
    assert machine.ran == []


def test_a_system_without_apt_is_told_what_is_needed(monkeypatch: pytest.MonkeyPatch) -> None:
    machine = Machine(monkeypatch, apt=False, root=True, mends=True)
    with pytest.raises(rendering.CannotRender, match="this system's package manager"):
        machine.ensure()


def test_what_mesa_does_not_mend_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    machine = Machine(monkeypatch, apt=True, root=True, mends=False)
    with pytest.raises(rendering.CannotRender, match="still cannot render after installing"):
        machine.ensure()


def test_a_failing_apt_shows_its_output(monkeypatch: pytest.MonkeyPatch) -> None:
    machine = Machine(monkeypatch, apt=True, root=True, mends=True)

    def run(command: list[str], **options: object) -> str:
        raise StepFailed(command, 100, "E: no space left")

    monkeypatch.setattr(shell, "run", run)
    with pytest.raises(rendering.CannotRender, match="E: no space left"):
        machine.ensure()


def test_no_mujoco_is_no_matter_for_apt(monkeypatch: pytest.MonkeyPatch) -> None:
    machine = Machine(monkeypatch, apt=True, root=True, mends=True)
    reason = "ModuleNotFoundError: No module named 'mujoco'"
    monkeypatch.setattr(rendering, "probe", lambda env: reason)
    with pytest.raises(rendering.CannotRender, match="has no complete mujoco"):
        machine.ensure()
    assert machine.ran == []


def test_administrator(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rendering.os, "geteuid", lambda: 0)
    assert rendering.administrator() == []
    monkeypatch.setattr(rendering.os, "geteuid", lambda: 1000)
    monkeypatch.setattr(rendering.shutil, "which", lambda name: None)
    assert rendering.administrator() is None


def test_the_probe_renders_here() -> None:
    assert rendering.probe(Env(Path(sys.prefix))) is None


def test_the_probe_names_what_is_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(rendering.VARIABLES, "MUJOCO_GL", "nonsense")
    reason = rendering.probe(Env(Path(sys.prefix)))
    assert reason is not None
    assert "MUJOCO_GL" in reason
