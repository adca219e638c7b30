"""Wheels are built when their sources changed, and only then."""

from __future__ import annotations

import sys
import zipfile
from pathlib import Path

import pytest

from tools import wheels
from tools.envs import Env
from tools.project import Distribution

BUILDER = Env(Path(sys.prefix))


@pytest.fixture
def dist(tmp_path: Path) -> Distribution:
    root = tmp_path / "thing"
    (root / "src" / "thing_x").mkdir(parents=True)
    (root / "src" / "thing_x" / "__init__.py").write_text("x = 1\n")
    (root / "pyproject.toml").write_text(
        '[build-system]\nrequires = ["hatchling"]\nbuild-backend = "hatchling.build"\n'
        '[project]\nname = "thing-x"\nversion = "1.0"\nrequires-python = ">=3.10"\n'
        '[tool.hatch.build.targets.wheel]\npackages = ["src/thing_x"]\n'
    )
    return Distribution("thing-x", root)


def content(wheel: Path) -> str:
    with zipfile.ZipFile(wheel) as archive:
        return archive.read("thing_x/__init__.py").decode()


def test_a_wheel_is_built_kept_and_built_again(dist: Distribution, tmp_path: Path) -> None:
    folder = tmp_path / "dist"
    wheel = wheels.build([dist], folder, BUILDER)["thing-x"]
    assert wheel.name == "thing_x-1.0-py3-none-any.whl"
    first = wheel.stat().st_mtime_ns
    assert wheels.build([dist], folder, BUILDER) == {"thing-x": wheel}
    assert wheel.stat().st_mtime_ns == first
    (dist.path / "src" / "thing_x" / "__init__.py").write_text("x = 2\n")
    (folder / "thing_x-0.9-py3-none-any.whl").write_bytes(b"an older version's wheel")
    wheel = wheels.build([dist], folder, BUILDER)["thing-x"]
    assert content(wheel) == "x = 2\n"
    assert list(folder.glob("*.whl")) == [wheel]


def test_a_damaged_record_only_costs_a_build(dist: Distribution, tmp_path: Path) -> None:
    folder = tmp_path / "dist"
    folder.mkdir()
    (folder / wheels.RECORD).write_text("{")
    assert wheels.build([dist], folder, BUILDER)["thing-x"].exists()
