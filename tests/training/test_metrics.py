"""VLAMetric: records, averages, and its state."""

from __future__ import annotations

import json

import pytest

from fluxvla_core.build import RunContext, build_metric_from_cfg
from fluxvla_core.errors import ConfigError
from fluxvla_core.training.metrics import WALL_CLOCK, VLAMetric


def commit(metric, step, loss, **more):
    metric.commit(global_step=step, epoch=step / 10, loss=loss, lr=1e-3, **more)


def rows(path):
    return [json.loads(line) for line in (path / "metrics.jsonl").read_text().splitlines()]


def test_one_record_a_step(tmp_path):
    """O1 of upstream's bugs: numbers as numbers, and nothing that is a constant."""
    metric = VLAMetric(run_dir=str(tmp_path))
    metric.start(0, {})
    measured = {"step_time": 0.1, "samples_per_s": 80.0, "data_wait": 0.0}
    commit(metric, 1, 0.5, grad_norm=2.0, **measured, mfu=0.4, memory_gb=1.5)
    commit(metric, 2, 0.25, grad_norm=None)
    assert metric.push() == "step 2 · epoch 0.20 · loss 0.25000 · lr 0.001"
    metric.finalize()
    first, second = rows(tmp_path)
    assert {k: v for k, v in first.items() if k not in WALL_CLOCK} == {
        "step": 1,
        "epoch": 0.1,
        "loss": 0.5,
        "lr": 1e-3,
        "grad_norm": 2.0,
    }
    assert set(WALL_CLOCK) <= set(first)
    assert "grad_norm" not in second


def test_finalize_writes_what_was_not_pushed(tmp_path):
    metric = VLAMetric(run_dir=str(tmp_path))
    metric.start(0, {})
    commit(metric, 1, 0.5)
    metric.finalize()
    assert [row["step"] for row in rows(tmp_path)] == [1]


def test_the_window_goes_on_after_resuming(tmp_path):
    whole = VLAMetric(run_dir=str(tmp_path / "a"), window_size=3)
    whole.start(0, {})
    for step, loss in enumerate([1.0, 2.0, 6.0, 4.0], 1):
        commit(whole, step, loss)
    whole.finalize()
    first = VLAMetric(run_dir=str(tmp_path / "b"), window_size=3)
    first.start(0, {})
    for step, loss in enumerate([1.0, 2.0], 1):
        commit(first, step, loss)
    first.finalize()
    second = VLAMetric(run_dir=str(tmp_path / "b"), window_size=3)
    second.load_state_dict(json.loads(json.dumps(first.state_dict())))
    second.start(2, {})
    for step, loss in enumerate([6.0, 4.0], 3):
        commit(second, step, loss)
    second.finalize()
    assert [r["loss"] for r in rows(tmp_path / "a")] == [1.0, 1.5, 3.0, 4.0]
    assert [r["loss_raw"] for r in rows(tmp_path / "a")] == [1.0, 2.0, 6.0, 4.0]
    assert [r["loss"] for r in rows(tmp_path / "b")] == [1.0, 1.5, 3.0, 4.0]


def test_a_config_table_builds_it_for_the_work_dir(tmp_path):
    context = RunContext(work_dir=tmp_path / "night")
    metric = build_metric_from_cfg(
        {"type": "VLAMetric", "active_trackers": ["jsonl"], "grad_accumulation_steps": 2}, context
    )
    assert metric.run_dir == tmp_path / "night"
    assert metric.run_id == "night"


def test_bad_settings_are_refused_with_their_place():
    context = RunContext(
        section="runner", origins={"runner.metric.window_size": "c.py:9"}, config={}
    )
    with pytest.raises(ConfigError) as caught:
        VLAMetric(window_size=0, context=context)
    assert str(caught.value) == (
        "c.py:9: runner.metric.window_size: window_size must be at least 1, got 0"
    )
    with pytest.raises(ConfigError, match="no tracker 'tensorbord'"):
        VLAMetric(active_trackers=("tensorbord",))
