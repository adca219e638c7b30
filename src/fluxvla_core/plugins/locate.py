"""Find a module's source file without importing anything, and name places in it."""

from __future__ import annotations

import importlib.util
from pathlib import Path


def locate(module: str) -> Path | None:
    """Source file of ``module``, or None.

    ``find_spec("a.b")`` would import ``a``, so only the top-level name is looked up and the rest
    is followed on disk.
    """
    top, *rest = module.split(".")
    try:
        spec = importlib.util.find_spec(top)
    except (ImportError, ValueError):
        return None
    if spec is None:
        return None
    if not spec.submodule_search_locations:
        return Path(spec.origin) if spec.origin and not rest else None
    for root in map(Path, spec.submodule_search_locations):
        base = root.joinpath(*rest)
        for file in (base / "__init__.py", base.with_suffix(".py")):
            if file.is_file():
                return file
    return None


def place(path: Path, module: str, line: int) -> str:
    """``package/module.py:line``: short, and enough to find it."""
    top = module.partition(".")[0]
    parts = path.parts
    start = len(parts) - 1 - parts[::-1].index(top) if top in parts else len(parts) - 1
    return f"{'/'.join(parts[start:])}:{line}"
