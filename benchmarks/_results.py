"""Results files of benchmarks: their common head, and writing them.

args = options(__file__).parse_args()
begun = head("torch", "av")
...
keep(args.out, {**begun, **figures})
"""

from __future__ import annotations

import argparse
import json
import os
import platform
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).with_name("results")


def options(script: str) -> argparse.ArgumentParser:
    """A parser with ``--out``, by default ``results/<name of the script>.json``."""
    parser = argparse.ArgumentParser(prog=f"benchmarks.{Path(script).stem}", allow_abbrev=False)
    parser.add_argument("--out", type=Path, default=FOLDER / f"{Path(script).stem}.json")
    return parser


def head(*distributions: str) -> dict[str, Any]:
    """Python, machine, how busy it is already, and versions: call it before anything runs."""
    try:
        load: float | None = round(os.getloadavg()[0], 1)
    except OSError:
        load = None
    return {
        "python": platform.python_version(),
        "machine": f"{platform.machine()}, {os.cpu_count()} CPUs",
        "load_before": load,
        "versions": {name: version_of(name) for name in ("fluxvla-core", *distributions)},
    }


def version_of(distribution: str) -> str | None:
    """None where it is not installed."""
    try:
        return version(distribution)
    except PackageNotFoundError:
        return None


def keep(out: Path, summary: Mapping[str, Any], *, show: bool = True) -> None:
    """Write the results as JSON; print them, unless the benchmark reports them itself."""
    text = json.dumps(summary, indent=1)
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(text + "\n", encoding="utf-8")
    print(text if show else f"written to {out}")
