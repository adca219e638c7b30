"""Declared dependencies of plugins that are not there, though nothing has imported them yet.

``pip install --no-deps``, conda and ROS overlays leave them out, and pip uninstalls what another
distribution needs. A message names the distribution (``pyserial``), not the module (``serial``).
"""

from __future__ import annotations

from collections.abc import Iterator

from packaging.requirements import InvalidRequirement, Requirement

from fluxvla_core.plugins import _metadata
from fluxvla_core.plugins._metadata import CORE, Plugin, canonical


def unmet_requirements(plugin: Plugin) -> Iterator[str]:
    """One text for each requirement of ``plugin``'s distribution that does not hold.

    Those of extras that it asks of others (``fluxvla-core[data]``) are followed; its own extras are
    the user's choice. What it needs of the core is checked where it is loaded.
    """
    yield from _unmet(plugin.requires, frozenset({""}), plugin.origin, set())


def _unmet(
    requires: tuple[str, ...], extras: frozenset[str], whose: str, seen: set[tuple[str, str]]
) -> Iterator[str]:
    """Requirements of ``requires`` whose markers hold with one of ``extras``."""
    for text in requires:
        try:
            wanted = Requirement(text)
        except InvalidRequirement:  # ``unmet`` tells this one
            continue
        marker = wanted.marker
        if marker is not None and not any(marker.evaluate({"extra": extra}) for extra in extras):
            continue
        if "" not in extras and (marker is None or marker.evaluate({"extra": ""})):
            continue  # it is required without these extras, too
        have = _metadata.version(wanted.name)
        stated = f"{wanted.name}{wanted.specifier}"
        if have is None:
            yield f"{whose} requires {stated}, which is not installed: pip install '{stated}'"
            continue
        met = wanted.specifier.contains(have, prereleases=True)
        if not met and canonical(wanted.name) != CORE:
            yield f"{whose} requires {stated}, but {wanted.name} {have} is installed"
        new = {e for e in wanted.extras if (canonical(wanted.name), e) not in seen}
        if new:
            seen |= {(canonical(wanted.name), e) for e in new}
            through = f"{whose} requires {wanted.name}[{','.join(sorted(new))}], and that"
            yield from _unmet(_metadata.requirements(wanted.name), frozenset(new), through, seen)
