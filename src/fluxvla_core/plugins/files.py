"""``--plugin FILE``: Python files whose classes register themselves in this process.

A worker process is a new interpreter: it loads what :func:`plugin_files` names in its parent.
"""

from __future__ import annotations

import importlib.util
import sys
import traceback
from collections.abc import Iterable
from pathlib import Path

from fluxvla_core.errors import FluxError, LoadFailed, UsageError
from fluxvla_core.plugins.registry import BY_NAME

PLUGIN_FILE = "fluxvla_plugin_"
"""What the modules that are made of these files are called, before the name of the file."""
_loaded: dict[str, Path] = {}  # module -> its file


def load_plugin_files(files: Iterable[str | Path]) -> None:
    """Execute each file as a module of its own.

    Raises:
        UsageError: it is not there, or is not a Python file.
        LoadFailed: it raises, or registers a class that breaks a contract.
    """
    for name in files:
        _load(Path(name))


def plugin_files() -> tuple[str, ...]:
    """Absolute paths of the files that this process loaded, in their order."""
    return tuple(str(path.resolve()) for path in _loaded.values())


def forget_plugin_files() -> None:
    """Unregister what the files registered; for tests."""
    for registry in BY_NAME.values():
        for key in list(registry):
            if getattr(registry.registered(key), "__module__", "") in _loaded:
                registry.unregister(key)
    for module in _loaded:
        sys.modules.pop(module, None)
    _loaded.clear()


def _load(path: Path) -> None:
    if not path.is_file():
        raise UsageError(f"--plugin {path}: there is no such file")
    if path.suffix != ".py":
        raise UsageError(f"--plugin {path}: not a .py file")
    module = f"{PLUGIN_FILE}{path.stem}".replace("-", "_")
    spec = importlib.util.spec_from_file_location(module, path)
    if spec is None or spec.loader is None:
        raise UsageError(f"--plugin {path}: Python cannot load it")
    loaded = importlib.util.module_from_spec(spec)
    sys.modules[module] = loaded
    try:
        spec.loader.exec_module(loaded)
    except BaseException as error:
        del sys.modules[module]
        if isinstance(error, FluxError) or not isinstance(error, (Exception, SystemExit)):
            raise
        steps = traceback.extract_tb(error.__traceback__)
        lines = [s.lineno for s in steps if Path(s.filename).resolve() == path.resolve()]
        line = lines[-1] if lines else getattr(error, "lineno", None)
        raise LoadFailed(
            f"--plugin {path}: raised {type(error).__name__}: {error}",
            where=f"{path}:{line}" if line else str(path),
        ) from error
    _loaded[module] = path
