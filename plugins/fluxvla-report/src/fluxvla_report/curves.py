"""The numbers of a training, each as a chart over its steps."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

from fluxvla_report.facts import Training
from fluxvla_report.svg import Series, line_chart

CURVES = (
    ("loss", "Loss", True),
    ("val_loss", "Validation loss", True),
    ("lr", "Learning rate", False),
    ("grad_norm", "Gradient norm", True),
    ("samples_per_s", "Samples per second", False),
    ("data_wait", "Share of time spent waiting for data", False),
    ("mfu", "Model FLOPs utilisation", False),
    ("memory_gb", "Memory (GB)", False),
)
OF_DATASET = "loss/"
# Fewer values are said in words: a chart of them would be empty.
LEAST_POINTS = 3
SMOOTHED = ("loss", "grad_norm", "samples_per_s", "data_wait", "mfu")


def curves(training: Training) -> list[dict[str, Any]]:
    """A chart for each column that was logged, noisy ones with their running mean.

    What was measured at some steps only is a line from one of these to the next.
    """
    charts = []
    for name, label, log in _wanted(training):
        values = training.columns[name]
        points = [p for p in zip(training.steps, values, strict=True) if math.isfinite(p[1])]
        if not points:
            continue
        if len(points) < LEAST_POINTS:
            said = ", ".join(f"{value:.4g} at step {step:g}" for step, value in points)
            charts.append({"name": label, "svg": "", "text": said, "smoothed": False})
            continue
        steps = [step for step, _ in points]
        if (name in SMOOTHED or name.startswith(OF_DATASET)) and len(values) > 20:
            lines = [
                Series("each step", training.steps, values, kind="faint"),
                Series("running mean", training.steps, running_mean(values)),
            ]
        elif 2 * len(points) < len(values):
            lines = [Series(label, steps, [value for _, value in points])]
        else:
            lines = [Series(label, training.steps, values)]
        chart = line_chart(lines, x_label="step", title=f"{label} over the steps", log=log)
        charts.append({"name": label, "svg": chart, "text": "", "smoothed": len(lines) > 1})
    return charts


def _wanted(training: Training) -> Iterator[tuple[str, str, bool]]:
    """Columns with their labels, and whether their axis is by decades."""
    for name, label, log in CURVES:
        if name in training.columns:
            yield name, label, log
        if name == "loss":
            for other in training.columns:
                if other.startswith(OF_DATASET):
                    yield other, f"Loss on {other.removeprefix(OF_DATASET)}", True


def running_mean(values: Sequence[float], share: float = 0.03) -> list[float]:
    """Exponential running mean over about ``share`` of all values; skips what is not finite."""
    weight = 2.0 / (1.0 + max(1.0, share * len(values)))
    means: list[float] = []
    mean = math.nan
    for value in values:
        if math.isfinite(value):
            mean = value if math.isnan(mean) else mean + weight * (value - mean)
        means.append(mean)
    return means
