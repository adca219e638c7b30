"""Each distribution builds, and its archives hold what they should and nothing else."""

from __future__ import annotations

import re
import subprocess
import sys
import tarfile
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest

from tools import project
from tools.project import Distribution

DISTRIBUTIONS = project.distributions()
# What plugins share: they register nothing.
LIBRARIES = {"fluxvla-mujoco"}
# What may stand in an sdist; the rest are files of the build backend and the metadata itself.
SDIST = re.compile(
    r"^(src/\w+/.*|tests/.*|README\.md|LICENSE|pyproject\.toml|PKG-INFO|\.gitignore)$"
)


@pytest.fixture(scope="module", params=DISTRIBUTIONS, ids=lambda d: d.name)
def built(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Distribution, Path, Path]:
    dist: Distribution = request.param
    out = tmp_path_factory.mktemp(dist.stem)
    command = [sys.executable, "-m", "hatchling", "build", "-d", str(out)]
    done = subprocess.run(command, cwd=dist.path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    (wheel,) = out.glob("*.whl")
    (sdist,) = out.glob("*.tar.gz")
    return dist, wheel, sdist


def test_the_wheel_holds_one_package_with_its_type_marker(
    built: tuple[Distribution, Path, Path],
) -> None:
    dist, wheel, _ = built
    names = zipfile.ZipFile(wheel).namelist()
    tops = {name.split("/")[0] for name in names if ".dist-info/" not in name}
    assert len(tops) == 1, f"a wheel is one import package, this one holds {sorted(tops)}"
    (package,) = tops
    assert f"{package}/py.typed" in names
    own = [n for n in names if "/templates/" not in n]  # what those render has tests
    assert not [n for n in own if "__pycache__" in n or "/tests/" in n]
    assert wheel.name.startswith(f"{dist.stem}-")
    assert wheel.name.endswith("-py3-none-any.whl")


def test_the_sdist_leaks_nothing(built: tuple[Distribution, Path, Path]) -> None:
    _, _, sdist = built
    with tarfile.open(sdist) as archive:
        names = [name.partition("/")[2] for name in archive.getnames()]
    foreign = [n for n in names if n and not SDIST.match(n)]
    assert foreign == []
    packages = {n.split("/")[1] for n in names if n.startswith("src/")}
    assert len(packages) == 1, f"sources of several packages: {sorted(packages)}"
    assert "pyproject.toml" in names


def test_every_source_file_is_in_the_wheel(built: tuple[Distribution, Path, Path]) -> None:
    dist, wheel, _ = built
    names = set(zipfile.ZipFile(wheel).namelist())
    sources = [p for p in dist.sources() if "src" in p.relative_to(dist.path).parts]
    missing = [
        str(path) for path in sources if path.relative_to(dist.path / "src").as_posix() not in names
    ]
    assert missing == []


def test_metadata_names_ranges_and_the_one_cap(built: tuple[Distribution, Path, Path]) -> None:
    dist, wheel, _ = built
    archive = zipfile.ZipFile(wheel)
    (path,) = [n for n in archive.namelist() if n.endswith(".dist-info/METADATA")]
    metadata = Parser().parsestr(archive.read(path).decode())
    needs = metadata.get_all("Requires-Dist") or []
    assert metadata["Requires-Python"] == ">=3.10"
    assert metadata["License-Expression"] == "Apache-2.0"
    assert not [n for n in needs if "==" in n.partition(";")[0]], "ranges rather than pins"
    if dist.name != "fluxvla-core":
        on_core = [n for n in needs if re.match(r"fluxvla[-_]core\b", n)]
        assert on_core, "a plugin declares which core it was written for"
        assert all("<0.2" in n and ">=0.1" in n for n in on_core)
        points = [n for n in archive.namelist() if n.endswith("entry_points.txt")]
        assert bool(points) != (dist.name in LIBRARIES), "a plugin is found by its entry points"


def test_the_core_declares_neither_torch_nor_ros() -> None:
    text = (project.ROOT / "pyproject.toml").read_text(encoding="utf-8")
    (block,) = re.findall(r"^dependencies = \[(.*?)^\]", text, re.MULTILINE | re.DOTALL)
    for heavy in ("torch", "av", "pyarrow", "opencv", "rclpy", "transformers"):
        assert f'"{heavy}' not in block
