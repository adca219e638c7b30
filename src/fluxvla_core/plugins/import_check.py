"""Check that plugins can be imported, each distribution in a process of its own.

An import may hang, crash, print or change its process.
"""

from __future__ import annotations

import multiprocessing
import os
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from itertools import groupby
from multiprocessing.connection import Connection, wait

from fluxvla_core.contracts.check import check_class
from fluxvla_core.errors import PluginError
from fluxvla_core.plugins._metadata import Plugin
from fluxvla_core.plugins.load import load
from fluxvla_core.registries import PREFIX
from fluxvla_core.signals import held_back, leave_stopping_to_the_parent, signal_name

_AT_ONCE = 2  # importing torch takes a core and half a gigabyte

Plugins = tuple[Plugin, ...]


def problems(
    plugins: Iterable[Plugin],
    limit_s: float,
    traces: bool,
    begins: Callable[[Plugins], object],
) -> Iterator[tuple[Plugin, str]]:
    """A text for each plugin that cannot be imported or breaks its contract, as they are found.

    Args:
        plugins: of groups that the core reads.
        limit_s: for one import. After one that takes longer, no other module of its distribution
            is tried: they may all wait for the same thing.
        traces: include tracebacks.
        begins: called with the plugins of each distribution when its turn comes.
    """
    in_order = sorted(plugins, key=lambda p: (p.origin, p.module))
    waiting = deque(tuple(group) for _, group in groupby(in_order, lambda p: p.origin))
    running: list[_Importer] = []
    try:
        while waiting or running:
            while waiting and len(running) < _AT_ONCE:
                begins(waiting[0])
                running.append(_Importer(waiting.popleft(), limit_s, traces))
            soonest = min(importer.deadline for importer in running)
            wait([i.connection for i in running], max(0.0, soonest - time.monotonic()))
            for importer in list(running):
                yield from importer.new_problems()
                if importer.done:
                    running.remove(importer)
                    importer.end()
                    waiting.extendleft([importer.rest] if importer.rest else [])
    finally:
        for importer in running:
            importer.end()


def in_one_line(error: PluginError) -> str:
    """The problem and its fix, in one line."""
    return error.what + (f"; {error.next}" if error.next else "")


class _Importer:
    """A process that imports ``plugins``, all of one distribution, in their order.

    Attributes:
        connection: readable when there is an answer.
        deadline: of the import under way, on the monotonic clock.
        rest: plugins for another process to try, once this one is ``done``.
    """

    def __init__(self, plugins: Plugins, limit_s: float, traces: bool) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe(duplex=False)
        self._process = context.Process(target=_import, args=(theirs, plugins, traces))
        with held_back("spawn"):
            self._process.start()
        theirs.close()
        self._left = plugins
        self._limit_s = limit_s
        self.deadline = time.monotonic() + limit_s
        self.rest: Plugins = ()

    @property
    def done(self) -> bool:
        return not self._left

    def new_problems(self) -> Iterator[tuple[Plugin, str]]:
        """The problems since the last time."""
        while self._left and self.connection.poll():
            try:
                text = self.connection.recv()
            except (EOFError, OSError):
                yield from self._crashed()
                return
            plugin, *left = self._left
            self._left, self.deadline = tuple(left), time.monotonic() + self._limit_s
            if text:
                yield plugin, text
        if self._left and time.monotonic() > self.deadline:
            yield from self._hangs()

    def end(self) -> None:
        self.connection.close()
        self._process.kill()
        self._process.join()

    def _crashed(self) -> Iterator[tuple[Plugin, str]]:
        self._process.join()
        module = self._left[0].module
        cause = _cause(self._process.exitcode)
        hint = f"; python -X faulthandler -c 'import {module}' shows where"
        yield from self._lost(f"ended the interpreter ({cause}){hint}")
        self.rest = tuple(p for p in self._left if p.module != module)
        self._left = ()

    def _hangs(self) -> Iterator[tuple[Plugin, str]]:
        also = [p.name for p in self._left if p.module != self._left[0].module]
        untried = f"; {', '.join(also)} not tried after that" if also else ""
        yield from self._lost(f"did not end in {self._limit_s:g} s{untried}")
        self._left = ()

    def _lost(self, how: str) -> Iterator[tuple[Plugin, str]]:
        module = self._left[0].module
        for plugin in self._left:
            if plugin.module == module:
                provides = f"{plugin.origin} provides {plugin.name!r}"
                yield plugin, f"{provides} but importing {module!r} {how}"


def _import(connection: Connection, plugins: Plugins, traces: bool) -> None:
    """The process: sends one problem per plugin, empty if there is none."""
    leave_stopping_to_the_parent()
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(nowhere, stream)
    for plugin in plugins:
        connection.send(_problem(plugin, traces))


def _problem(plugin: Plugin, traces: bool) -> str:
    try:
        check_class(plugin.group.removeprefix(PREFIX), load(plugin), plugin.origin)
    except PluginError as error:
        return f"{error.what}\n{traceback.format_exc()}" if traces else in_one_line(error)
    return ""


def _cause(exitcode: int | None) -> str:
    if exitcode is not None and exitcode < 0:
        return signal_name(-exitcode)
    return f"exit status {exitcode}"
