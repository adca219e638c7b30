"""Load a plugin class by name: find the one plugin that provides it, check it, import it.

``locate`` finds the source file of a module without importing it.
"""

from __future__ import annotations

import functools
import importlib
import importlib.util
import operator
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from fluxvla_core.errors import (
    AmbiguousPlugin,
    IncompatiblePlugin,
    LoadFailed,
    MissingPlugin,
    nearest,
)
from fluxvla_core.plugins import _metadata, first_party
from fluxvla_core.plugins._metadata import CORE, Plugin, canonical
from fluxvla_core.registries import GROUPS, PREFIX

LIST = "fluxvla plugins list"
DOCTOR = "fluxvla plugins doctor"
TRACES = f"FLUXVLA_STRICT=1 {DOCTOR} shows the traceback"

_COMPARE: Final[Mapping[str, Any]] = {
    ">=": operator.ge,
    ">": operator.gt,
    "<=": operator.le,
    "<": operator.lt,
}


def find(group: str, name: str, also: tuple[str, ...] = ()) -> Plugin:
    """The one installed plugin called ``name``, or ``distribution:name``.

    A name that the core provides always means the core's; another distribution's is reached as
    ``distribution:name``. Installing a package must not change the meaning of a config.

    Args:
        also: names registered in this process, offered with the installed ones.

    Raises:
        MissingPlugin: with a did-you-mean, or the pip command when a first-party plugin has it.
        AmbiguousPlugin: several distributions provide it, the core not among them.
    """
    dist, _, short = name.rpartition(":")
    providers = _metadata.index().plugins.get((group, short), ())
    hits = [p for p in providers if not dist or canonical(p.dist) == canonical(dist)]
    hits = [p for p in hits if is_core(p)] or hits
    if len(hits) == 1:
        return hits[0]
    if hits:
        who = ", ".join(f"{p.origin} ({p.value})" for p in hits)
        raise AmbiguousPlugin(f"{group}: {short!r} is provided by {who}", next=choose(hits))
    raise MissingPlugin(*_missing(group, name, short, also), next=LIST)


def is_core(plugin: Plugin) -> bool:
    """Whether the core itself provides it."""
    return canonical(plugin.dist) == CORE


def core_provides(group: str, name: str) -> bool:
    """Whether ``name`` means a class of the core, whatever else is installed."""
    return any(is_core(p) for p in _metadata.index().plugins.get((group, name), ()))


def choose(plugins: Sequence[Plugin]) -> str:
    """The advice for choosing one of several plugins with the same name."""
    names = [f"{p.dist}:{p.name}" for p in plugins]
    if plugins[0].group == PREFIX + "commands":
        ways = " or ".join(f"fluxvla {name}" for name in names)
        return f"run {ways}, or uninstall one"
    return f"write type={' or type='.join(map(repr, names))} to choose, or uninstall one"


def _missing(group: str, name: str, short: str, also: tuple[str, ...]) -> tuple[str]:
    registry = group.removeprefix(PREFIX)
    installed = sorted({n for g, n in _metadata.index().plugins if g == group} | set(also))
    text = f"no {group} plugin named {name!r}"
    provider = first_party.owner(registry, short)
    unread = not_read(short)
    if unread:
        text += f"; {unread}"
    elif provider:
        text += f"; {provider} provides it and is not installed: pip install {provider}"
    else:
        near = nearest(short, [*installed, *first_party.names(registry)])
        if near:
            text += f"; did you mean {near!r}?"
            if near not in installed:
                dist = first_party.owner(registry, near)
                text += f" ({dist} provides it and is not installed: pip install {dist})"
    broken = _metadata.index().broken
    if broken:
        text += f"\n  {len(broken)} installed distribution(s) could not be read: {DOCTOR}"
    return (f"{text}\n  installed: {', '.join(installed) or '(none)'}",)


def not_read(name: str) -> str:
    """The message for a plugin ``name`` that is installed and cannot be found, or "".

    It is in a group that nothing reads, or in a ``pyproject.toml`` that changed since the
    distribution was installed.
    """
    for (group, found), providers in sorted(_metadata.index().plugins.items()):
        if found == name and group not in GROUPS:
            return unread_group(providers[0])
    from fluxvla_core.plugins.editable import named_since

    return named_since(name, _metadata.index())


def unread_group(plugin: Plugin) -> str:
    """The message for a plugin in a group that nothing reads, with the nearest group."""
    meant = _metadata.intended_group(plugin.group)
    hint = f"; did its author mean {meant!r}?" if meant else ""
    return f"{plugin.origin}: {plugin.name} is in {plugin.group!r}, which nothing reads{hint}"


EXACT: Final = frozenset({"transformers"})
"""Distributions that models are built from: with another version than a plugin declares, the same
weights may silently give other numbers."""


def unmet(plugin: Plugin) -> str | None:
    """Why the plugin's own requirement on the core, or on one of ``EXACT``, does not hold, or None.

    ``pip install --no-deps``, conda and ROS overlays bypass pip's check, so it is repeated.
    """
    found = _first_unmet(plugin)
    return None if found is None else found[0]


