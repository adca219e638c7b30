"""Hooks: calls the observers of a run that its config names, without letting them disturb it.

They have methods of :class:`fluxvla_core.contracts.runner.Hook`. pluggy checks names and arguments
and calls them, each hook in a thread of its own: the run queues a call and continues. A hook that
raises, ends its thread or falls behind is reported once and left out for the rest of the run: an
observer must never end, or delay, a training or a motion. It can still hold the GIL or end the
process.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
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


MOST_WAITING = 10_000
"""Calls that may wait for a hook, whatever its ``budget_s``: their arguments take memory."""
_LATE_TWICE_S = 0.2


class HookCaller:
    """``call("after_step", step=3, metrics={...})`` reaches every active hook, in config order."""

    def __init__(self, context: RunContext, plugins: Iterable[tuple[str, object]] = ()) -> None:
        self._context = context
        self._observers = [_Observer(name, plugin) for name, plugin in plugins]
        self._lock = threading.Lock()

    def call(self, hook: str, **arguments: Any) -> None:
        """Call each hook; returns at once, except for ``run_finished``, which waits for them.

        A hook that failed since the last call is reported, and left out from then on.
        """
        observers = list(self._observers)
        for observer in observers:
            observer.enqueue(hook, {"context": self._context, **arguments})
        if hook == "run_finished":
            for observer in observers:
                observer.finish()
        for observer in observers:
            problem = observer.trouble()
            if problem and self._remove(observer):
                self._context.reporter.warn(
                    f"hook {observer.name}.{problem}; "
                    f"{observer.name} is left out for the rest of this run"
                )
            if problem or hook == "run_finished":
                observer.end()

    def _remove(self, observer: _Observer) -> bool:
        """Whether this call removed it: a robot's events come from several threads."""
        with self._lock:
            if observer not in self._observers:
                return False
            self._observers.remove(observer)
            return True

    def settle(self) -> None:
        """Wait until all queued calls are done; for tests."""
        for observer in self._observers:
            observer.finish()

    def __bool__(self) -> bool:
        return bool(self._observers)


class _Observer:
    """One hook, and the thread that calls it.

    Raises:
        LoadFailed: it has no method that is a hook, or one with other arguments.
        ConfigError: its ``budget_s`` is not a positive number.
    """

    def __init__(self, name: str, plugin: object) -> None:
        self.name = name
        self._manager, self._hooks = _manager(name, plugin)
        self._budget_s = Hook.adapt(plugin).budget_s
        number = isinstance(self._budget_s, (int, float)) and not isinstance(self._budget_s, bool)
        if not number or not 0 < self._budget_s < math.inf:
            raise ConfigError(
                f"hook {name}: budget_s must be a positive number, got {self._budget_s!r}"
            )
        self._changed = threading.Condition()
        self._waiting: deque[tuple[float, str, dict[str, Any]]] = deque()  # the first is under way
        self._problem = ""
        self._late_since: float | None = None
        self._ended = False
        self._thread: threading.Thread | None = None

    def enqueue(self, hook: str, arguments: dict[str, Any]) -> None:
        """Have the method called in the hook's thread, if the hook has it."""
        if hook not in self._hooks:
            return
        with self._changed:
            if self._ended:
                return
            if self._thread is None:
                target, name = self._call, f"hook-{self.name}"
                self._thread = threading.Thread(target=target, name=name, daemon=True)
                try:
                    self._thread.start()
                except RuntimeError as error:  # the system has no more of them
                    self._problem = f"{hook} raised {type(error).__name__}: {error}"
                    return
            self._waiting.append((time.monotonic(), hook, arguments))
            self._changed.notify_all()

    def trouble(self) -> str:
        """The problem of this hook: ``after_step raised ...``; empty if there is none.

        A hook is late if it is late twice, a moment apart: after a pause of the process all are.
        """
        with self._changed:
            if self._problem or not self._waiting:
                self._late_since = None
                return self._problem
            now = time.monotonic()
            since, hook, _ = self._waiting[0]
            if len(self._waiting) > MOST_WAITING:
                self._problem = f"{hook} keeps {len(self._waiting)} calls waiting"
            elif now - since <= self._budget_s:
                self._late_since = None
            elif self._late_since is None:
                self._late_since = now
            elif now - self._late_since >= _LATE_TWICE_S:
                self._problem = self._slow(hook, now - since)
            return self._problem

    def finish(self) -> None:
        """Wait until all queued calls are done, at most for its budget."""
        with self._changed:
            done = lambda: not self._waiting or bool(self._problem)  # noqa: E731
            if not self._changed.wait_for(done, min(self._budget_s, threading.TIMEOUT_MAX)):
                since, hook, _ = self._waiting[0]
                self._problem = self._slow(hook, time.monotonic() - since)

    def end(self) -> None:
        """Stop calling it; a call under way is not waited for."""
        with self._changed:
            self._ended = True
            self._waiting.clear()
            self._changed.notify_all()

    def _slow(self, hook: str, seconds: float) -> str:
        return f"{hook} is {seconds:.1f} s behind the run, and may be {self._budget_s:g} s"

    def _call(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._ended)
                if self._ended:
                    return
                _, hook, arguments = self._waiting[0]
            try:
                getattr(self._manager.hook, hook)(**arguments)
                problem = ""
            except BaseException as error:  # noqa: BLE001 - an observer never ends what it observes
                problem = f"{hook} raised {type(error).__name__}: {error}"
            with self._changed:
                if not self._ended:
                    self._waiting.popleft()
                self._problem = self._problem or problem
                self._changed.notify_all()
                if self._problem:
                    return


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


def _manager(name: str, plugin: object) -> tuple[pluggy.PluginManager, frozenset[str]]:
    """pluggy's manager of one hook, and the names of its methods."""
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
    return manager, frozenset(marked.names)


class _Marked:
    """The hook methods of an object, marked as implementations for pluggy."""

    def __init__(self, plugin: object) -> None:
        defined = [name for name in NAMES if implements(plugin, Hook, name)]
        self.names = [name for name in defined if callable(getattr(plugin, name))]
        for name in self.names:
            method = getattr(plugin, name)
            # A method cannot carry pluggy's mark; a function around it would hide its arguments.
            _implemented(method.__func__)
            setattr(self, name, method)
