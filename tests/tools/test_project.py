"""What the repository consists of, and fingerprints of it."""

from __future__ import annotations

from pathlib import Path

import pytest

from tools import project


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    for folder, name in ((".", "core-x"), ("plugins/b", "b-y"), ("plugins/a", "a.z")):
        src = tmp_path / folder / "src" / "pkg"
        src.mkdir(parents=True)
        (src / "__init__.py").write_text("x = 1\n")
        text = f'[build-system]\nrequires = []\n\n[project]\nversion = "1"\nname = "{name}"\n'
        (tmp_path / folder / "pyproject.toml").write_text(text)
    return tmp_path


def test_the_core_comes_first_then_the_plugins_by_name(repository: Path) -> None:
    found = project.distributions(repository)
    assert [d.name for d in found] == ["core-x", "a.z", "b-y"]
    assert [d.stem for d in found] == ["core_x", "a_z", "b_y"]


def test_a_project_without_a_name_is_refused_with_its_file(repository: Path) -> None:
    (repository / "plugins/a/pyproject.toml").write_text("[tool.x]\nname = 'x'\n")
    with pytest.raises(SystemExit, match=r"a/pyproject\.toml: no name under \[project\]"):
        project.distributions(repository)


def test_the_fingerprint_follows_what_a_wheel_is_made_of(repository: Path) -> None:
    core = project.distributions(repository)[0]
    before = core.fingerprint()
    (repository / "tests").mkdir()
    (repository / "tests" / "test_x.py").write_text("")
    cache = repository / "src" / "pkg" / "__pycache__"
    cache.mkdir()
    (cache / "x.pyc").write_bytes(b"")
    (repository / "plugins/a/src/pkg/__init__.py").write_text("x = 2\n")
    assert core.fingerprint() == before
    (repository / "src/pkg/__init__.py").write_text("x = 2\n")
    changed = core.fingerprint()
    assert changed != before
    (repository / "src/pkg/__init__.py").rename(repository / "src/pkg/other.py")
    assert core.fingerprint() != changed


def test_combined_fingerprint_depends_on_names_and_values_not_on_order() -> None:
    one = project.combined({"a": "1", "b": "2"})
    assert one == project.combined({"b": "2", "a": "1"})
    assert one != project.combined({"a": "2", "b": "1"})


def test_constrained_version(tmp_path: Path) -> None:
    file = tmp_path / "constraints.txt"
    file.write_text('# torch==1\ntorch==2.13.0; python_version > "3"\ntorch-extra==9\n')
    assert project.constrained_version("torch", file) == "2.13.0"
    with pytest.raises(LookupError, match=r"constraints\.txt has no line 'numpy==<version>'"):
        project.constrained_version("numpy", file)


def test_this_repository() -> None:
    names = [d.name for d in project.distributions()]
    assert names[0] == "fluxvla-core"
    assert {"fluxvla-fsdp", "fluxvla-sim", "fluxvla-models", "fluxvla-aloha"} <= set(names)
    assert project.constrained_version("torch")
