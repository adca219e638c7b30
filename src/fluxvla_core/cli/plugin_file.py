"""``--plugin FILE``: a Python file whose classes register themselves in this process."""

from __future__ import annotations

import importlib.util
import sys
import traceback
from collections.abc import Iterable
from pathlib import Path

from fluxvla_core.errors import FluxError, LoadFailed, UsageError


def load_plugin_files(files: Iterable[str]) -> None:
    """Execute each file as a module of its own.

    Raises:
        UsageError: it is not there, or is no Python file.
        LoadFailed: it raises, or registers a class that breaks a contract.
    """
    for name in files:
        _load(Path(name))


def _load(path: Path) -> None:
    if not path.is_file():
        raise UsageError(f"--plugin {path}: there is no such file")
    if path.suffix != ".py":
        raise UsageError(f"--plugin {path}: not a .py file")
    module = f"fluxvla_plugin_{path.stem}".replace("-", "_")
    spec = importlib.util.spec_from_file_location(module, path)
    if spec is None or spec.loader is None:
        raise UsageError(f"--plugin {path}: Python cannot load it")
    loaded = importlib.util.module_from_spec(spec)
    sys.modules[module] = loaded
    try:
        spec.loader.exec_module(loaded)
    except BaseException as error:
        # Worker processes load every such module again; one that failed must not be among them.
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
