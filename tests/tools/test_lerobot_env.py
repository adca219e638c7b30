"""What LeRobot's environment is given so that a CPU build of torch is enough for it."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from tools.envs import Env
from tools.lerobot_env import declare_operators

EXTENSION = "def _has_ops():\n    return {}\n\n\n_check_cuda_version()\n"


def extension(root: Path, loaded: bool) -> Path:
    module = root / "lib" / "python3.12" / "site-packages" / "torchvision" / "extension.py"
    module.parent.mkdir(parents=True)
    module.write_text(EXTENSION.format(loaded), encoding="utf-8")
    return module


def defined(module: Path) -> list[str]:
    """What torchvision's module defines when it is imported."""
    found: list[str] = []
    library = SimpleNamespace(define=found.append)
    torch = SimpleNamespace(library=SimpleNamespace(Library=lambda name, kind: library))
    names = {"torch": torch, "_check_cuda_version": lambda: None}
    exec(compile(module.read_text(encoding="utf-8"), str(module), "exec"), names)
    return [text.partition("(")[0] for text in found]


def test_operators_are_declared_where_the_library_is_not_loaded(tmp_path: Path) -> None:
    module = extension(tmp_path, loaded=False)
    declare_operators(Env(tmp_path))
    once = module.read_text(encoding="utf-8")
    assert defined(module) == ["nms", "qnms"]
    declare_operators(Env(tmp_path))
    assert module.read_text(encoding="utf-8") == once


def test_where_the_library_is_loaded_they_are_not_declared_again(tmp_path: Path) -> None:
    module = extension(tmp_path, loaded=True)
    declare_operators(Env(tmp_path))
    assert defined(module) == []


def test_an_environment_without_torchvision(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="not enough values"):
        declare_operators(Env(tmp_path))
