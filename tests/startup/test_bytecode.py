"""An installation of bytecode alone (``python -m compileall -b``) has every public name."""

from __future__ import annotations

import compileall
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.test_surface import SURFACE

SOURCES = Path(__file__).resolve().parents[2] / "src" / "fluxvla_core"


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("bytecode")
    package = root / "fluxvla_core"
    shutil.copytree(SOURCES, package, ignore=shutil.ignore_patterns("__pycache__", "templates"))
    assert compileall.compile_dir(package, quiet=2, legacy=True)
    for source in package.rglob("*.py"):
        source.unlink()
    return root


def test_public_modules_have_their_names(installed: Path) -> None:
    modules = [module for module in SURFACE if not module.startswith("fluxvla_core.testing.")]
    code = f"""
import importlib
import fluxvla_core
assert fluxvla_core.__file__.endswith(".pyc"), fluxvla_core.__file__
for name in {modules}:
    module = importlib.import_module(name)
    print(name, *sorted(set(module.__all__) - {{"__version__"}}))
print(fluxvla_core.training.World.__name__, fluxvla_core.Joint.__name__)
"""
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        cwd=installed,
        env={"PYTHONPATH": str(installed), "PATH": "/usr/bin"},
        check=False,
    )
    assert done.returncode == 0, done.stderr
    *lines, used = done.stdout.splitlines()
    found = {line.split()[0]: line.split()[1:] for line in lines}
    assert found == {
        module: [name for name in SURFACE[module] if name != "__version__"] for module in modules
    }
    assert used == "World Joint"
