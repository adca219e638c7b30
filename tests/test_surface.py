"""The public modules: pinned, light to import, and all that plugins, examples and pages use."""

from __future__ import annotations

import ast
import importlib
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import tomli

ROOT = Path(__file__).resolve().parent.parent
PINNED = ROOT / "tests" / "surface.txt"
CORE = "fluxvla_core"
LINTER = (sys.executable, "-c", "from importlinter.cli import lint_imports_command as run; run()")
HEAVY = ("torch", "rclpy", "mujoco", "av", "pyarrow", "cv2", "transformers")


def pinned() -> dict[str, list[str]]:
    """Public module -> its names, as ``tests/surface.txt`` has them."""
    found: dict[str, list[str]] = {}
    for line in PINNED.read_text().splitlines():
        module, _, name = line.partition(": ")
        found.setdefault(module, []).append(name)
    return found


SURFACE = pinned()


@pytest.mark.parametrize("module", SURFACE)
def test_the_names_of_a_public_module_are_pinned(module):
    """What is here holds for years: a change of it is a change of tests/surface.txt, on purpose."""
    public = importlib.import_module(module)
    assert sorted(public.__all__) == SURFACE[module]
    assert public.__doc__
    for name in public.__all__:
        assert getattr(public, name) is not None


def type_checked(module: str) -> set[str]:
    """Names that a public module imports for type checkers and editors."""
    source = importlib.import_module(module).__file__
    assert source is not None
    blocks = [
        node
        for node in ast.parse(Path(source).read_text()).body
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
    ]
    return {
        alias.name
        for block in blocks
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
        if alias.asname
    }


@pytest.mark.parametrize("module", SURFACE)
def test_type_checkers_know_what_is_imported_lazily(module):
    public = importlib.import_module(module)
    lazy = "_lazy" in vars(public) and module != CORE
    assert not lazy or type_checked(module) == {n for n in public.__all__ if n[0] != "_"}


def test_importing_a_public_module_imports_nothing_heavy():
    modules = [m for m in SURFACE if not m.startswith(f"{CORE}.testing")]
    code = f"""
import sys
for module in {modules}:
    __import__(module)
print(*[name for name in {HEAVY} if name in sys.modules])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


def test_using_all_names_of_data_imports_nothing_heavy():
    code = f"""
import sys
from fluxvla_core.data import *
print(*[name for name in (*{HEAVY}, "tokenizers", "multiprocessing.pool") if name in sys.modules])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


@pytest.mark.parametrize("name", SURFACE["fluxvla_core.data"])
def test_a_name_of_data_is_explained(name):
    data = importlib.import_module("fluxvla_core.data")
    assert getattr(data, name).__name__ == name
    assert getattr(data, name).__doc__
    assert f"``{name}``" in data.__doc__
    assert name in dir(data)


@pytest.mark.parametrize("module", SURFACE)
def test_another_name_is_not_there(module):
    with pytest.raises(AttributeError, match=rf"{module}' has no attribute 'Nothing'"):
        _ = importlib.import_module(module).Nothing


def test_a_deprecated_name_works_and_names_the_new_one():
    training = importlib.import_module("fluxvla_core.training")
    assert "share_buffers" not in training.__all__
    with pytest.warns(DeprecationWarning, match=r"share_buffers is deprecated, use .*\.broadcast_"):
        assert training.share_buffers is training.broadcast_buffers
    with pytest.warns(DeprecationWarning, match=r"left_out is deprecated, use .*external_weights"):
        assert training.left_out is training.external_weights


def test_a_train_runner_s_deprecated_attribute_is_the_new_one():
    from fluxvla_core.testing.training import OneProcessRunner

    runner = object.__new__(OneProcessRunner)
    with pytest.warns(DeprecationWarning, match="left_out is deprecated, use external_weights"):
        runner.left_out = "found"
    with pytest.warns(DeprecationWarning, match="left_out is deprecated"):
        assert runner.left_out == runner.external_weights == "found"


