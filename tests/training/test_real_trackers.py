"""The trackers with the packages themselves, as far as they are installed; nothing is sent."""

from __future__ import annotations

import importlib
import importlib.metadata
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from fluxvla_core.contracts.runner import SilentReporter
from fluxvla_core.training import trackers
from fluxvla_core.training.trackers import open_tracker


class Said(SilentReporter):
    def __init__(self):
        self.lines: list[str] = []

    def warn(self, text):
        self.lines.append(text)


def test_tensorboard(tmp_path):
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    said = Said()
    first = open_tracker("tensorboard", said, tmp_path, "run", 0, {})
    for step in (1, 2, 3):
        first.log([(step, {"loss": 1.0 / step, "lr": 0.5})])
    first.sync()
    first.close()
    again = open_tracker("tensorboard", said, tmp_path, "run", 2, {})
    again.log([(3, {"loss": 7.0})])
    again.close()
    found = EventAccumulator(str(tmp_path / "tensorboard"))
    found.Reload()
    assert [(e.step, round(e.value, 3)) for e in found.Scalars("train/loss")] == [
        (1, 1.0),
        (2, 0.5),
        (3, 7.0),
    ]
    assert said.lines == []


def test_tensorboard_of_a_run_that_begins_anew(tmp_path):
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    for loss, steps in ((1.0, (1, 2)), (5.0, (1,))):
        tracker = open_tracker("tensorboard", Said(), tmp_path, "run", 0, {})
        for step in steps:
            tracker.log([(step, {"loss": loss})])
        tracker.close()
    found = EventAccumulator(str(tmp_path / "tensorboard"))
    found.Reload()
    assert [(e.step, e.value) for e in found.Scalars("train/loss")] == [(1, 5.0)]


PROGRAM = """
import sys
from pathlib import Path
from fluxvla_core.contracts.runner import SilentReporter
from fluxvla_core.training.trackers import open_tracker

class Loud(SilentReporter):
    def warn(self, text):
        sys.exit(text)

for first in (0, 2):
    tracker = open_tracker(sys.argv[1], Loud(), Path("."), "night", first, {"model": {"type": "X"}})
    for step in (first + 1, first + 2, first + 3):
        tracker.log([(step, {"loss": 1.0 / step})])
    tracker.sync()
    tracker.close()
"""


def track(name: str, folder: Path, **environment: str) -> str:
    """What a program prints that tracks five steps in two runs, the third in both."""
    ended = subprocess.run(
        [sys.executable, "-c", PROGRAM, name],
        cwd=folder,
        env={**os.environ, "HOME": str(folder), **environment},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert ended.returncode == 0, ended.stderr
    return ended.stdout


def test_trackio(tmp_path):
    pytest.importorskip("trackio")
    place = str(tmp_path / "trackio")
    assert track("trackio", tmp_path, TRACKIO_DIR=place, TRACKIO_PROJECT="cubes") == ""
    import sqlite3

    with sqlite3.connect(tmp_path / "trackio" / "cubes.db") as found:
        rows = found.execute("select run_name, step, metrics from metrics order by step").fetchall()
    name = f"night-{(tmp_path / 'trackio_run_id').read_text().strip()}"
    assert [(run, step, json.loads(values)["train/loss"]) for run, step, values in rows] == [
        (name, 1, 1.0),
        (name, 2, 0.5),
        (name, 3, 1 / 3),
        (name, 4, 0.25),
        (name, 5, 0.2),
    ]


@pytest.mark.slow
def test_wandb_offline(tmp_path):
    pytest.importorskip("wandb")
    assert track("wandb", tmp_path, WANDB_MODE="offline", WANDB_SILENT="true") == ""
    kept = (tmp_path / "wandb_run_id").read_text().strip()
    runs = sorted((tmp_path / "wandb").glob(f"offline-run-*-{kept}/run-{kept}.wandb"))
    assert len(runs) == 2
    assert all(path.stat().st_size > 0 for path in runs)


@pytest.mark.parametrize("name", ["tensorboard", "trackio", "wandb"])
def test_each_is_an_extra_of_its_own(name):
    extras = importlib.metadata.metadata("fluxvla-core").get_all("Provides-Extra")
    assert extras is not None
    assert name in extras
    assert trackers._KINDS[name][1] == name
