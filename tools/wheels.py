"""Build the wheels of the repository's distributions into dist/, those whose sources changed."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path

from tools.envs import Env
from tools.project import Distribution

RECORD = ".fingerprints.json"


def wheel_of(dist: Distribution, folder: Path) -> Path | None:
    """The wheel of a distribution in a folder; None when there is none or more than one."""
    found = list(folder.glob(f"{dist.stem}-*.whl"))
    return found[0] if len(found) == 1 else None


def build(dists: Sequence[Distribution], folder: Path, builder: Env) -> dict[str, Path]:
    """Wheels of all ``dists`` in ``folder``, by distribution name; raises StepFailed.

    ``builder`` is an environment with pip and the build backend. A wheel whose sources have the
    recorded fingerprint is kept as it is.
    """
    folder.mkdir(parents=True, exist_ok=True)
    record = _read(folder)
    stale = [
        d for d in dists if record.get(d.name) != d.fingerprint() or wheel_of(d, folder) is None
    ]
    for dist in stale:
        record.pop(dist.name, None)
        for old in folder.glob(f"{dist.stem}-*.whl"):
            old.unlink()
    if stale:
        _write(folder, record)
        flags = ["-q", "--no-deps", "--no-build-isolation", "-w", str(folder)]
        builder.run("python", "-m", "pip", "wheel", *flags, *(str(d.path) for d in stale))
        _write(folder, {**record, **{d.name: d.fingerprint() for d in stale}})
    made = {d.name: wheel_of(d, folder) for d in dists}
    return {name: path for name, path in made.items() if path is not None}


def builder_env(root: Path, constraints: Path) -> Env:
    """An environment with the build backend alone."""
    env = Env(root)
    base = {"python": sys.version, "constraints": constraints.read_text(encoding="utf-8")}

    def backend() -> None:
        env.pip_install("hatchling", constraints=constraints)

    env.filled(base, {}, backend, lambda changed, fresh: None)
    return env


def _read(folder: Path) -> dict[str, str]:
    try:
        content = json.loads((folder / RECORD).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def _write(folder: Path, record: dict[str, str]) -> None:
    (folder / RECORD).write_text(json.dumps(record, indent=1), encoding="utf-8")
