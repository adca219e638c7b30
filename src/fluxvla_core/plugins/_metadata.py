"""Index of installed entry points, from one scan of metadata, without importing plugins.

``.dist-info`` folders are read here: importing ``importlib.metadata`` takes as long as all the rest
of ``fluxvla plugins list``. It reads everything else (an ``.egg-info`` with plugins, an archive,
distributions of other finders). No other module imports it: importing the backport, too, would
disable the finder of the standard library's.
"""

from __future__ import annotations

import functools
import os
import re
import stat
import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fluxvla_core.errors import nearest
from fluxvla_core.registries import GROUPS, PREFIX

CORE = "fluxvla-core"
_ENTRY_POINTS = "entry_points.txt"
# The most bytes of each file; METADATA holds the whole readme, "" is an .egg-info that is a file.
_AT_MOST = {
    _ENTRY_POINTS: 1 << 18,
    "METADATA": 1 << 22,
    "PKG-INFO": 1 << 22,
    "requires.txt": 1 << 18,
    "": 1 << 22,
}


@dataclass(frozen=True)
class Plugin:
    """One entry point as the metadata states it, before anything is loaded."""

    group: str
    name: str
    value: str
    dist: str
    version: str
    requires: tuple[str, ...] = ()

    @property
    def origin(self) -> str:
        """``fluxvla-ur 0.3.0``: how messages name the distribution."""
        return f"{self.dist} {self.version}"

    def to_dict(self) -> dict[str, str]:
        """JSON values for ``plugins list --json`` and ``environment.json``."""
        return {
            "group": self.group,
            "name": self.name,
            "distribution": self.dist,
            "version": self.version,
            "value": self.value,
        }

    @property
    def module(self) -> str:
        return self.value.partition(":")[0].strip()

    @property
    def attribute(self) -> str:
        return self.value.partition(":")[2].partition("[")[0].strip()


@dataclass(frozen=True)
class Index:
    """Everything that is installed under a ``fluxvla.`` group, or a misspelling of one.

    Args:
        plugins: (group, name) -> every provider, sorted by distribution.
        broken: one ``where: reason`` line for each distribution that could not be read.
        folders: canonical name -> ``.dist-info`` folder of every installed distribution.
        versions: canonical name -> version of the distributions with plugins.
    """

    plugins: Mapping[tuple[str, str], tuple[Plugin, ...]]
    broken: tuple[str, ...]
    folders: Mapping[str, str] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)


@functools.cache
def canonical(name: str) -> str:
    """A distribution's name as PyPI compares it (PEP 503)."""
    return re.sub(r"[-_.]+", "-", name).lower()


def intended_group(group: str) -> str | None:
    """The group of the core that ``group`` is a misspelling of; None if of none.

    Capitals, separators and single letters: ``fluxvla-runners``, ``fluxvla_runners``,
    ``FluxVLA.Runners``, ``fluxvla.runner``.
    """
    plain = re.sub(r"[-_.:/\s]+", ".", group.strip()).lower()
    if group in GROUPS or not plain.startswith(PREFIX[:2]):  # comparing words takes long
        return None
    return nearest(plain, GROUPS, 0.85)


def _groups_of(text: str) -> set[str]:
    """FluxVLA's groups in an ``entry_points.txt``, also misspelt ones."""
    low = text.lower()  # most files have none, which is seen fastest by these letters
    if PREFIX not in text and "vla" not in low and "flux" not in low:
        return set()
    named = re.findall(r"^[ \t]*\[(.*)\][ \t]*$", text.replace("\r", ""), re.MULTILINE)
    return {g for g in map(str.strip, named) if g.startswith(PREFIX) or _is_slip(g)}


def _is_slip(group: str) -> bool:
    """Whether a group outside ``fluxvla.`` is a misspelling of one of the core's."""
    return group.lower() == PREFIX.rstrip(".") or intended_group(group) is not None


