"""What the tests need of the system is installed, or said; what was skipped is told."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from tools import needs, stages
from tools.needs import Need

ROOT = Path(__file__).parents[2]


@pytest.fixture
def missing(tmp_path: Path) -> Need:
    """A program that is there once the apt-get below was asked for its package."""
    place = tmp_path / "installed"
    return Need("gizmo", "gizmo-dev", "gizmos cannot be tested", place.exists)


@pytest.fixture
def programs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "bin"
    folder.mkdir()
    monkeypatch.setenv("PATH", f"{folder}{os.pathsep}/usr/bin{os.pathsep}/bin")
    monkeypatch.delenv(needs.ANYWAY, raising=False)
    return folder


def fake_apt(folder: Path, script: str) -> None:
    program = folder / "apt-get"
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(program.stat().st_mode | stat.S_IXUSR)


@pytest.mark.skipif(os.name != "posix" or os.geteuid() != 0, reason="installs only as root")
def test_what_is_missing_is_installed(missing: Need, programs: Path, tmp_path: Path) -> None:
    fake_apt(programs, f'case "$*" in *gizmo-dev) touch {tmp_path}/installed;; esac')
    said: list[str] = []
    needs.ensure(said.append, (missing,))
    assert said == ["installing what the tests need: gizmo-dev"]
    assert missing.there()


def test_what_cannot_be_installed_is_said(
    missing: Need, programs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake_apt(programs, "echo no such package; exit 100")
    with pytest.raises(needs.Lacking) as told:
        needs.ensure(print, (missing,))
    assert "gizmo: gizmos cannot be tested without it (Debian: gizmo-dev)" in str(told.value)
    assert "sudo apt-get install -y gizmo-dev" in str(told.value)
    assert f"{needs.ANYWAY}=gizmo nox -s tests" in str(told.value)
    monkeypatch.setenv(needs.ANYWAY, "gizmo")
    needs.ensure(print, (missing,))


def test_what_comparisons_with_lerobot_and_compiling_need_is_missed(
    programs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The tests of both were skipped without a word where it is not there."""
    assert [need.name for need in needs.NEEDS] == ["compiler", "libpython"]
    monkeypatch.setenv("PATH", str(programs))
    assert not needs.has_compiler()
    monkeypatch.setattr(needs, "LIBPYTHON", "libpython-that-is-not-there")
    assert not needs.has_libpython()
    fake_apt(programs, "exit 100")
    with pytest.raises(needs.Lacking) as told:
        needs.ensure(print)
    for need in needs.NEEDS:
        assert f"{need.name}: {need.why}" in str(told.value)


def test_the_session_of_the_tests_asks_for_it_before_it_runs_any() -> None:
    body = (ROOT / "noxfile.py").read_text().partition("\ndef tests(")[2].partition("\n\n\n")[0]
    assert body.index("ensure_needs(session)") < body.index("STAGES")


def test_skips_of_several_runs_are_one_list(tmp_path: Path) -> None:
    place = tmp_path / "skipped.jsonl"
    assert stages.summary(place) == ["nothing was skipped"]
    test = tmp_path / "test_few.py"
    test.write_text(
        "import pytest\n"
        "def test_a(): pytest.skip('no gizmo')\n"
        "def test_b(): pytest.importorskip('gizmo_that_is_not_there', reason='no gizmo')\n"
        "@pytest.mark.skipif(True, reason='not today')\n"
        "def test_c(): ...\n"
    )
    (tmp_path / "conftest.py").write_bytes((ROOT / "conftest.py").read_bytes())
    command = [sys.executable, "-m", "pytest", "-q", "-c", str(ROOT / "pyproject.toml")]
    command += ["-p", "no:cacheprovider", "--rootdir", str(tmp_path), str(test)]
    environment = {k: v for k, v in os.environ.items() if k != "PYTEST_XDIST_WORKER"}
    for more in ([], ["-n", "1"]):
        done = subprocess.run(
            [*command, *more],
            cwd=tmp_path,
            env={**environment, stages.SKIPPED: str(place), "PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stdout + done.stderr
    first, second = stages.summary(place)
    assert first.startswith("4 skipped: no gizmo (")
    assert second.startswith("2 skipped: not today (")


def test_no_file_of_the_repository_is_ignored_by_git() -> None:
    words = ["git", "ls-files", "--cached", "--ignored", "--exclude-standard"]
    listed = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True)
    assert listed.stdout == ""
    words = ["git", "check-ignore", "src/fluxvla_core/data/new.py", "plugins/x/src/x/work/a.py"]
    assert subprocess.run(words, cwd=ROOT, capture_output=True, check=False).returncode == 1


def test_a_readers_own_files_do_not_break_lint(tmp_path: Path) -> None:
    """A clone with an environment and a dataset in it."""
    clone = tmp_path / "clone"
    clone.mkdir()
    for name in (".gitignore", "pyproject.toml"):
        (clone / name).write_bytes((ROOT / name).read_bytes())
    subprocess.run(["git", "init", "-q"], cwd=clone, check=True)
    for place in ("env/lib", "work", "data", "out", "recordings"):
        (clone / place).mkdir(parents=True)
        (clone / place / "theirs.py").write_text("import os,sys\n")
    (clone / "wave.py").write_text("import os,sys\n")
    for words in (["check"], ["format", "--check"]):
        command = [sys.executable, "-m", "ruff", *words, "--no-cache", "."]
        done = subprocess.run(command, cwd=clone, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr
    (clone / "src").mkdir()
    (clone / "src" / "ours.py").write_text("import os,sys\n")
    command = [sys.executable, "-m", "ruff", "check", "--no-cache", "."]
    assert subprocess.run(command, cwd=clone, capture_output=True, check=False).returncode == 1
