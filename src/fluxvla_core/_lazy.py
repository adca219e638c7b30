"""Public modules whose names are imported when they are first used (PEP 562)."""

from __future__ import annotations

import importlib
import re
import sys
import warnings
from collections.abc import Callable, Mapping
from typing import Any

_IMPORT = re.compile(r"^    from ([\w.]+) import \(?\s*(\w+) as \2\b", re.MULTILINE)


def attach(
    module: str, deprecated: Mapping[str, str] | None = None
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """``__getattr__``, ``__dir__`` and ``__all__`` of a public module.

    Its names are those that it imports under ``if TYPE_CHECKING``, each as
    ``from package.module import Name as Name``. Type checkers and editors follow these imports;
    here they are read from the source, or from the bytecode where that alone is installed.

    Args:
        module: ``__name__`` of the public module.
        deprecated: old name -> the new one. An old name still works, with a DeprecationWarning; it
            is not in ``__all__``.
    """
    public: Any = sys.modules[module]
    if public.__file__.endswith(".pyc"):  # ``compileall -b``, and the sources removed
        sources = _imports_of(public.__loader__.get_code(module))
        sources = {name: source for name, source in sources.items() if name not in vars(public)}
    else:
        # By the loader: the package may be in an archive.
        text = public.__loader__.get_data(public.__file__).decode()
        sources = {name: source for source, name in _IMPORT.findall(text)}
    renamed = dict(deprecated or {})

    def __getattr__(name: str) -> Any:
        if name in renamed:
            message = f"{module}.{name} is deprecated, use {module}.{renamed[name]}"
            warnings.warn(message, DeprecationWarning, stacklevel=2)
            return getattr(public, renamed[name])
        source = sources.get(name)
        if source is None:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        package = public if source == module else importlib.import_module(source)
        if package is not public and hasattr(package, name):
            value = getattr(package, name)
        else:  # a module of the package
            value = importlib.import_module(f"{source}.{name}")
        setattr(public, name, value)
        return value

    def __dir__() -> list[str]:
        return sorted({*vars(public), *sources})

    return __getattr__, __dir__, sorted(sources)


def _imports_of(code: Any) -> dict[str, str]:
    """Name -> module, of every ``from module import name`` of a module's bytecode."""
    import dis

    sources, package = {}, ""
    for instruction in dis.get_instructions(code):
        if instruction.opname == "IMPORT_NAME":
            package = instruction.argval
        elif instruction.opname == "IMPORT_FROM":
            sources[instruction.argval] = package
    return sources
