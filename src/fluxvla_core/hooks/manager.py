"""Calls the hooks that a config names, and keeps a run safe from them.

pluggy checks each hook's name and arguments against ``hooks.specs`` and does the calling. An
exception in a hook is reported with the hook's origin, and that plugin is left out for the rest
of the run: an observer must never end the training or the motion that it watches.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import pluggy

from fluxvla_core.errors import ConfigError, LoadFailed
from fluxvla_core.hooks import specs

if TYPE_CHECKING:
    from fluxvla_core.build import RunContext

hookimpl = pluggy.HookimplMarker("fluxvla")


class HookCaller:
    """``call("after_step", step=3, metrics={...})`` reaches every active hook, in config order."""

    def __init__(self, context: RunContext, plugins: Iterable[tuple[str, object]] = ()) -> None:
        self._context = context
        self._managers: list[tuple[str, pluggy.PluginManager]] = []
        for name, plugin in plugins:
            self._managers.append((name, _manager(name, plugin)))

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
        ConfigError: the value is no list of names and tables.
        PluginError: a hook cannot be had, or has a method that is no hook.
    """
    from fluxvla_core.build import build_from_cfg
    from fluxvla_core.plugins.registry import HOOKS

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
    manager.add_hookspecs(specs)
    marked = _Marked(plugin)
    if not marked.names:
        raise LoadFailed(
            f"hook plugin {name} has no method that is a hook",
            next=f"name its methods after the hooks: {', '.join(specs.NAMES)}",
        )
    try:
        manager.register(marked, name)
    except pluggy.PluginValidationError as error:
        raise LoadFailed(f"hook plugin {name}: {error}") from error
    return manager


class _Marked:
    """Presents a plain object's hook-named methods to pluggy as implementations."""

    def __init__(self, plugin: object) -> None:
        self.names = [n for n in specs.NAMES if callable(getattr(plugin, n, None))]
        for name in self.names:
            # A method cannot carry pluggy's mark; a function around it would hide its arguments.
            function = getattr(plugin, name).__func__
            hookimpl(function)
            setattr(self, name, getattr(plugin, name))
