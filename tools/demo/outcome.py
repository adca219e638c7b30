"""Results of the demo, read from its files: the measured speed, the success rates."""

from __future__ import annotations

import json
import statistics
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any


def median_step_s(metrics: Path, skip: int = 3) -> float:
    """The median seconds of an optimizer step after the first ``skip``, from ``metrics.jsonl``.

    Raises:
        ValueError: the file holds no such step.
    """
    rows = [json.loads(line) for line in metrics.read_text(encoding="utf-8").splitlines()]
    times = [float(row["step_time"]) for row in rows[skip:]]
    if not times:
        raise ValueError(f"{metrics} holds {len(rows)} steps, more than {skip} are needed")
    return statistics.median(times)


def verdict(results: Path) -> list[str]:
    """Lines on the success rates, and on whether training and the instruction made a difference."""
    found = json.loads(results.read_text(encoding="utf-8"))
    rates = {name: table["all"] for name, table in found["groups"].items()}
    obeyed = found.get("obeyed", {})
    lines = [_line(name, rate, obeyed) for name, rate in rates.items() if rate["episodes"]]
    trained, untrained = rates.get("policy"), rates.get("untrained")
    if trained and untrained:
        if trained["low"] > untrained["high"]:
            lines.append("the two intervals are apart: training made the difference")
        else:
            lines.append("the intervals overlap: this says nothing about the training")
    return lines


def _line(name: str, rate: Mapping[str, Any], obeyed: Mapping[str, Any]) -> str:
    """One group's rate, in the words of the report."""
    names = {"policy": "trained policy", "untrained": "untrained policy"}
    who, does = names.get(name, name), "episodes succeed"
    if name == "swapped":
        who = "wrong instruction"
        if name in obeyed:
            rate, who, does = obeyed[name], f"{who}: follows the instruction", "episodes"
    return (
        f"{who}: {rate['successes']} of {rate['episodes']} {does} "
        f"({rate['rate']:.0%}, 95 % interval {rate['low']:.0%} to {rate['high']:.0%})"
    )


def size_of(paths: Iterable[Path]) -> str:
    """The bytes of files and folders, for people."""
    total = 0
    for path in paths:
        files = path.rglob("*") if path.is_dir() else [path]
        total += sum(file.stat().st_size for file in files if file.is_file())
    return f"{total / 1e6:.1f} MB"


def clock(seconds: float) -> str:
    """``4:05``, ``1:02:33``."""
    whole = round(seconds)
    if whole < 3600:
        return f"{whole // 60}:{whole % 60:02d}"
    return f"{whole // 3600}:{whole % 3600 // 60:02d}:{whole % 60:02d}"
