"""One scan of the installed distributions' metadata; nothing of theirs is imported.

The only module that imports ``importlib.metadata``: importing the backport beside the standard
library's disables the latter's finder, so there must be one place that chooses.
"""

from __future__ import annotations

import functools
import os
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass

if sys.version_info >= (3, 11):
    import importlib.metadata as metadata
else:  # 3.10's copy keeps no order and no origin for what it finds
    import importlib_metadata as metadata

from fluxvla_core.plugins.groups import PREFIX

CORE = "fluxvla-core"


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

    @property
    def module(self) -> str:
        return self.value.partition(":")[0].strip()

    @property
    def attribute(self) -> str:
        return self.value.partition(":")[2].partition("[")[0].strip()


@dataclass(frozen=True)
class Index:
    """Everything that is installed under a ``fluxvla.`` group.

    ``plugins`` maps (group, name) to every provider, sorted by distribution; ``broken`` holds
    one ``where: reason`` line for each distribution that could not be read.
    """

    plugins: Mapping[tuple[str, str], tuple[Plugin, ...]]
    broken: tuple[str, ...]


def canonical(name: str) -> str:
    """A distribution's name as PyPI compares it (PEP 503)."""
    return re.sub(r"[-_.]+", "-", name).lower()


@functools.cache
def index() -> Index:
    """The scan. Cached: nothing in ``importlib.metadata`` is, and a second scan costs as much.

    ``FLUXVLA_PLUGINS=ur,fsdp`` sees only those distributions (and the core); empty means none.
    ``FLUXVLA_BLOCK=ur`` leaves those out. Names may drop the ``fluxvla-`` prefix.
    """
    found: dict[tuple[str, str], list[Plugin]] = {}
    broken: list[str] = []
    seen: set[str] = set()
    # Never metadata.entry_points(): one malformed file in any distribution ends it for all.
    for dist in metadata.distributions():
        where = getattr(dist, "_path", dist)
        try:
            if PREFIX not in (dist.read_text("entry_points.txt") or ""):
                continue
            if getattr(where, "name", "").startswith("~"):
                raise ValueError("leftover of an interrupted uninstall; delete this folder")
            name = dist.metadata["Name"]
            if not name:
                raise ValueError("its METADATA is missing or has no Name; reinstall it")
            key = canonical(name)
            if key in seen:  # shadowed by an earlier sys.path entry
                continue
            seen.add(key)
            if not _wanted(key):
                continue
            for point in dist.entry_points:
                if point.group.startswith(PREFIX):
                    plugin = Plugin(
                        point.group,
                        point.name,
                        point.value,
                        name,
                        dist.version,
                        tuple(dist.requires or ()),
                    )
                    found.setdefault((plugin.group, plugin.name), []).append(plugin)
        except Exception as error:  # noqa: BLE001 - one broken distribution must not hide the others
            broken.append(f"{where}: {type(error).__name__}: {error}")
    # The scan follows os.listdir, whose order is not stable.
    ordered = {k: tuple(sorted(v, key=lambda p: canonical(p.dist))) for k, v in found.items()}
    return Index(ordered, tuple(sorted(broken)))


def version(dist: str) -> str | None:
    """The installed version of a distribution, or None."""
    try:
        return metadata.version(dist)
    except metadata.PackageNotFoundError:
        return None


def _wanted(dist: str) -> bool:
    if dist == CORE:
        return True
    only, block = os.environ.get("FLUXVLA_PLUGINS"), os.environ.get("FLUXVLA_BLOCK", "")
    if only is not None and dist not in _dists(only):
        return False
    return dist not in _dists(block)


def _dists(text: str) -> set[str]:
    parts = {canonical(part.strip()) for part in text.split(",") if part.strip()}
    return parts | {f"fluxvla-{part}" for part in parts}
