"""The strangers' plugins are what the packaging tests take them for."""

from __future__ import annotations

import ast
import sys
import zipfile
from contextlib import nullcontext
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
        (unseen.garbled, "fluxvla-garbled", "fluxvla_garbled"),
    ],
)
def test_a_wheel_with_entry_points(make, name: str, package: str, tmp_path: Path) -> None:
    project = make(tmp_path)
    assert project.name == name
    source = (project / package / "robot.py").read_text()
    with nullcontext() if make is not unseen.garbled else pytest.raises(SyntaxError):
        ast.parse(source)
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
        sound = not any("pip install" in ran and "fluxvla_broken" in ran for ran in self.ran)
        self.ran.append(line)
        if "sysconfig" in line:
            return str(self.root)
        if "pip wheel" in line:
            folder, source = Path(words[-2]), Path(words[-1])
            folder.mkdir(exist_ok=True)
            (folder / f"{source.name.replace('-', '_')}-4.2-py3-none-any.whl").touch()
        if "doctor" in line and not sound and self.said["doctor"]:
            raise StepFailed([program, *words], 1, self.said["doctor"])
        return self.said.get("list" if "list" in line else str(words[0]), "")


FINDS = "\n".join(unseen.SYMPTOMS)


@pytest.mark.parametrize(
    ("run", "doctor", "problem"),
    [
        ("reached: True", FINDS, None),
        ("", FINDS, "did not say 'reached: True'"),
        ("reached: True", FINDS.replace("robot.py:4", "robot.py"), r"did not say \[.*acme_vendor"),
        ("reached: True", f"{FINDS}\nfluxvla-acme 4.2 cannot", "blamed what is sound"),
        ("reached: True", "", "found nothing"),
    ],
)
def test_the_check_leaves_the_environment_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: str, doctor: str, problem: str | None
) -> None:
    env = Fluxvla(tmp_path / "env")
    env.root.mkdir()
    monkeypatch.setattr(Fluxvla, "ran", [])
    answers = {"list": "AcmeEvalRunner", "plugins": "no problems: 3", "run": run, "doctor": doctor}
    monkeypatch.setattr(Fluxvla, "said", answers)
    if problem is not None:
        with pytest.raises(StepFailed, match=problem):
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
