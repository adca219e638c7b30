"""How long each stage of a loop took: collected as seconds, reported as percentiles."""

from __future__ import annotations

import numpy as np


class Timings:
    """Stage -> durations. Stages appear in the report in the order they were first seen."""

    def __init__(self) -> None:
        self._seconds: dict[str, list[float]] = {}

    def add(self, stage: str, seconds: float) -> None:
        """Note one duration."""
        self._seconds.setdefault(stage, []).append(seconds)

    def summary(self) -> dict[str, dict[str, float]]:
        """stage -> ``count`` and ``p50_ms``, ``p95_ms``, ``p99_ms``, ``max_ms``."""
        report = {}
        for stage, values in self._seconds.items():
            p50, p95, p99 = np.percentile(values, [50, 95, 99]) * 1e3
            report[stage] = {
                "count": len(values),
                "p50_ms": round(float(p50), 3),
                "p95_ms": round(float(p95), 3),
                "p99_ms": round(float(p99), 3),
                "max_ms": round(max(values) * 1e3, 3),
            }
        return report
