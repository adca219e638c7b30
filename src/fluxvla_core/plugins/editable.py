"""Editable installations whose ``pyproject.toml`` has got other entry points since.

``pip install -e`` uses the sources in place, but copies the entry points: a plugin that was added
later is not found. The source folder of a distribution is in its ``direct_url.json`` (PEP 610).
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fluxvla_core.plugins import _metadata
from fluxvla_core.plugins._metadata import Index, canonical
from fluxvla_core.registries import PREFIX

Points = Mapping[tuple[str, str], str]
"""(group, name) -> ``module:Class``."""
_URL = "direct_url.json"


@dataclass(frozen=True)
class Stale:
    """An installation that is older than the entry points of its sources.

    Args:
        dist: the distribution.
        version: of the installation.
        source: the folder of its ``pyproject.toml``.
        stated: the entry points there, in groups of FluxVLA.
        installed: those that are installed.
    """

    dist: str
    version: str | None
    source: Path
    stated: Points
    installed: Points

    def __str__(self) -> str:
        new = [f"+{name}" for _, name in sorted(self.stated.keys() - self.installed.keys())]
        gone = [f"-{name}" for _, name in sorted(self.installed.keys() - self.stated.keys())]
        both = sorted(self.stated.keys() & self.installed.keys())
        moved = [f"{k[1]} = {self.stated[k]}" for k in both if self.stated[k] != self.installed[k]]
        origin = f"{self.dist} {self.version}" if self.version else self.dist
        return (
            f"{origin}: pyproject.toml changed since it was installed "
            f"({', '.join([*new, *gone, *moved])}); run: pip install -e {self.source}"
        )


def stale(index: Index) -> Iterator[Stale]:
    """Every editable installation of ``index`` whose entry points differ from its sources'."""
    for name, folder in sorted(index.folders.items()):
        source = _source(folder)
        if source is None or not _metadata.wanted(name):
            continue
        project = _project(source)
        if "entry-points" in project.get("dynamic", ()):
            continue
        stated = _stated(project)
        installed = {
            key: plugin.value.strip()
            for key, several in index.plugins.items()
            for plugin in several
            if canonical(plugin.dist) == name and key[0].startswith(PREFIX)
        }
        if project and stated != installed:
            dist = str(project.get("name", name))
            yield Stale(dist, _metadata.version(name), source, stated, installed)


def named_since(name: str, index: Index) -> str:
    """The message for a plugin ``name`` that sources have and their installation lacks, or ""."""
    for one in stale(index):
        if any(name == stated for _, stated in one.stated.keys() - one.installed.keys()):
            return str(one)
    return ""


def _source(folder: str) -> Path | None:
    """The source folder of a ``.dist-info`` installed in editable mode; None for others."""
    try:
        about = json.loads(Path(folder, _URL).read_text(encoding="utf-8"))
        if not about["dir_info"]["editable"]:
            return None
        url = str(about["url"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
    from urllib.parse import unquote, urlsplit

    parts = urlsplit(url)
    return Path(os.path.normpath(unquote(parts.path))) if parts.scheme == "file" else None


def _project(source: Path) -> Mapping[str, Any]:
    """The table ``project``; empty where there is none, or it cannot be read."""
    import tomli

    try:
        found = tomli.loads((source / "pyproject.toml").read_text(encoding="utf-8")).get("project")
    except (OSError, ValueError):  # pip reports it
        return {}
    return found if isinstance(found, dict) else {}


def _stated(project: Mapping[str, Any]) -> Points:
    groups = project.get("entry-points", {})
    if not isinstance(groups, dict):
        return {}
    return {
        (group, name): str(value).strip()
        for group, points in groups.items()
        if group.startswith(PREFIX) and isinstance(points, dict)
        for name, value in points.items()
    }
