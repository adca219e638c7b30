"""What every evaluation writes alike: results, timing, what is reported."""

from __future__ import annotations

import errno
import json
import os

import pytest

from fluxvla_core.contracts.runner import SilentReporter
from fluxvla_core.errors import CheckpointError, RunFailed
from fluxvla_core.evaluation import results_file
from fluxvla_core.evaluation.policies import chosen_checkpoint
from fluxvla_core.evaluation.results_file import problems, summarise


def record(task, seed, success, group="policy", **more):
    head = {"group": group, "task": task, "seed": seed, "status": "done", "success": success}
    return {**head, "steps": 10, "calls": 2, "timing": {"policy_seconds": 0.004}, **more}


def test_results_appear_whole(tmp_path):
    path = tmp_path / "results.json"
    results_file.write_results(path, {"a": 1})
    assert json.loads(path.read_text()) == {"a": 1}
    assert list(tmp_path.iterdir()) == [path]


def test_what_is_no_number_is_null(tmp_path):
    """Others' JSON readers refuse NaN and Infinity, which are not JSON."""
    path = tmp_path / "results.json"
    results_file.write_results(path, {"a": [float("nan"), 1.5], "b": {"c": (float("-inf"),)}})
    found = json.loads(path.read_text(), parse_constant=pytest.fail)
    assert found == {"a": [None, 1.5], "b": {"c": [None]}}


def test_a_full_disk_is_named_and_can_be_mended(tmp_path, monkeypatch):
    def full(source, target):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(RunFailed, match="No space left on device") as caught:
        results_file.write_results(tmp_path / "results.json", {})
    assert "make room and run the same command again" in str(caught.value)


def test_a_folder_that_is_gone_is_no_full_disk(tmp_path):
    with pytest.raises(RunFailed, match="results cannot be written") as caught:
        results_file.write_results(tmp_path / "gone" / "results.json", {})
    assert "make room" not in str(caught.value)


def test_speed_is_told_of_whole_runs_only():
    records = [record("a", 0, True), record("a", 1, False), {"status": "error"}]
    whole = results_file.timing(records, 3, 2.0, 4)
    assert whole["steps"] == 20
    assert whole["steps_per_s"] == 10.0
    assert whole["policy_ms"] == pytest.approx(2.0)
    rest = results_file.timing(records, 1, 2.0, 4)
    assert rest["policy_ms"] == pytest.approx(2.0)
    assert rest["episodes"] == 0
    assert "steps_per_s" not in rest


def test_times_of_steps_and_images_and_memory_are_those_of_finished_episodes():
    slow = record("a", 0, True)
    slow["timing"] |= {"step_seconds": 0.5, "observe_seconds": 0.25, "memory_mb": 300.0}
    found = results_file.timing([slow, {"status": "error"}], 2, 2.0, 1)
    assert found["step_ms"] == pytest.approx(500.0 / slow["steps"])
    assert found["observe_ms"] == pytest.approx(250.0 / slow["calls"])
    assert found["worker_memory_mb"] == 300.0


def test_ticks_of_live_episodes_are_summed():
    live = {"status": "done", "steps": 30, "ticks": 28, "missed_ticks": 6, "late_ticks": 1}
    live |= {"skipped_ticks": 2, "trips": ["starvation", "later"]}
    found = results_file.ticks([live, {**live, "trips": []}, {"status": "error"}])
    assert found == {
        "ticks": 56,
        "missed_ticks": 12,
        "missed_share": 0.2,
        "skipped_ticks": 4,
        "late_ticks": 2,
        "stopped_by": {"starvation": 1},
    }


def test_errors_alone_are_no_result(tmp_path):
    results_file.check_any_done([record("a", 0, True)], tmp_path)
    with pytest.raises(RunFailed, match=r"none of the 1 episodes gave a result.*\nit blew up"):
        results_file.check_any_done([{"status": "error", "error": "it blew up"}], tmp_path)


def test_people_are_told_rates_speed_and_videos(tmp_path):
    class Listener(SilentReporter):
        lines: list[str]

        def info(self, text):
            self.lines.append(text)

        def artifact(self, kind, path):
            self.lines.append(f"{kind} {path.name}")

    listener = Listener()
    listener.lines = []
    records = [record("a", 0, True), record("b", 0, False)]
    found = {
        "groups": summarise(records),
        "problems": [],
        "timing": results_file.timing(records, 2, 4.0, 2),
        "videos": [{"path": "videos/x.mp4"}],
    }
    results_file.report_results(listener, found, tmp_path)
    assert listener.lines == [
        "policy a: 1/1 = 100% (95% interval 21% to 100%)",
        "policy b: 0/1 = 0% (95% interval 0% to 79%)",
        "policy all 2 tasks: 1/2 = 50% (95% interval 9% to 91%)",
        "20 steps in 4 s: 5 steps/s in 2 processes",
        "video x.mp4",
    ]
    listener.lines = []
    found["groups"] = summarise(records[:1])
    results_file.report_results(listener, found, tmp_path)
    assert listener.lines[1] == "20 steps in 4 s: 5 steps/s in 2 processes", "one task is not all"


def test_what_went_wrong_is_counted_the_most_frequent_first(listener, tmp_path):
    traceback = "Traceback (most recent call last):\n  File x\nKeyError: 'qpos'\n"
    lost = RunFailed("the state is gone", cause="it diverged", next="look")
    records = [
        record("a", 0, True, problem=None),
        record("a", 1, False, problem="not finite"),
        record("b", 1, False, problem="not finite"),
        *[record("a", n, None, status="error", error=traceback) for n in (2, 3, 4)],
        record("b", 5, None, status="error", error=str(lost), group="swapped"),
    ]
    found = problems(records)
    assert found == [
        {"group": "policy", "status": "error", "what": "KeyError: 'qpos'", "episodes": 3},
        {"group": "policy", "status": "done", "what": "not finite", "episodes": 2},
        {"group": "swapped", "status": "error", "what": "the state is gone", "episodes": 1},
    ]
    others = [{**found[1], "what": f"reason {n}"} for n in range(4)]
    told = {"groups": {}, "problems": found + others, "timing": {"episodes": 0}, "videos": []}
    results_file.report_results(listener, told, tmp_path)
    assert listener.warnings == [
        "policy: 3 episodes gave no result: KeyError: 'qpos'",
        "policy: 2 episodes failed: not finite",
        "swapped: 1 episode gave no result: the state is gone",
        "policy: 2 episodes failed: reason 0",
        "policy: 2 episodes failed: reason 1",
        "and 2 more problems: see results.json",
    ]


def test_an_evaluation_with_errors_is_not_whole(tmp_path):
    results_file.check_all_done([record("a", 0, False)], tmp_path)
    with pytest.raises(RunFailed, match=r"1 of 2 episodes gave no result.*last one: it blew up"):
        results_file.check_all_done(
            [record("a", 0, True), {"status": "error", "error": "it blew up"}], tmp_path
        )


def test_no_checkpoint_is_said_with_what_to_do(tmp_path):
    with pytest.raises(CheckpointError, match="no undamaged checkpoint") as caught:
        chosen_checkpoint(None, tmp_path)
    assert "train first" in str(caught.value)