def upgrade(plugin: Plugin) -> str:
    """The pip command that fixes :func:`unmet`."""
    found = _first_unmet(plugin)
    wanted = "" if found is None else found[1]
    return f"pip install {wanted}" if wanted else f"pip install --upgrade {plugin.dist} {CORE}"


def _first_unmet(plugin: Plugin) -> tuple[str, str] | None:
    if is_core(plugin):
        return None
    named = (re.match(r"[\w.-]+", text) for text in plugin.requires)
    names = {canonical(name[0]) for name in named if name is not None}
    for name in (CORE, *sorted(EXACT & names)):
        found = _unmet(plugin.origin, plugin.requires, name, _metadata.version(name))
        if found is not None:
            return found
    return None


@functools.cache  # a distribution has many plugins
def _unmet(
    origin: str, requires: tuple[str, ...], name: str, have: str | None
) -> tuple[str, str] | None:
    """Why version ``have`` of ``name`` is not accepted, and the requirement for pip; the latter is
    empty for the core, which several plugins require."""
    if have and _certainly_met(requires, name, have):
        return None
    from packaging.requirements import InvalidRequirement, Requirement

    for text in requires:
        try:
            requirement = Requirement(text)
        except InvalidRequirement as error:
            return f"{origin} has a requirement that cannot be read: {error}", ""
        if canonical(requirement.name) != name:
            continue
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": ""}):
            continue
        if have and not requirement.specifier.contains(have, prereleases=True):
            ranges = sorted(map(str, requirement.specifier), reverse=True)  # ">=5,<6"
            wanted = f"{requirement.name}{','.join(ranges)}"
            why = f"{origin} needs {wanted}, but {have} is installed"
            return why, "" if name == CORE else f"'{wanted}'"
    return None


def _certainly_met(requires: tuple[str, ...], dist: str, have: str) -> bool:
    """Whether ``have`` of ``dist`` fulfils plain ranges such as ``fluxvla-core>=0.1,<0.2``.

    Importing ``packaging``, which decides all other cases, takes a third of ``config check``.
    """
    release = r"\d+(?:\.\d+)*"
    if not re.fullmatch(release, have):
        return False
    for text in requires:
        name = re.match(r"[\w.-]+", text)
        if name is not None and canonical(name[0]) != dist:
            continue
        stated = re.fullmatch(r"[\w.-]+(?:\[[\w, -]*\])?\s*(?P<ranges>[\d.,<>= ]*)", text)
        if stated is None:
            return False
        for clause in filter(None, stated["ranges"].split(",")):
            found = re.fullmatch(rf"(>=|>|<=|<)\s*({release})", clause.strip())
            if found is None or not _COMPARE[found[1]](_release(have), _release(found[2])):
                return False
    return True


def _release(version: str) -> tuple[int, ...]:
    """``1.2.0`` -> ``(1, 2)``: zeros at the end do not matter."""
    return tuple(map(int, re.sub(r"(\.0+)+$", "", version).split(".")))


def load(plugin: Plugin) -> Any:
    """Import the module that the entry point names and return its object.

    Raises:
        IncompatiblePlugin: the plugin needs another version of the core, or of one of ``EXACT``.
        LoadFailed: the import fails; the message names the distribution and the reason.
    """
    why = unmet(plugin)
    if why:
        raise IncompatiblePlugin(
            f"{plugin.group}:{plugin.name}: {why}",
            next=upgrade(plugin),
        )
    provides = f"{plugin.origin} provides {plugin.name!r} but"
    module = plugin.module
    try:
        found: Any = importlib.import_module(module)
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] == module.partition(".")[0]:
            raise LoadFailed(
                f"{provides} its own module {error.name!r} is missing",
                cause="a stale or orphaned install",
                next=f"reinstall {plugin.dist}",
            ) from error
        raise LoadFailed(
            f"{provides} it needs {error.name!r}, which is not installed{_where(error, module)}",
            next=f"pip install {plugin.dist} again with its dependencies, or install {error.name}",
        ) from error
    except KeyboardInterrupt:
        raise
    except (Exception, SystemExit) as error:
        text = error.msg if isinstance(error, SyntaxError) else error
        raise LoadFailed(
            f"{provides} raised {type(error).__name__} on import: {text}{_where(error, module)}",
            next=TRACES,
        ) from error
    for part in plugin.attribute.split("."):
        if not hasattr(found, part):
            raise LoadFailed(
                f"{plugin.origin}: entry point {plugin.name} = {plugin.value!r} names an object "
                "that does not exist",
                next=f"reinstall {plugin.dist}, or report it to its author",
            )
        found = getattr(found, part)
    return found


def _where(error: BaseException, module: str) -> str:
    """`` (package/module.py:line)``: the last frame in ``module``'s package."""
    import traceback  # slow to import

    if isinstance(error, SyntaxError) and error.filename:
        return f" ({place(Path(error.filename), module, error.lineno or 1)})"
    top = module.partition(".")[0]
    places = [
        place(Path(frame.f_code.co_filename), top, line)
        for frame, line in traceback.walk_tb(error.__traceback__)
        if str(frame.f_globals.get("__name__", "")).partition(".")[0] == top
    ]
    return f" ({places[-1]})" if places else ""


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
