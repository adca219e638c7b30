"""The strangers' plugins are what the packaging tests take them for."""

from __future__ import annotations

import ast
import sys
import zipfile
from pathlib import Path
from typing import ClassVar

import pytest

from tools import unseen
from tools.envs import Env
from tools.shell import StepFailed


@pytest.mark.parametrize(
    ("make", "name", "package"),
    [
        (unseen.good, "fluxvla-acme", "fluxvla_acme"),
        (unseen.failing, "fluxvla-broken", "fluxvla_broken"),
        (unseen.mistyped, "fluxvla-typo", "fluxvla_typo"),
    ],
)
def test_a_wheel_with_entry_points(make, name: str, package: str, tmp_path: Path) -> None:
    project = make(tmp_path)
    assert project.name == name
    ast.parse((project / package / "robot.py").read_text())
    wheel = unseen.wheel(project, tmp_path / "dist", Env(Path(sys.prefix)))
    with zipfile.ZipFile(wheel) as archive:
        points = archive.read(f"{package}-4.2.dist-info/entry_points.txt").decode()
    assert f"= {package}.robot:" in points
    assert "[fluxvla.operators]" in points
    assert "[fluxvla.runners]" in points


class Fluxvla(Env):
    """An environment whose ``fluxvla`` says what it is told to; the rest is not executed."""

    said: ClassVar[dict[str, str]] = {}
    ran: ClassVar[list[str]] = []

    def run(self, program: str, *words: str, **options: object) -> str:
        line = " ".join([program, *map(str, words)])
        self.ran.append(line)
        if "sysconfig" in line:
            return str(self.root)
        if "pip wheel" in line:
            folder, source = Path(words[-2]), Path(words[-1])
            folder.mkdir(exist_ok=True)
            (folder / f"{source.name.replace('-', '_')}-4.2-py3-none-any.whl").touch()
        return self.said.get(str(words[0]), "")


@pytest.mark.parametrize("deaf", [False, True])
def test_the_check_leaves_the_environment_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, deaf: bool
) -> None:
    env = Fluxvla(tmp_path / "env")
    env.root.mkdir()
    monkeypatch.setattr(Fluxvla, "ran", [])
    answers = {"plugins": "AcmeEvalRunner", "run": "" if deaf else "reached: True"}
    monkeypatch.setattr(Fluxvla, "said", answers)
    if deaf:
        with pytest.raises(StepFailed, match="did not say 'reached: True'"):
            unseen.check(env, env, tmp_path / "folder")
    else:
        unseen.check(env, env, tmp_path / "folder")
        assert sum(line.startswith("fluxvla run --config") for line in env.ran) == 2
    assert "pip uninstall" in env.ran[-1]
    assert list(env.root.iterdir()) == []


def test_installed_and_removed(tmp_path: Path) -> None:
    env = Env(tmp_path / "env")
    env.create()
    unseen.install(env, unseen.wheel(unseen.good(tmp_path), tmp_path / "dist"))
    code = "import importlib.metadata as m; print(*{d.name for d in m.distributions()})"
    assert "fluxvla-acme" in env.run("python", "-c", code, quiet=True, echo=False)
    unseen.remove(env, "fluxvla-acme")
    assert "fluxvla-acme" not in env.run("python", "-c", code, quiet=True, echo=False)
    assert unseen.corrupt(env).name == "fluxvla_corrupt-1.0.dist-info"
