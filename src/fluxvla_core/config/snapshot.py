"""Snapshots of a run's config and environment, so that it can be run again."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fluxvla_core import atomic
from fluxvla_core.config.load import CONFIG_FILE, FORMAT
from fluxvla_core.config.tree import Config
from fluxvla_core.plugins._metadata import CORE, index, version

ENVIRONMENT_FILE = "environment.json"
_LOOKED_AT = 2000  # folders: a hint is not worth a walk over a whole disk
_PACKAGES = ("torch", "numpy", "pyarrow", "av", "mujoco", "transformers", "rclpy")


def write_resolved(path: Path, config: Config) -> None:
    """Write ``config`` so that ``load_config(path)`` gives it back, key for key.

    Raises:
        OSError: as opening, writing and renaming do; an older file stays as it was.
    """
    atomic.write_json(
        path,
        {"format": FORMAT, "config": config.tree, "origins": dict(sorted(config.origins.items()))},
    )


def environment() -> dict[str, Any]:
    """Python, the core, every installed plugin and the versions of what they compute with.

    Reads metadata; imports nothing.
    """
    import platform

    plugins = [
        plugin.to_dict() for _, providers in sorted(index().plugins.items()) for plugin in providers
    ]
    return {
        "format": "fluxvla-environment-1",
        "python": platform.python_version(),
        "platform": platform.platform(),
        CORE: version(CORE),
        "packages": {name: have for name in _PACKAGES if (have := version(name))},
        "plugins": plugins,
    }


def work_dirs_below(folder: Path, depth: int = 3) -> list[Path]:
    """Work dirs of earlier runs in ``folder``, for a hint: the newest first, not all of many."""
    found: list[tuple[float, Path]] = []
    level, looked = [folder], 0
    for _ in range(depth):
        below: list[Path] = []
        for place in level:
            for inner in _folders_in(place):
                looked += 1
                config = inner / CONFIG_FILE
                if looked > _LOOKED_AT:
                    break
                if config.is_file():  # what lies inside is its sections' and checkpoints'
                    found.append((config.stat().st_mtime, inner))
                else:
                    below.append(inner)
        level = below
    return [path for _, path in sorted(found, reverse=True)]


def _folders_in(place: Path) -> list[Path]:
    try:
        return [p for p in place.iterdir() if not p.name.startswith(".") and p.is_dir()]
    except OSError:  # not ours to read, or gone by now
        return []
