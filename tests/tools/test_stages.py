"""What the first stage of the tests notes for those after it, and the order of its files."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tools import stages

ROOT = Path(__file__).parents[2]
PLAIN = "def test_{n}(): pass\n"
MARKED = "import pytest\n@pytest.mark.{mark}\ndef test_{mark}(): pass\n"
BOTH = "import pytest\n@pytest.mark.network\n@pytest.mark.realtime\ndef test_both(): pass\n"


def test_files_are_found_by_mark(tmp_path: Path) -> None:
    path, a, b = tmp_path / "later.json", tmp_path / "a.py", tmp_path / "b.py"
    stages.note(path, [(a, {"network"}), (b, {"realtime"}), (a, {"network", "realtime"})])
    assert stages.files(path, "network") == [str(a)]
    assert stages.files(path, "realtime") == [str(a), str(b)]


def test_where_nothing_was_noted_all_files_are_looked_through(tmp_path: Path) -> None:
    assert stages.files(tmp_path / "none.json", "network") == []


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A few test files beside the root conftest of this repository and its marks."""
    (tmp_path / "conftest.py").write_text((ROOT / "conftest.py").read_text(encoding="utf-8"))
    marks = "early: e\n  slow: s\n  network: n\n  realtime: r"
    (tmp_path / "pytest.ini").write_text(f"[pytest]\nmarkers =\n  {marks}\n")
    contents = {
        "test_few": PLAIN.format(n=0),
        "test_late": MARKED.format(mark="early"),
        "test_many": "".join(PLAIN.format(n=n) for n in range(4)),
        "test_network": MARKED.format(mark="network"),
        "test_realtime": MARKED.format(mark="realtime") + BOTH,
        "test_slow": MARKED.format(mark="slow"),
    }
    for name, text in contents.items():
        (tmp_path / f"{name}.py").write_text(text)
    return tmp_path


def run(project: Path, *words: str, **variables: str) -> str:
    """What pytest prints of ``project``, with the words and variables."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("PYTEST_", "FLUXVLA_"))}
    command = [sys.executable, "-m", "pytest", "-v", "-p", "no:cacheprovider", *words]
    done = subprocess.run(
        command,
        cwd=project,
        env={**kept, "PYTHONPATH": str(ROOT), **variables},
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_the_first_stage_notes_the_files_of_the_others(project: Path) -> None:
    later = project / "later.json"
    words = ["-n", "1", "-m", "not network and not realtime and not slow"]
    said = run(project, *words, **{stages.FILE: str(later)})
    assert "6 passed" in said
    network, realtime = (str(project / f"test_{mark}.py") for mark in ("network", "realtime"))
    assert json.loads(later.read_text()) == {
        network: ["network"],
        realtime: ["network", "realtime"],
    }
    second = run(project, "-m", "network and not realtime", *stages.files(later, "network"))
    third = run(project, "-m", "realtime", *stages.files(later, "realtime"))
    assert "1 passed" in second
    assert "2 passed" in third


def test_early_files_come_first_and_then_those_of_many_tests(project: Path) -> None:
    words = ["-n", "1", "--dist", "loadfile", "--no-loadscope-reorder", "-m", "not slow"]
    ran = [line for line in run(project, *words).splitlines() if "PASSED" in line]
    files = list(dict.fromkeys(line.split(" PASSED ")[1].partition("::")[0] for line in ran))
    order = ["test_late.py", "test_many.py", "test_realtime.py", "test_few.py", "test_network.py"]
    assert [file.strip() for file in files] == order
