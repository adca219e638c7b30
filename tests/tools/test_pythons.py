"""Finding another Python."""

from __future__ import annotations

from pathlib import Path

import pytest
import tomli

from tools import project, pythons
from tools.shell import StepFailed


def fake_python(folder: Path, prints: str, status: int = 0) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"python{pythons.VERSION}"
    path.write_text(f"#!/bin/sh\necho {prints}\nexit {status}\n")
    path.chmod(0o755)
    return path


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    monkeypatch.setenv("PYENV_ROOT", str(tmp_path / "pyenv"))
    return tmp_path


def test_one_on_the_path(place: Path) -> None:
    path = fake_python(place / "bin", pythons.VERSION)
    fake_python(place / "pyenv" / "versions" / "3.13.0" / "bin", pythons.VERSION)
    assert pythons.find() == path


def test_a_shim_that_runs_nothing_is_passed_over(place: Path) -> None:
    fake_python(place / "bin", "command not found", status=127)
    path = fake_python(place / "pyenv" / "versions" / "3.13.4" / "bin", pythons.VERSION)
    fake_python(place / "pyenv" / "versions" / "3.13.0" / "bin", pythons.VERSION)
    assert pythons.find() == path


def test_without_one_it_says_so(place: Path) -> None:
    assert pythons.find() is None
    with pytest.raises(StepFailed, match=r"no python3\.13 on this machine"):
        pythons.filled(place, [], print)


def test_what_is_tested_is_there() -> None:
    names = {dist.name for dist in project.distributions()}
    assert set(pythons.PLUGINS) <= names
    paths = [word for word in pythons.TESTED if word.startswith(("tests/", "plugins/"))]
    assert [
        word for word in (*paths, *pythons.NEED_MORE) if not (project.ROOT / word).exists()
    ] == []


def test_classifiers_name_the_pythons_of_every_night() -> None:
    """Of the core all of them, and of a plugin none that is not tested."""
    prefix = "Programming Language :: Python :: 3."
    for dist in project.distributions():
        table = tomli.loads((dist.path / "pyproject.toml").read_text(encoding="utf-8"))
        stated = table["project"].get("classifiers", [])
        named = {one.removeprefix(prefix) for one in stated if one.startswith(prefix)}
        minor = {f"3.{number}" for number in named}
        assert minor <= set(pythons.NIGHTLY), dist.name
        assert dist.path != project.ROOT or minor == set(pythons.NIGHTLY)
