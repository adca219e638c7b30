"""Trackers: what they write, what they refuse, and that their failing ends nothing."""

from __future__ import annotations

import importlib.util
import json
import sys
import types
from pathlib import Path

import pytest

from fluxvla_core.contracts.runner import SilentReporter
from fluxvla_core.errors import ConfigError
from fluxvla_core.training.metrics import check_trackers, open_tracker


class Said(SilentReporter):
    def __init__(self):
        self.lines: list[str] = []

    def warn(self, text):
        self.lines.append(text)


def jsonl(path: Path, step: int = 0, reporter=None):
    return open_tracker("jsonl", reporter or Said(), path, "run", step, {})


def lines(path: Path):
    return [json.loads(line) for line in (path / "metrics.jsonl").read_text().splitlines()]


def test_a_loss_that_is_no_number_is_null(tmp_path):
    jsonl(tmp_path).log([(1, {"loss": float("nan")})])
    text = (tmp_path / "metrics.jsonl").read_text()
    assert json.loads(text, parse_constant=pytest.fail) == {"step": 1, "loss": None}


def test_jsonl_writes_one_object_a_line(tmp_path):
    tracker = jsonl(tmp_path / "run")
    tracker.log([(1, {"loss": 0.1})])
    tracker.log([(2, {"loss": 0.30000000000000004})])
    tracker.sync()
    tracker.close()
    assert lines(tmp_path / "run") == [
        {"step": 1, "loss": 0.1},
        {"step": 2, "loss": 0.30000000000000004},
    ]


def test_resuming_drops_later_lines_and_half_a_line(tmp_path):
    tracker = jsonl(tmp_path)
    for step in (1, 2, 3):
        tracker.log([(step, {"loss": 1.0 / step})])
    tracker.close()
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('{"step": 4, "lo')
    tracker = jsonl(tmp_path, step=2)
    tracker.log([(3, {"loss": 7.0})])
    tracker.close()
    assert [(row["step"], row["loss"]) for row in lines(tmp_path)] == [(1, 1.0), (2, 0.5), (3, 7.0)]


def test_a_line_that_is_no_record_is_dropped(tmp_path):
    (tmp_path / "metrics.jsonl").write_text('garbage\n{"step": 1, "loss": 2.0}\n')
    jsonl(tmp_path, step=5).close()
    assert lines(tmp_path) == [{"step": 1, "loss": 2.0}]


def test_a_fresh_run_begins_an_empty_file(tmp_path):
    (tmp_path / "metrics.jsonl").write_text('{"step": 1, "loss": 2.0}\n')
    jsonl(tmp_path, step=0).close()
    assert lines(tmp_path) == []


def test_an_unknown_tracker_is_refused_with_a_suggestion():
    with pytest.raises(ConfigError, match=r"there is no tracker 'jsonll'; did you mean 'jsonl'\?"):
        check_trackers(("jsonll",))
    with pytest.raises(ConfigError, match="there are jsonl, tensorboard, trackio, wandb"):
        check_trackers(("xyz",))


def test_a_tracker_without_its_package_is_refused_before_training(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ConfigError) as caught:
        check_trackers(("wandb",), "c.py:3: runner.metric.active_trackers")
    assert str(caught.value) == (
        "c.py:3: runner.metric.active_trackers: tracker 'wandb' needs the package wandb, which is "
        "not installed\n  next: pip install 'fluxvla-core[wandb]'"
    )


def test_a_failing_tracker_is_warned_of_once(tmp_path):
    """O2 of upstream's bugs: what watches a run never ends it."""
    said = Said()
    tracker = jsonl(tmp_path, reporter=said)
    tracker._tracker._file.close()
    for step in (1, 2, 3):
        tracker.log([(step, {"loss": 0.0})])
    tracker.sync()
    tracker.close()
    assert said.lines == [
        "tracker jsonl failed and is left out for the rest of the run: "
        "ValueError: I/O operation on closed file."
    ]


def test_a_tracker_that_cannot_even_start_is_warned_of(tmp_path):
    said = Said()
    (tmp_path / "file").write_text("")
    tracker = jsonl(tmp_path / "file", reporter=said)
    tracker.log([(1, {"loss": 0.0})])
    assert len(said.lines) == 1
    assert said.lines[0].startswith("tracker jsonl failed and is left out")


def fake_wandb(monkeypatch):
    calls: list[object] = []
    run = types.SimpleNamespace(
        log=lambda values, step: calls.append((step, values)),
        finish=lambda: calls.append("finish"),
    )
    wandb = types.ModuleType("wandb")
    wandb.init = lambda **settings: calls.append(settings) or run
    monkeypatch.setitem(sys.modules, "wandb", wandb)
    return calls


def test_wandb_gets_settings_and_steps(tmp_path, monkeypatch):
    calls = fake_wandb(monkeypatch)
    monkeypatch.setenv("WANDB_PROJECT", "cubes")
    tracker = open_tracker("wandb", Said(), tmp_path, "night", 4, {"lr": 1})
    tracker.log([(5, {"loss": 0.5})])
    tracker.sync()
    tracker.close()
    assert calls == [
        {
            "project": "cubes",
            "name": "night",
            "id": (tmp_path / "wandb_run_id").read_text().strip(),
            "resume": "allow",
            "dir": str(tmp_path),
            "config": {"lr": 1},
        },
        (5, {"train/loss": 0.5}),
        "finish",
    ]


def test_a_run_is_another_ones_only_if_it_goes_on(tmp_path, monkeypatch):
    """Work dirs of one name, or one that was begun again, were one run for wandb."""
    calls = fake_wandb(monkeypatch)
    starts = [("a", 0), ("a", 4), ("b", 0), ("a", 0), ("a", 2), ("moved", 2)]
    for folder, step in starts:
        open_tracker("wandb", Said(), tmp_path / folder / "night", "night", step, {}).close()
    ids = [call["id"] for call in calls if call != "finish"]
    assert ids[0] == ids[1]
    assert ids[3] == ids[4]
    assert len({ids[i] for i in (0, 2, 3, 5)}) == 4
    assert {call["name"] for call in calls if call != "finish"} == {"night"}


def test_tensorboard_purges_the_steps_that_are_done_again(tmp_path, monkeypatch):
    calls: list[object] = []

    class SummaryWriter:
        def __init__(self, place, purge_step=None):
            calls.append((place, purge_step))

        def add_scalar(self, name, value, step):
            calls.append((name, value, step))

        def flush(self):
            calls.append("flush")

        def close(self):
            calls.append("close")

    module = types.ModuleType("torch.utils.tensorboard")
    module.SummaryWriter = SummaryWriter
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", module)
    tracker = open_tracker("tensorboard", Said(), tmp_path, "run", 7, {})
    tracker.log([(8, {"loss": 0.5})])
    tracker.sync()
    tracker.close()
    # One that was killed before its first checkpoint begins anew.
    open_tracker("tensorboard", Said(), tmp_path, "run", 0, {})
    assert calls.pop() == (str(tmp_path / "tensorboard"), 1)
    assert calls == [
        (str(tmp_path / "tensorboard"), 8),
        ("train/loss", 0.5, 8),
        "flush",
        "close",
    ]
