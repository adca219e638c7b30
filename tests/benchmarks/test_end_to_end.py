"""What the end-to-end benchmark asks of both sides, and what it makes of what they say."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks import end_to_end
from benchmarks.end_to_end import ALL, LEROBOT, OURS, Course, Step

LOG = (
    "INFO 2026-01-01 10:00:00 ot_train.py:339 num_total_params=51613582 (52M)\n"
    "Training:   0%|          | 0/3 [00:00<?, ?step/s]INFO 2026-01-01 10:00:02 ot_train.py:435 "
    "step:1 smpl:8 ep:0 epch:0.01 loss:81.939 grdn:1151.984 lr:1.0e-05 updt_s:1.500 data_s:0.500\n"
    "\rTraining:  33%|###       | 1/3 [00:02<00:04,  2.00s/step]INFO 2026-01-01 10:00:04 "
    "ot_train.py:435 step:2 smpl:16 ep:0 epch:0.02 loss:9.0 grdn:5.1 lr:1.0e-05 updt_s:1.750 "
    "data_s:0.250\n"
    "step:1K smpl:8K ep:9 epch:2.00 loss:9.000 grdn:5.100 lr:1.0e-05 updt_s:1.000 data_s:0.000\n"
)


def test_steps_of_lerobots_log() -> None:
    assert end_to_end.lerobot_steps(LOG) == [Step(2.0, 0.5), Step(2.0, 0.25), Step(1.0, 0.0)]


def test_steps_of_our_metrics() -> None:
    records = [{"loss": 1.0, "step_time": 2.0, "data_wait": 0.25}, {"val_loss": 1.0}]
    text = "".join(json.dumps(record) + "\n" for record in records)
    assert end_to_end.our_steps(text) == [Step(2.0, 0.5)]


def test_rate_leaves_the_warm_up_out() -> None:
    course = Course(steps=2, warm_up=1, batch=4)
    steps = [Step(100.0, 90.0), Step(1.0, 0.25), Step(3.0, 0.75)]
    assert end_to_end.rate(steps, course) == {"samples_per_s": 2.0, "data_wait": 0.25}
    with pytest.raises(ValueError, match="2 steps are on record, and there should be 3"):
        end_to_end.rate(steps[:2], course)


def test_ratios_are_of_rounds_beside_each_other() -> None:
    def side(*rates: float) -> list[dict[str, float]]:
        return [{"samples_per_s": rate, "data_wait": 0.1} for rate in rates]

    # The machine is half as fast in the second round; medians of the rates alone would not tell.
    runs = {LEROBOT: side(2.0, 1.0, 2.0), OURS: side(4.0, 2.0, 3.0), ALL: side(2.0, 1.0, 2.2)}
    found = end_to_end.summarise(runs)
    assert found["times_lerobot"] == {OURS: 2.0, ALL: 1.0}
    assert found["goal_met"] == {OURS: True, ALL: False}
    assert found["median_samples_per_s"] == {LEROBOT: 2.0, OURS: 3.0, ALL: 2.0}
    assert "times_lerobot" not in end_to_end.summarise({OURS: side(1.0)})


def test_both_sides_are_asked_for_the_same(tmp_path: Path) -> None:
    course = Course(batch=3, workers=2, chunk=7, steps=5, warm_up=1)
    words = end_to_end.lerobot_words(tmp_path, course, tmp_path / "out")
    tree = end_to_end.our_config(tmp_path, course, skip=True)
    loader, runner = tree["train_dataloader"], tree["runner"]
    assert f"--dataset.root={tmp_path}" in words
    assert loader["dataset"]["data_root_path"] == str(tmp_path)
    assert {"--batch_size=3", "--num_workers=2", "--steps=6", "--policy.chunk_size=7"} <= set(words)
    assert (loader["per_device_batch_size"], loader["per_device_num_workers"]) == (3, 2)
    assert (runner["max_steps"], loader["dataset"]["action_window_size"]) == (6, 7)
    assert tree["model"] == {"type": "BenchACT", "chunk": 7, "skip_padding": True}
