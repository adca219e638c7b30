"""Public modules whose names are imported when they are first used (PEP 562)."""

from __future__ import annotations

import importlib
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any


def attach(
    module: str,
    exports: Mapping[str, Sequence[str]],
    deprecated: Mapping[str, str] | None = None,
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """``__getattr__``, ``__dir__`` and ``__all__`` of a public module.

    A module is exported by its own name alone: ``{"fluxvla_core.ros2.joints": ["joints"]}``.
    ``if TYPE_CHECKING`` imports next to it let type checkers and editors know the names;
    ``tests/test_surface.py`` compares the two.

    Args:
        module: ``__name__`` of the public module.
        exports: inner module -> names that it provides.
        deprecated: old name -> the new one. An old name still works, with a DeprecationWarning; it
            is not in ``__all__``.
    """
    sources = {name: source for source, names in exports.items() for name in names}
    renamed = dict(deprecated or {})
    modules = {s for s, names in exports.items() if list(names) == [s.rpartition(".")[2]]}

    def __getattr__(name: str) -> Any:
        if name in renamed:
            message = f"{module}.{name} is deprecated, use {module}.{renamed[name]}"
            warnings.warn(message, DeprecationWarning, stacklevel=2)
            return getattr(sys.modules[module], renamed[name])
        source = sources.get(name)
        if source is None:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        found = importlib.import_module(source)
        value = found if source in modules else getattr(found, name)
        setattr(sys.modules[module], name, value)
        return value

    def __dir__() -> list[str]:
        return sorted({*vars(sys.modules[module]), *sources})

    return __getattr__, __dir__, sorted(sources)
