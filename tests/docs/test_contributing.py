"""The commands, paths and sessions that CONTRIBUTING.md names exist, and its short commands run."""

from __future__ import annotations

import ast
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
BLOCK = re.compile(r"^<!-- checkout: [^\n]+ -->\n```bash\n(.*?)^```$", re.MULTILINE | re.DOTALL)
LINES = [line for block in BLOCK.findall(PAGE) for line in block.splitlines()]
SHORT = ("pytest ", "ruff ", "lint-imports", "fluxvla ")
FOLDERS = r"(?:src|plugins|tests|tools|docs|benchmarks|\.ci)/[\w./*-]*"
PATH = re.compile(rf"`({FOLDERS}|[A-Za-z]\w*\.(?:py|md|txt|toml))`")


def nox_sessions() -> set[str]:
    tree = ast.parse((ROOT / "noxfile.py").read_text(encoding="utf-8"))
    functions = [node for node in tree.body if isinstance(node, ast.FunctionDef)]
    return {f.name for f in functions if any("session" in ast.unparse(d) for d in f.decorator_list)}


def test_sessions_exist() -> None:
    named = re.findall(r"nox -s ((?:\w+ ?)+)", PAGE)
    assert len(named) > 5
    assert {name for words in named for name in words.split()} <= nox_sessions()


def test_setup_begins_as_ci_does() -> None:
    start = LINES[0].rpartition(" ")[0]
    assert start.endswith("nox -s")
    assert start in (ROOT / ".ci" / "run").read_text(encoding="utf-8")


def test_marks_are_those_of_pytest(pytestconfig: pytest.Config) -> None:
    table = PAGE.partition("| mark |")[2].partition("\n\n")[0]
    known = {line.partition(":")[0] for line in pytestconfig.getini("markers")}
    named = set(re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE))
    assert {"slow", "network", "realtime"} <= named <= known


def test_paths_exist() -> None:
    named = PATH.findall(PAGE)
    assert len(named) > 25
    assert {p for p in named if "NAME" not in p and not list(ROOT.glob(p.rstrip("/")))} == set()


def test_benchmarks_and_folders_in_commands_exist() -> None:
    for line in LINES:
        words = shlex.split(line, comments=True)
        if "bench" in words:
            assert (ROOT / "benchmarks" / f"{words[-1]}.py").exists()
        assert all((ROOT / w).exists() for w in words if w.startswith("tests/") and "::" not in w)


@pytest.mark.parametrize("line", [line for line in LINES if line.startswith(SHORT)])
def test_a_short_command_runs(line: str) -> None:
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    variables = {k: v for k, v in os.environ.items() if not k.startswith("PYTEST_")}
    done = subprocess.run(
        ["bash", "-c", line],
        cwd=ROOT,
        env={**variables, "PATH": path},
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
