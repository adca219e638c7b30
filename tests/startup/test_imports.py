"""Start-up: nothing heavy is imported before it is needed."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
CORE = ROOT / "src" / "fluxvla_core"
CONFIGS = ROOT / "configs"
HEAVY = {
    *("torch", "numpy", "cv2", "pyarrow", "av", "rich", "transformers", "mujoco", "jinja2"),
    "pydantic",
    *("rclpy", "asyncio", "multiprocessing", "concurrent", "http", "unittest"),
}
# Packages that are about a heavy library may import it at the top of a module.
AT_HOME = {
    "torch": {"checkpoints", "training", "data", "testing"},
    "numpy": {
        *("data", "policies", "robot", "evaluation", "testing"),
        *("training", "ros2", "control"),
    },
    "av": {"data", "robot"},
    "pyarrow": {"data"},
    "cv2": {"data"},
    "rclpy": {"ros2"},
}
# Modules that a policy imports once it has a model.
WITH_A_MODEL = {
    f"policies/{name}.py" for name in ("execution", "inference_weights", "roofline", "transfer")
}


def modules_after(code: str) -> set[str]:
    """What is imported after ``code``, by its top name."""
    return {name.split(".")[0] for name in all_modules_after(code)}


def all_modules_after(code: str) -> set[str]:
    program = f"{code}\nimport sys; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return set(done.stdout.splitlines()[-1].split())


@pytest.mark.parametrize(
    "words",
    [["--help"], ["--version"], ["plugins", "list"], ["run", "--help"], ["config", "--help"]],
    ids=" ".join,
)
def test_a_command_that_only_looks_imports_nothing_heavy(words: list[str]) -> None:
    loaded = modules_after(f"from fluxvla_core.cli.main import main\nassert main({words}) == 0")
    assert loaded & HEAVY == set()


@pytest.mark.parametrize("config", sorted(CONFIGS.glob("*.py")), ids=lambda path: path.name)
def test_checking_a_config_imports_nothing_heavy(config: Path) -> None:
    words = ["config", "check", str(config)]
    loaded = modules_after(f"from fluxvla_core.cli.main import main\nassert main({words}) == 0")
    assert loaded & {*HEAVY, "packaging"} == set()


@pytest.mark.parametrize("module", ["training.trainer", "checkpoints.tensors"])
def test_one_process_does_without_what_only_splits_tensors(module: str) -> None:
    """``torch.distributed.tensor`` takes a second; a run in one process has none of its tensors."""
    loaded = all_modules_after(f"import fluxvla_core.{module}")
    assert "torch" in loaded
    assert "torch.distributed.tensor" not in loaded


def test_importing_the_package_runs_nothing() -> None:
    assert modules_after("import fluxvla_core") & HEAVY == set()
    assert modules_after("from fluxvla_core import RUNNERS") & HEAVY == set()


def top_level_imports(path: Path) -> Iterator[str]:
    """Names of the packages that importing the module imports at once."""
    waiting: list[ast.AST] = [ast.parse(path.read_text(encoding="utf-8"))]
    while waiting:
        node = waiting.pop()
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)):
            continue
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            waiting += node.orelse
            continue
        if isinstance(node, ast.Import):
            yield from (name.name.split(".")[0] for name in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            yield (node.module or "").split(".")[0]
        waiting += ast.iter_child_nodes(node)


@pytest.mark.parametrize("package", ["torch", "numpy", "av", "pyarrow", "cv2", "rclpy", "rich"])
def test_heavy_libraries_stay_in_the_packages_that_are_about_them(package: str) -> None:
    home = AT_HOME.get(package, set())
    elsewhere = [
        str(path.relative_to(CORE))
        for path in sorted(CORE.rglob("*.py"))
        if path.relative_to(CORE).parts[0] not in home and package in top_level_imports(path)
    ]
    # rich's reporter is a module that is imported when a person is to see progress.
    allowed = {"cli/rich_reporter.py", *(WITH_A_MODEL if package == "torch" else ())}
    assert [p for p in elsewhere if p not in allowed] == []


def test_top_level_imports_are_distinguished_from_others(tmp_path: Path) -> None:
    module = tmp_path / "m.py"
    module.write_text(
        "import a.b\nfrom typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import c\n"
        "try:\n    import d\nexcept ImportError:\n    d = None\n"
        "def f():\n    import e\nclass G:\n    from h.i import j\nfrom . import k\n"
    )
    assert set(top_level_imports(module)) == {"a", "typing", "d", "h"}
