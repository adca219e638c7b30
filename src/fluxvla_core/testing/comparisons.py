"""Comparisons of two training runs by what they left in their work dirs."""

from __future__ import annotations

import json
import math
from collections.abc import Collection
from pathlib import Path
from typing import Any

from fluxvla_core.checkpoints.checkpoint import ENVIRONMENT, Checkpoint, folders
from fluxvla_core.checkpoints.manifest import NAME as MANIFEST
from fluxvla_core.training.metrics import WALL_CLOCK

__all__ = ["assert_trained_alike", "checkpoint_differences", "differences", "losses"]


def differences(left: Path, right: Path) -> list[str]:
    """Differences of two work dirs: checkpoint files whose bytes differ, and metric lines.

    Compares all checkpoints, and ``metrics.jsonl`` without its wall-clock fields.
    """
    found = []
    names = [[p.name for p in folders(d)] for d in (left, right)]
    if names[0] != names[1]:
        found.append(f"checkpoints: {names[0]} / {names[1]}")
    for a, b in zip(folders(left), folders(right), strict=False):
        found += checkpoint_differences(a, b)
    records = [_records(d / "metrics.jsonl") for d in (left, right)]
    if records[0] != records[1]:
        found.append("metrics.jsonl")
    return found


def checkpoint_differences(left: Path, right: Path) -> list[str]:
    """Names of files that differ between two checkpoints' folders.

    Not compared are ``environment.json``, as packages may change between two runs, and the
    manifest, which follows from the rest.
    """
    skipped = {Path(MANIFEST), Path(ENVIRONMENT)}
    files = {p.relative_to(d) for d in (left, right) for p in d.rglob("*") if p.is_file()}
    return [
        f"{left.name}/{name}"
        for name in sorted(files - skipped)
        if len({(d / name).read_bytes() if (d / name).is_file() else None for d in (left, right)})
        > 1
    ]


def losses(work_dir: Path) -> list[float]:
    """Loss of each training step, as ``metrics.jsonl`` has them."""
    return [row["loss"] for row in _records(work_dir / "metrics.jsonl")]


def assert_trained_alike(
    found: Path,
    expected: Path,
    *,
    steps: int = 20,
    rtol: float = 1e-5,
    atol: float = 1e-5,
    ignored: Collection[str] = (),
) -> None:
    """Two runs have the same loss in every step and end with the same weights.

    Args:
        found: work dir of the run to be checked, for example of two processes.
        expected: work dir of the run that it should equal, with two checkpoints or more: between
            its first and its last a weight must have moved by more than ``10 * atol``, as runs
            that learn nothing are alike in any case.
        steps: how many steps both must have.
        rtol: most that two losses may differ by, relative to the expected one.
        atol: most that two weights may differ by.
        ignored: ends of names of weights that are not compared.

    Raises:
        AssertionError: with the step or the weight that differs most.
    """
    ours, theirs = losses(found), losses(expected)
    assert len(ours) == len(theirs) == steps, f"{len(ours)} / {len(theirs)} steps, not {steps}"
    assert all(map(math.isfinite, theirs)), theirs
    gaps = [abs(a - b) / abs(b) for a, b in zip(ours, theirs, strict=True)]
    step = max(range(steps), key=gaps.__getitem__)
    assert gaps[step] <= rtol, f"loss of step {step + 1}: {ours[step]!r}, expected {theirs[step]!r}"
    first, last = (_weights(folders(expected)[i]) for i in (0, -1))
    weights = _weights(folders(found)[-1])
    assert weights.keys() == last.keys()
    compared = [name for name in last if not name.endswith(tuple(ignored))]
    change = {name: _distance(weights[name], last[name]) for name in compared}
    worst = max(compared, key=change.__getitem__)
    assert change[worst] <= atol, f"{worst} differs by {change[worst]}"
    # A buffer that counts steps grows without training, too.
    learned = [name for name in compared if last[name].is_floating_point()]
    assert max(_distance(last[name], first[name]) for name in learned) > 10 * atol, "no training"


def _weights(checkpoint: Path) -> dict[str, Any]:
    return dict(Checkpoint.open(checkpoint).tensors("model.safetensors"))


def _distance(left: Any, right: Any) -> float:
    return float((left.double() - right.double()).abs().max())


def _records(path: Path) -> list[dict[str, Any]]:
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    return [{k: v for k, v in row.items() if k not in WALL_CLOCK} for row in rows]
