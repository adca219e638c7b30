"""Registries: views over entry-point groups, and the classes that this process registered itself.

``--plugin FILE`` registers the classes of a Python file. A worker process is a new interpreter: it
loads what :func:`plugin_files` names in its parent.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from fluxvla_core.errors import FluxError, LoadFailed, PluginError, UsageError
from fluxvla_core.plugins import _metadata
from fluxvla_core.plugins._metadata import Plugin, canonical
from fluxvla_core.plugins.load import core_provides, find, load
from fluxvla_core.registries import PREFIX, ROWS

T = TypeVar("T", bound=Callable[..., Any])

PLUGIN_FILE = "fluxvla_plugin_"
"""Prefix of the names of the modules that are made from plugin files."""
_loaded: dict[str, Path] = {}  # module -> its file


class Registry:
    """Names to classes. An installed class is imported when it is first requested by name."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.group = PREFIX + name
        self._here: dict[str, Any] = {}
        self._loaded: dict[str, Any] = {}
        self._failed: dict[str, PluginError] = {}

    def register_module(self, name: str | None = None, *, force: bool = False) -> Callable[[T], T]:
        """Decorator that registers a class in this process, under its own name by default.

        For notebooks, tests and ``fluxvla run --plugin FILE``; a distribution uses entry points.

        Raises:
            LoadFailed: the name is the core's or is taken in this process (``force=True`` replaces
                it), or the class breaks the registry's contract.
        """

        def register(cls: T) -> T:
            key = name or cls.__name__
            present = self._here.get(key)
            if present is not None and present is not cls and not force:
                raise LoadFailed(
                    f"{self.group}: {key!r} is already registered in this process, "
                    f"by {present.__module__}",
                    next="give one of them another name, or say force=True",
                )
            if not force and core_provides(self.group, key):
                # An installed plugin may do this as it is imported, for another of its classes.
                raise LoadFailed(
                    f"{self.group}: {key!r} is the core's own and {cls.__module__} registers "
                    "another class under that name",
                    next="give it another name, or say force=True to replace the core's",
                )
            self._check(cls, f"{cls.__module__}:{cls.__qualname__}")
            self._here[key] = cls
            return cls

        return register

    def get(self, name: str) -> Any:
        """The class called ``name`` (or ``distribution:name``).

        A class registered in this process comes first. A load failure is kept and raised again.

        Raises:
            PluginError: nothing, or more than one, provides the name, or it cannot be loaded.
        """
        if name in self._here:
            return self._here[name]
        if name in self._failed:
            raise self._failed[name]
        if name not in self._loaded:
            try:
                plugin = find(self.group, name, tuple(self._here))
                cls = load(plugin)
                self._check(cls, plugin.origin)
            except PluginError as error:
                self._failed[name] = error
                raise
            self._loaded[name] = cls
        return self._loaded[name]

    def registered(self, name: str) -> Any | None:
        """The class that this process registered under ``name``, or None; imports nothing."""
        return self._here.get(name)

    def installed(self) -> dict[str, tuple[Plugin, ...]]:
        """Every installed name with its providers; imports nothing."""
        items = _metadata.index().plugins.items()
        return {name: plugins for (group, name), plugins in items if group == self.group}

    def unregister(self, name: str) -> None:
        """Forget what this process registered under ``name``."""
        self._here.pop(name, None)

    def _check(self, cls: Any, origin: str) -> None:
        # Not needed to list names or to check a config.
        from fluxvla_core.contracts.check import check_class

        check_class(self.name, cls, origin)

    def __contains__(self, name: object) -> bool:
        """Whether ``name``, or ``distribution:name``, is registered or installed."""
        if name in self._here:
            return True
        dist, _, short = str(name).rpartition(":")
        providers = _metadata.index().plugins.get((self.group, short), ())
        return any(not dist or canonical(p.dist) == canonical(dist) for p in providers)

    def __iter__(self) -> Iterator[str]:
        return iter(sorted({*self._here, *self.installed()}))

    def __repr__(self) -> str:
        return f"Registry({self.name!r}: {', '.join(self) or 'empty'})"


BY_NAME: dict[str, Registry] = {row.name: Registry(row.name) for row in ROWS}

if TYPE_CHECKING:  # the names that the table makes; a test compares them
    RUNNERS: Registry
    OPERATORS: Registry
    VLAS: Registry
    VISION_BACKBONES: Registry
    LLM_BACKBONES: Registry
    VLM_BACKBONES: Registry
    PROJECTORS: Registry
    HEADS: Registry
    DATASETS: Registry
    TRANSFORMS: Registry
    COLLATORS: Registry
    TOKENIZERS: Registry
    PROCESSORS: Registry
    METRICS: Registry
    OPTIMIZERS: Registry
    ACTION_FILTERS: Registry
    HOOKS: Registry
    ENVIRONMENTS: Registry
    POLICIES: Registry
    CHECKPOINT_FORMATS: Registry
    COMMANDS: Registry
else:
    globals().update({row.constant: BY_NAME[row.name] for row in ROWS})


# -- plugin files ----------------------------------------------------------------------------------


def load_plugin_files(files: Iterable[str | Path]) -> None:
    """Execute each file as a module of its own.

    Raises:
        UsageError: it is missing, or is not a Python file.
        LoadFailed: it raises, or registers a class that breaks a contract.
    """
    for path in map(Path, files):
        if not path.is_file():
            raise UsageError(f"--plugin {path}: there is no such file")
        if path.suffix != ".py":
            raise UsageError(f"--plugin {path}: not a .py file")
        _execute(path)


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


def _execute(path: Path) -> None:
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
        import traceback

        steps = traceback.extract_tb(error.__traceback__)
        lines = [s.lineno for s in steps if Path(s.filename).resolve() == path.resolve()]
        line = lines[-1] if lines else getattr(error, "lineno", None)
        raise LoadFailed(
            f"--plugin {path}: raised {type(error).__name__}: {error}",
            where=f"{path}:{line}" if line else str(path),
        ) from error
    _loaded[module] = path
