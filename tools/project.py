"""Contents of the repository: its distributions, and the versions that constraints.txt names."""

from __future__ import annotations

import dataclasses
import hashlib
import re
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
CONSTRAINTS = ROOT / "constraints.txt"
# The files of a wheel. Tests, caches and notes are not among them: editing them rebuilds nothing.
WHEEL_INPUTS = ("pyproject.toml", "README.md", "LICENSE", "src")


@dataclasses.dataclass(frozen=True)
class Distribution:
    """One installable project of the repository: its name and the folder of its pyproject.toml."""

    name: str
    path: Path

    @property
    def stem(self) -> str:
        """The name as it starts the name of a wheel file."""
        return re.sub(r"[-_.]+", "_", self.name).lower()

    def sources(self) -> list[Path]:
        """Every file that a wheel of this distribution is made from, in a fixed order."""
        found: list[Path] = []
        for entry in WHEEL_INPUTS:
            path = self.path / entry
            if path.is_dir():
                found += [p for p in path.rglob("*") if p.is_file() and _is_source(p)]
            elif path.is_file():
                found.append(path)
        return sorted(found)

    def fingerprint(self) -> str:
        """sha256 over names and contents of ``sources()``."""
        return digest(self.sources(), relative_to=self.path)


def distributions(root: Path = ROOT) -> list[Distribution]:
    """The core first, then the plugins by name."""
    plugins = sorted(p.parent for p in (root / "plugins").glob("*/pyproject.toml"))
    return [Distribution(_name(path), path) for path in (root, *plugins)]


def digest(paths: Iterable[Path], *, relative_to: Path) -> str:
    """sha256 over the paths, as seen from ``relative_to``, and their contents."""
    total = hashlib.sha256()
    for path in paths:
        content = hashlib.sha256(path.read_bytes()).hexdigest()
        total.update(f"{path.relative_to(relative_to).as_posix()} {content}\n".encode())
    return total.hexdigest()


def combined(fingerprints: Mapping[str, str]) -> str:
    """One short text that changes when any of the named fingerprints does."""
    lines = "".join(f"{name} {value}\n" for name, value in sorted(fingerprints.items()))
    return hashlib.sha256(lines.encode()).hexdigest()[:16]


def constrained_version(package: str, constraints: Path = CONSTRAINTS) -> str:
    """The version that constraints.txt fixes for a package, whatever its marker.

    Raises LookupError when the file has no such line.
    """
    pattern = re.compile(rf"^{re.escape(package)}==([^\s;]+)", re.IGNORECASE | re.MULTILINE)
    found = pattern.search(constraints.read_text(encoding="utf-8"))
    if not found:
        raise LookupError(f"{constraints.name} has no line '{package}==<version>'")
    return found[1]


def _is_source(path: Path) -> bool:
    return "__pycache__" not in path.parts and path.suffix != ".pyc"


def _name(path: Path) -> str:
    # tomllib is in the standard library from 3.11 on only, and nothing is installed yet.
    text = (path / "pyproject.toml").read_text(encoding="utf-8")
    found = re.search(r"^\[project\]$.*?^name\s*=\s*\"([^\"]+)\"", text, re.MULTILINE | re.DOTALL)
    if not found:
        sys.exit(f"{path / 'pyproject.toml'}: no name under [project]")
    return found[1]