@functools.cache
def index() -> Index:
    """The index, from a scan of every folder of ``sys.path``; cached.

    ``FLUXVLA_PLUGINS=ur,fsdp`` includes only those distributions (and the core); empty means none.
    ``FLUXVLA_BLOCK=ur`` excludes those. Names may drop the ``fluxvla-`` prefix.
    """
    plugins: dict[tuple[str, str], list[Plugin]] = {}
    broken: set[str] = set()
    folders: dict[str, str] = {}
    versions: dict[str, str] = {}
    names: set[str] = set()
    # Never metadata.entry_points(): one malformed file in any distribution ends it for all.
    for dist in _distributions():
        where = dist.path if isinstance(dist, _Folder) else getattr(dist, "_path", dist)
        if isinstance(dist, _Folder) and dist.is_dist_info:
            folders.setdefault(dist.stated_name, dist.path)
        try:
            groups = _groups_of(dist.read_text(_ENTRY_POINTS) or "")
            if not groups:
                continue
            if os.path.basename(str(where)).startswith("~"):
                raise ValueError("leftover of an interrupted uninstall; delete this folder")
            about = dist.about() if isinstance(dist, _Folder) else dist
            name = about.metadata["Name"]
            if not name:
                raise ValueError("its METADATA is missing or has no Name; reinstall it")
            key = canonical(name)
            if key in names:  # shadowed by an earlier sys.path entry
                continue
            names.add(key)
            if not wanted(key):
                continue
            version, requires = about.version, tuple(about.requires or ())
            if not version:
                raise ValueError("its METADATA has no Version; reinstall it")
            versions[key] = version
            for point in about.entry_points:
                if point.group in groups:
                    plugin = Plugin(point.group, point.name, point.value, name, version, requires)
                    plugins.setdefault((plugin.group, plugin.name), []).append(plugin)
        except Exception as error:  # noqa: BLE001 - one broken distribution must not hide the others
            broken.add(f"{where}: {type(error).__name__}: {error}")
    # The scan follows os.listdir, whose order is not stable.
    ordered = {k: tuple(sorted(v, key=lambda p: canonical(p.dist))) for k, v in plugins.items()}
    return Index(ordered, tuple(sorted(broken)), folders, versions)


def version(dist: str) -> str | None:
    """The installed version of a distribution, or None."""
    known = index().versions.get(canonical(dist))
    if known is not None:
        return known
    try:
        found = _distribution(dist)
        return None if found is None else found.version
    except (OSError, ValueError):
        return None


def requirements(dist: str) -> tuple[str, ...]:
    """The requirements of a distribution (PEP 508); none if it is missing or cannot be read."""
    try:
        found = _distribution(dist)
    except (OSError, ValueError):
        return ()
    return () if found is None else tuple(found.requires or ())


def with_required(dists: Iterable[str], depth: int, extras: bool = False) -> dict[str, str]:
    """Versions of the distributions and of their installed requirements, except the core's.

    Args:
        depth: how many steps to follow requirements.
        extras: also follow, in the first step, requirements of extras: plugins name their
            simulators there.
    """
    from packaging.requirements import InvalidRequirement, Requirement

    found: dict[str, str] = {}
    names = list(dists)
    for _ in range(depth + 1):
        following: list[str] = []
        for name in names:
            if canonical(name) in found:
                continue
            try:
                dist = _distribution(name)
            except (OSError, ValueError):
                continue
            if dist is None or dist.version is None:
                continue
            found[canonical(name)] = dist.version
            for text in () if canonical(name) == CORE else dist.requires or ():
                try:
                    requirement = Requirement(text)
                except InvalidRequirement:
                    continue
                marker = requirement.marker
                if extras or marker is None or marker.evaluate({"extra": ""}):
                    following.append(requirement.name)
        names, extras = following, False
    return found


class _Folder:
    """A ``.dist-info`` or ``.egg-info`` on ``sys.path``; its files are read when asked for."""

    def __init__(self, path: str) -> None:
        self.path = path

    @property
    def is_dist_info(self) -> bool:
        return self.path.lower().endswith(".dist-info")

    @property
    def stated_name(self) -> str:
        """The distribution's canonical name as the folder's name has it."""
        return canonical(os.path.basename(self.path)[: -len(".dist-info")].partition("-")[0])

    def read_text(self, name: str) -> str | None:
        """A file in it; None where there is none.

        Raises:
            OSError: it cannot be read: permissions, links in a circle, a failing disk.
            ValueError: it is a folder, a pipe or the like, larger than such files are, or no UTF-8.
        """
        try:
            # Without O_NONBLOCK, opening a pipe waits for a writer.
            flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0)
            descriptor = os.open(os.path.join(self.path, name) if name else self.path, flags)
        except (FileNotFoundError, NotADirectoryError):
            return None
        try:
            found = os.fstat(descriptor)
            if stat.S_ISDIR(found.st_mode) and not name:  # an .egg-info of files
                return None
            if not stat.S_ISREG(found.st_mode):
                raise ValueError(f"{name} is not a regular file")
            if found.st_size > _AT_MOST[name]:
                raise ValueError(
                    f"{name} holds {found.st_size} bytes, {_AT_MOST[name]} are the most"
                )
            return os.read(descriptor, _AT_MOST[name]).decode("utf-8")
        finally:
            os.close(descriptor)

    def about(self) -> Any:
        """The metadata: a :class:`_DistInfo`, or importlib's for an ``.egg-info``.

        Raises:
            OSError, ValueError: see :meth:`read_text`.
        """
        if self.is_dist_info:
            return _DistInfo(self)
        for name in _AT_MOST:
            self.read_text(name)
        return _importlib_metadata().PathDistribution(Path(self.path))


