"""``fluxvla bench-policy`` on a checkpoint that a test has made, for any family of models."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from fluxvla_core.cli.main import main

DIVIDED = {"preprocess", "transfer", "prefix", "denoise", "inference", "postprocess", "total"}
"""Stages of a model with ``observe()`` and ``denoise()``."""
WHOLE = DIVIDED - {"prefix", "denoise"} | {"forward"}


def stages_of(checkpoint: Path, out: Path) -> set[str]:
    """The stages that were measured, of an answer whose operations were counted."""
    return stages_measured(["--checkpoint", str(checkpoint)], out)


def stages_measured(words: Sequence[str], out: Path) -> set[str]:
    """As :func:`stages_of`, of what ``words`` name."""
    words = ["bench-policy", *words, "--out", str(out)]
    assert main([*words, "--calls", "1", "--warmup", "0", "--modes", "eager"]) == 0
    figures = json.loads((out / "figures.json").read_text())
    assert figures["gflops"] > 0
    found = figures["modes"]["eager"]
    assert found["share_of_peak"] > 0
    stages = {name for name, row in found.items() if isinstance(row, dict) and "p50_ms" in row}
    assert set(figures["floor_ms"]) == stages & {"prefix", "denoise", "forward"}
    return stages
