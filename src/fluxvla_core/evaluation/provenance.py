"""Provenance of results: code, versions, machine, commit, date, and seeds that were trained on.

An episode's outcome follows from its key, the evaluation's settings, the code that ran it and the
libraries below. The last two are a ``Code``: every evaluation log holds the one that its episodes
are from.
"""

from __future__ import annotations

import hashlib
import os
import platform
import subprocess
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import datetime, timezone
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from fluxvla_core.errors import DataError
from fluxvla_core.evaluation.collect import META, SETTINGS, SPARE_STRIDE
from fluxvla_core.plugins import _metadata
from fluxvla_core.plugins.registry import plugin_files
from fluxvla_core.untrusted import checked, read_json

SOURCES = (".py", ".xml")
WITHOUT_INFLUENCE = ("cli", "testing")
"""Packages of the core that no episode uses."""
DEPTH = 2
"""A plugin requires a simulator, which requires a physics engine. What these require, in turn, are
hundreds of tools that no outcome follows from."""


@dataclass(frozen=True)
class Code:
    """The versions and the source code that ran.

    Args:
        versions: distribution -> version: the core, the plugins that provide what a config names,
            and what these compute with.
        hash: of the sources of the core, those plugins and the ``fluxvla-`` distributions that
            they require, and of ``--plugin`` files.
    """

    versions: Mapping[str, str]
    hash: str

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON values."""
        return asdict(self)


def code_of(tables: Iterable[Any], simulators: Iterable[str], computes: Iterable[str]) -> Code:
    """The code of the plugins that ``tables`` name by ``type``, and of what they compute with.

    Args:
        tables: of a config, or of a checkpoint's.
        simulators: distributions that are used in addition to what the plugins require.
        computes: the same, without what these require.
    """
    types = [table.get("type") for given in tables for table in _tables_in(given)]
    names = {name.rpartition(":")[2] for name in types if isinstance(name, str)}
    used = [
        plugin
        for (_, name), providers in _metadata.index().plugins.items()
        for plugin in providers
        if name in names
    ]
    own = {plugin.dist for plugin in used} - {_metadata.CORE}
    versions = {
        **_metadata.with_required(own, DEPTH, extras=True),
        **_metadata.with_required(simulators, DEPTH),
        **_metadata.with_required([_metadata.CORE, "numpy", *computes], 0),
    }
    packages = {plugin.module.partition(".")[0] for plugin in used}
    # What these share with others (fluxvla-mujoco) is their code, too.
    packages |= {name.replace("-", "_") for name in versions if name.startswith("fluxvla-")}
    return Code(dict(sorted(versions.items())), _hash(sorted(packages)))


def provenance(code: Code) -> dict[str, Any]:
    """``date`` (UTC), ``commit``, ``versions``, ``code`` and ``machine``, as JSON values."""
    return {
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "commit": commit(Path(__file__).parent),
        "versions": dict(code.versions),
        "code": code.hash,
        "machine": machine(),
    }


def commit(folder: Path) -> str | None:
    """The commit of the git checkout that ``folder`` is tracked in, with ``+changes`` where files
    were changed since; None where there is none, or no git."""
    if _git(folder, "ls-files", "--error-unmatch", ".") is None:
        return None  # an environment within another repository
    head = _git(folder, "rev-parse", "HEAD")
    changed = _git(folder, "status", "--porcelain", "--untracked-files=no")
    return f"{head}+changes" if head and changed else head


def machine() -> str:
    """``x86_64, 2 CPUs (their name), Linux 6.1``."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    cpus = f"{os.cpu_count()} CPUs" + (f" ({names[0]})" if names else "")
    return f"{platform.machine()}, {cpus}, {platform.system()} {platform.release()}"


def unseen_seeds(tables: Any, environment: Any, seeds: Iterable[int]) -> bool | None:
    """Whether none of ``seeds`` was among those that demonstrations were collected with.

    Args:
        tables: of a checkpoint's config, from which its datasets are found.
        environment: the ``type`` of what is evaluated; seeds of another one mean something else.

    Returns:
        None where a dataset does not say how it was collected.
    """
    given = [table.get("data_root_path") for table in _tables_in(tables)]
    listed = [each if isinstance(each, (list, tuple)) else [each] for each in given]
    roots = [root for each in listed for root in each if isinstance(root, str)]
    collections = [_collection(Path(root)) for root in roots]
    if not roots or None in collections:
        return None
    for collection in collections:
        assert collection is not None
        if collection["environment"].get("type") != environment:
            continue
        first, count = collection["seed"], collection["episodes"]
        if any((seed - first) % SPARE_STRIDE < count for seed in seeds):
            return False
    return True


def _collection(root: Path) -> dict[str, Any] | None:
    try:
        found = read_json(root / META / SETTINGS, dict[str, Any], DataError)
        whole = {"environment": dict[str, Any], "seed": int, "episodes": int}
        return {
            name: checked(found.get(name), kind, DataError, name) for name, kind in whole.items()
        }
    except DataError:
        return None


def rendering(records: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Rendering of the images of ``records``: ``sizes`` (camera -> height, width), and ``by``
    (GL backend and renderer), which has several entries where machines differ."""
    images = [record["images"] for record in records if record.get("images")]
    return {
        "sizes": {name: size for each in images for name, size in each["sizes"].items()},
        "by": sorted({each["by"] for each in images if each["by"]}),
    }


def _tables_in(value: Any) -> Iterator[Mapping[str, Any]]:
    """``value``, if it is a table, and every table below it."""
    if isinstance(value, Mapping):
        yield value
        value = list(value.values())
    if isinstance(value, (list, tuple)):
        for each in value:
            yield from _tables_in(each)


def _hash(packages: Iterable[str]) -> str:
    digest = hashlib.sha256()
    for package in packages:
        spec = find_spec(package)
        for root in (spec.submodule_search_locations or []) if spec is not None else []:
            for path in sorted(Path(root).rglob("*")):
                inner = path.relative_to(root)
                skipped = package == "fluxvla_core" and inner.parts[0] in WITHOUT_INFLUENCE
                if path.suffix in SOURCES and not skipped:
                    digest.update(f"{package}/{inner.as_posix()}\0".encode())
                    digest.update(path.read_bytes())
    for file in plugin_files():
        digest.update(f"{Path(file).name}\0".encode() + Path(file).read_bytes())
    return digest.hexdigest()[:16]


def _git(folder: Path, *words: str) -> str | None:
    """The output of a git command; None if it fails."""
    try:
        done = subprocess.run(
            ["git", "-C", str(folder), *words],
            capture_output=True,
            text=True,
            timeout=10,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None