def python_of(path: Path) -> list[str]:
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".py":
        return [text]
    return re.findall(r"^```python[^\n]*\n(.*?)^```", text, flags=re.S | re.M)


def imported(text: str) -> Iterator[tuple[str, str]]:
    """``(module, name)`` of what a program imports of the core; the name is empty for a module."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name.partition(".")[0] == CORE:
                    yield alias.name, ""
        elif isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] == CORE:
            for alias in node.names:
                yield node.module or "", alias.name


def private(text: str) -> list[str]:
    """What a program imports of the core that is not public."""
    return [
        f"{module}: {name}" if name else module
        for module, name in imported(text)
        if module not in SURFACE or (name and name not in SURFACE[module])
    ]


def programs() -> list[Path]:
    """What an author may have written: plugins, examples with their tests, pages, configs."""
    found = [
        *ROOT.glob("plugins/*/src/**/*.py"),
        *ROOT.glob("plugins/*/configs/**/*.py"),
        *ROOT.glob("examples/**/*.py"),
        *ROOT.glob("configs/**/*.py"),
        *ROOT.glob("docs/**/*.md"),
        *ROOT.glob("*.md"),
        *ROOT.glob("plugins/*/README.md"),
        *ROOT.glob("examples/*/README.md"),
    ]
    return [path for path in found if not {"build", "work_dirs"} & set(path.parts)]


@pytest.mark.parametrize("path", programs(), ids=lambda path: str(path.relative_to(ROOT)))
def test_only_public_names_are_imported(path):
    for text in python_of(path):
        try:
            assert private(text) == []
        except SyntaxError:  # a fragment, which tests/docs knows
            assert path.suffix == ".md"


def test_a_private_import_is_found():
    planted = "def f():\n    from fluxvla_core.training.model import trainable\n"
    assert private(planted) == ["fluxvla_core.training.model: trainable"]
    assert private("from fluxvla_core.training import _NEED") == ["fluxvla_core.training: _NEED"]


def public_modules() -> list[str]:
    """Below the top: those with a surface, and the modules that are names of one."""
    names = [f"{module}.{name}" for module, names in SURFACE.items() for name in names]
    files = (ROOT / "src" / (name.replace(".", "/") + ".py") for name in names)
    modules = [name for name, file in zip(names, files, strict=True) if file.exists()]
    return sorted({*SURFACE, *modules} - {CORE})


def test_the_linter_lets_plugins_import_the_public_modules_alone():
    config = tomli.loads((ROOT / "pyproject.toml").read_text())
    contracts = config["tool"]["importlinter"]["contracts"]
    (contract,) = [c for c in contracts if c["type"] == "protected"]
    assert contract["protected_modules"] == [f"{CORE}.**"]
    assert contract["ignore_imports"] == [f"** -> {module}" for module in public_modules()]


def test_the_linter_refuses_a_plugin_that_imports_what_is_not_public(tmp_path):
    planted = {
        "fluxvla_good": """
from fluxvla_core import RUNNERS
from fluxvla_core.ros2 import joints
from fluxvla_core.training import BaseTrainRunner
""",
        "fluxvla_bad": """
from fluxvla_core import build
from fluxvla_core.robot.process import link
from fluxvla_core.training.base_runner import BaseTrainRunner
""",
    }
    for name, text in planted.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text(text)
    contract = (ROOT / "pyproject.toml").read_text().partition("# Plugins import the public")[2]
    contract = contract[contract.index("name =") :].partition("\n\n")[0]
    config = tmp_path / "linter.toml"
    config.write_text(
        f"[tool.importlinter]\nroot_packages = {[CORE, *planted]}\n"
        f"[[tool.importlinter.contracts]]\n{contract}\n"
    )
    done = subprocess.run(
        [*LINTER, "--config", str(config), "--no-cache"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1, done.stdout + done.stderr
    found = re.findall(r"(fluxvla_\w+) -> fluxvla_core\.([\w.]+)", done.stdout)
    refused = ["build", "robot.process.link", "training.base_runner"]
    assert sorted(set(found)) == [("fluxvla_bad", module) for module in refused]