@dataclass(frozen=True)
class _EntryPoint:
    group: str
    name: str
    value: str


class _DistInfo:
    """The attributes of ``importlib.metadata.Distribution`` that are used, of a ``.dist-info``."""

    def __init__(self, folder: _Folder) -> None:
        self._folder = folder
        # The headers (RFC 822) end at the first empty line; the readme follows.
        self._headers: list[tuple[str, str]] = []
        for line in (folder.read_text("METADATA") or "").replace("\r\n", "\n").split("\n"):
            name, colon, value = line.partition(":")
            if line[:1] in {" ", "\t"} and self._headers:
                name, before = self._headers.pop()
                self._headers.append((name, f"{before}\n{line}"))
            elif not colon:
                break
            else:
                self._headers.append((name.lower(), value.strip()))
        self.metadata = {"Name": self._first("name")}
        self.version = self._first("version")
        self.requires = [value for name, value in self._headers if name == "requires-dist"]

    def _first(self, name: str) -> str | None:
        return next((value for header, value in self._headers if header == name), None)

    @property
    def entry_points(self) -> Iterator[_EntryPoint]:
        group = ""
        for line in map(str.strip, (self._folder.read_text(_ENTRY_POINTS) or "").splitlines()):
            if line.startswith("[") and line.endswith("]"):
                group = line.strip("[]")
            elif line and not line.startswith("#") and group:
                name, equals, value = line.partition("=")
                if not equals:
                    raise ValueError(f"{_ENTRY_POINTS}: no '=' in {line[:80]!r}")
                yield _EntryPoint(group, name.strip(), value.strip())


def _distributions() -> Iterator[Any]:
    """All installed distributions, in the order in which one shadows another."""
    for place in dict.fromkeys(sys.path):
        try:
            names = os.listdir(place or ".")
        except NotADirectoryError:  # an archive
            yield from _importlib_metadata().distributions(path=[place])
            continue
        except (OSError, ValueError):
            continue
        for name in names:
            low = name.lower()
            if low.endswith((".dist-info", ".egg-info")) or (
                low == "egg-info" and place.lower().endswith(".egg")
            ):
                yield _Folder(os.path.join(place, name))
    for finder in sys.meta_path:
        name = getattr(finder, "__name__", type(finder).__name__)
        # The path finders, the backport's too, look where it was looked above.
        if hasattr(finder, "find_distributions") and "PathFinder" not in name:
            yield from finder.find_distributions()


def _distribution(name: str) -> Any | None:
    """The distribution called ``name``; None if there is none.

    Raises:
        OSError, ValueError: its METADATA cannot be read.
    """
    folder = index().folders.get(canonical(name))
    if folder is not None:
        return _DistInfo(_Folder(folder))
    metadata = _importlib_metadata()
    try:
        return metadata.distribution(name)
    except metadata.PackageNotFoundError:
        return None


def _importlib_metadata() -> Any:
    if sys.version_info >= (3, 11):
        import importlib.metadata as metadata
    else:  # 3.10's copy keeps no order and no origin for what it finds
        import importlib_metadata as metadata
    return metadata


def wanted(dist: str) -> bool:
    if dist == CORE:
        return True
    only, block = os.environ.get("FLUXVLA_PLUGINS"), os.environ.get("FLUXVLA_BLOCK", "")
    if only is not None and dist not in _dists(only):
        return False
    return dist not in _dists(block)


def _dists(text: str) -> set[str]:
    parts = {canonical(part.strip()) for part in text.split(",") if part.strip()}
    return parts | {f"fluxvla-{part}" for part in parts}
