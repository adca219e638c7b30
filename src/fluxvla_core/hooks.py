"""Hooks: calls the observers that a config names, and keeps a run safe from them.

What they may observe is :class:`fluxvla_core.contracts.Hook`. pluggy checks each hook's name and
arguments against it and does the calling. An exception in a hook is reported with the hook's
origin, and that plugin is left out for the rest of the run: an observer must never end the training
or the motion that it watches.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pluggy

from fluxvla_core.build import RunContext, build_from_cfg
from fluxvla_core.contracts.contract import implements, public_methods
from fluxvla_core.contracts.runner import Hook
from fluxvla_core.errors import ConfigError, LoadFailed
from fluxvla_core.plugins.registry import HOOKS

NAMES = tuple(public_methods(Hook))
"""The hooks that there are."""

_specified = pluggy.HookspecMarker("fluxvla")
_implemented = pluggy.HookimplMarker("fluxvla")
for _function in public_methods(Hook).values():
    _specified(_function)


class HookCaller:
    """``call("after_step", step=3, metrics={...})`` reaches every active hook, in config order."""

    def __init__(self, context: RunContext, plugins: Iterable[tuple[str, object]] = ()) -> None:
        self._context = context
        self._managers = [(name, _manager(name, plugin)) for name, plugin in plugins]

    def call(self, hook: str, **arguments: Any) -> None:
        """Call ``hook`` on each plugin; one that raises is reported and left out from then on."""
        for entry in list(self._managers):
            name, manager = entry
            try:
                getattr(manager.hook, hook)(context=self._context, **arguments)
            except Exception as error:  # noqa: BLE001 - an observer never ends what it observes
                self._managers.remove(entry)
                self._context.reporter.warn(
                    f"hook {name}.{hook} raised {type(error).__name__}: {error}; "
                    f"{name} is left out for the rest of this run"
                )

    def __bool__(self) -> bool:
        return bool(self._managers)


def build_hooks(context: RunContext) -> HookCaller:
    """The hooks that ``config['hooks']`` names: a list of class names or tables with ``type``.

    Raises:
        ConfigError: the value is not a list of names and tables.
        PluginError: a hook cannot be loaded, or has a method that is not a hook.
    """
    wanted = context.config.get("hooks", ())
    if not isinstance(wanted, (list, tuple)):
        raise ConfigError(
            f"hooks must be a list of names or tables, got {wanted!r}",
            where=context.where("hooks"),
        )
    plugins: list[tuple[str, object]] = []
    for item in wanted:
        table = {"type": item} if isinstance(item, str) else item
        plugins.append((str(table.get("type")), build_from_cfg(table, HOOKS, context)))
    return HookCaller(context, plugins)


def _manager(name: str, plugin: object) -> pluggy.PluginManager:
    # One manager for each plugin: within one, pluggy stops at the first exception.
    manager = pluggy.PluginManager("fluxvla")
    manager.add_hookspecs(Hook)
    marked = _Marked(plugin)
    if not marked.names:
        raise LoadFailed(
            f"hook plugin {name} has no method that is a hook",
            next=f"name its methods after the hooks: {', '.join(NAMES)}",
        )
    try:
        manager.register(marked, name)
    except pluggy.PluginValidationError as error:
        raise LoadFailed(f"hook plugin {name}: {error}") from error
    return manager


class _Marked:
    """Presents the hook-named methods that an object brings to pluggy as implementations."""

    def __init__(self, plugin: object) -> None:
        brought = [name for name in NAMES if implements(plugin, Hook, name)]
        self.names = [name for name in brought if callable(getattr(plugin, name))]
        for name in self.names:
            method = getattr(plugin, name)
            # A method cannot carry pluggy's mark; a function around it would hide its arguments.
            _implemented(method.__func__)
            setattr(self, name, method)
