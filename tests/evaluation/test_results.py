"""What every evaluation writes alike: results, timing, which episodes are shown, what is said."""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path

import pytest

from fluxvla_core.contracts.reporter import SilentReporter
from fluxvla_core.errors import CheckpointError, RunFailed
from fluxvla_core.evaluation import results
from fluxvla_core.evaluation.policies import chosen_checkpoint
from fluxvla_core.evaluation.pool import WorkerPool
from fluxvla_core.evaluation.results import (
    choose_episodes,
    record_videos,
    recorded_videos,
    video_name,
    with_others,
)
from fluxvla_core.evaluation.statistics import problems, summarise


def record(task, seed, success, group="policy", **more):
    head = {"group": group, "task": task, "seed": seed, "status": "done", "success": success}
    return {**head, "steps": 10, "calls": 2, "timing": {"policy_seconds": 0.004}, **more}


def test_failures_come_first_and_tasks_in_turn():
    records = [record(t, s, s > 2) for s in range(6) for t in ("a", "b")]
    chosen = [(r["task"], r["seed"]) for r in choose_episodes(records, 4)]
    assert chosen == [("a", 0), ("b", 0), ("a", 3), ("b", 3)]
    assert len(choose_episodes(records, 100)) == 12
    assert choose_episodes(records, 0) == []


def test_what_there_is_fills_up_what_there_is_not():
    only = [record("a", s, True) for s in range(5)]
    assert [r["seed"] for r in choose_episodes(only, 3)] == [0, 1, 2]
    one = [record("a", 0, False), *only[1:]]
    assert [r["seed"] for r in choose_episodes(one, 4)] == [0, 1, 2, 3]


def test_other_groups_and_errors_are_not_shown():
    records = [record("a", 0, False, group="untrained"), record("a", 1, False, status="error")]
    assert choose_episodes(records, 3) == []
    assert len(choose_episodes(records, 3, group="untrained")) == 1


def test_a_videos_name_says_what_it_shows():
    assert video_name(3, record("lift", 7, False)) == "03-failure-lift-seed-7.mp4"
    assert video_name(0, record("lift", 7, True)) == "00-success-lift-seed-7.mp4"


def test_results_appear_whole(tmp_path):
    path = tmp_path / "results.json"
    results.write_results(path, {"a": 1})
    assert json.loads(path.read_text()) == {"a": 1}
    assert list(tmp_path.iterdir()) == [path]


def test_what_is_no_number_is_null(tmp_path):
    """Others' JSON readers refuse NaN and Infinity, which are none of its words."""
    path = tmp_path / "results.json"
    results.write_results(path, {"a": [float("nan"), 1.5], "b": {"c": (float("-inf"),)}})
    found = json.loads(path.read_text(), parse_constant=pytest.fail)
    assert found == {"a": [None, 1.5], "b": {"c": [None]}}


def test_a_full_disk_is_named_and_can_be_mended(tmp_path, monkeypatch):
    def full(source, target):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(RunFailed, match="No space left on device") as caught:
        results.write_results(tmp_path / "results.json", {})
    assert "make room and run the same command again" in str(caught.value)


def test_a_folder_that_is_gone_is_no_full_disk(tmp_path):
    with pytest.raises(RunFailed, match="results cannot be written") as caught:
        results.write_results(tmp_path / "gone" / "results.json", {})
    assert "make room" not in str(caught.value)


def test_speed_is_told_of_whole_runs_only():
    records = [record("a", 0, True), record("a", 1, False), {"status": "error"}]
    whole = results.timing(records, 3, 2.0, 4)
    assert whole["steps"] == 20
    assert whole["steps_per_s"] == 10.0
    assert whole["policy_ms"] == pytest.approx(2.0)
    rest = results.timing(records, 1, 2.0, 4)
    assert rest["policy_ms"] == pytest.approx(2.0)
    assert rest["episodes"] == 0
    assert "steps_per_s" not in rest


def test_times_of_steps_and_pictures_and_memory_are_those_of_finished_episodes():
    slow = record("a", 0, True)
    slow["timing"] |= {"step_seconds": 0.5, "observe_seconds": 0.25, "memory_mb": 300.0}
    found = results.timing([slow, {"status": "error"}], 2, 2.0, 1)
    assert found["step_ms"] == pytest.approx(500.0 / slow["steps"])
    assert found["observe_ms"] == pytest.approx(250.0 / slow["calls"])
    assert found["worker_memory_mb"] == 300.0


def test_ticks_of_live_episodes_are_summed():
    live = {"status": "done", "steps": 30, "ticks": 28, "missed_ticks": 6, "late_ticks": 1}
    live |= {"skipped_beats": 2, "trips": ["starvation", "later"]}
    found = results.ticks([live, {**live, "trips": []}, {"status": "error"}])
    assert found == {
        "ticks": 56,
        "missed_ticks": 12,
        "missed_share": 0.2,
        "skipped_beats": 4,
        "late_ticks": 2,
        "stopped_by": {"starvation": 1},
    }


def test_errors_alone_are_no_result(tmp_path):
    results.check_any_done([record("a", 0, True)], tmp_path)
    with pytest.raises(RunFailed, match=r"none of the 1 episodes gave a result.*\nit blew up"):
        results.check_any_done([{"status": "error", "error": "it blew up"}], tmp_path)


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
        "timing": results.timing(records, 2, 4.0, 2),
        "videos": [{"path": "videos/x.mp4"}],
    }
    results.report_results(listener, found, tmp_path)
    assert listener.lines == [
        "policy a: 1/1 = 100% (95% interval 21% to 100%)",
        "policy b: 0/1 = 0% (95% interval 0% to 79%)",
        "policy all 2 tasks: 1/2 = 50% (95% interval 9% to 91%)",
        "20 steps in 4 s: 5 steps/s in 2 processes",
        "video x.mp4",
    ]


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
    results.report_results(listener, told, tmp_path)
    assert listener.warnings == [
        "policy: 3 episodes gave no result: KeyError: 'qpos'",
        "policy: 2 episodes failed: not finite",
        "swapped: 1 episode gave no result: the state is gone",
        "policy: 2 episodes failed: reason 0",
        "policy: 2 episodes failed: reason 1",
        "and 2 more problems: see results.json",
    ]


def test_an_evaluation_with_errors_is_not_whole(tmp_path):
    results.check_all_done([record("a", 0, False)], tmp_path)
    with pytest.raises(RunFailed, match=r"1 of 2 episodes gave no result.*last one: it blew up"):
        results.check_all_done(
            [record("a", 0, True), {"status": "error", "error": "it blew up"}], tmp_path
        )


def test_no_checkpoint_is_said_with_what_to_do(tmp_path):
    with pytest.raises(CheckpointError, match="no whole checkpoint") as caught:
        chosen_checkpoint(None, tmp_path)
    assert "train first" in str(caught.value)


class Filmed:
    """A worker that runs jobs (key, path): leaves a file, unless the seed says otherwise."""

    def __call__(self):
        return self.work

    def work(self, job):
        key, path = job
        if key.seed == 13:
            raise RuntimeError("the camera fell over")
        Path(path).write_bytes(b"mp4")
        return {"state_hash": "other" if key.seed == 7 else "same"}


def test_videos_are_of_the_episodes_that_were_counted(tmp_path):
    folder, said = tmp_path / "videos", []
    folder.mkdir()
    (folder / "00-old.mp4").touch()

    class Listener(SilentReporter):
        def warn(self, text):
            said.append(text.strip().splitlines()[-1])

    records = [
        {"group": "policy", "task": "t", "seed": s, "success": s > 9, "state_hash": "same"}
        for s in (3, 7, 13)
    ]
    with WorkerPool(Filmed(), 1) as pool:
        made = record_videos(pool, records, folder, lambda key, path: (key, path), Listener())
    assert made == [
        {
            "group": "policy",
            "task": "t",
            "seed": seed,
            "success": False,
            "path": f"videos/0{number}-failure-t-seed-{seed}.mp4",
        }
        for number, seed in enumerate((3, 7))
    ]
    assert sorted(p.name for p in folder.iterdir()) == [Path(v["path"]).name for v in made]
    assert said == [
        "01-failure-t-seed-7.mp4: the episode went another way than when it was counted; "
        "its outcome does not follow from its seed alone",
        "RuntimeError: the camera fell over",
    ]


def test_every_group_is_seen_beside_the_trained_policy():
    def record(group, task, seed, success):
        return {"group": group, "task": task, "seed": seed, "success": success, "status": "done"}

    records = [
        record("policy", "lift", 1, False), record("policy", "lift", 2, True),
        record("swapped", "lift", 7, False), record("swapped", "lift", 2, False),
        record("untrained", "lift", 1, False), record("untrained", "pour", 1, False),
    ]  # fmt: skip
    shown = with_others(records[:2], records)

    assert shown[:2] == records[:2]
    # Of the same seed where there is one.
    assert [(r["group"], r["seed"]) for r in shown[2:]] == [("swapped", 2), ("untrained", 1)]
    assert with_others([], records) == []


def test_videos_that_were_recorded_with_the_episodes_are_listed_relative_to_the_results(tmp_path):
    record = {"group": "policy", "task": "t", "seed": 3, "success": True, "instruction": "go"}
    for name in ("a.mp4", "b.mp4"):
        (tmp_path / "inference" / "001-t").mkdir(parents=True, exist_ok=True)
        (tmp_path / "inference" / "001-t" / name).touch()
    recordings = [(record, tmp_path / "inference" / "001-t"), (record, tmp_path / "none")]
    assert recorded_videos(recordings, tmp_path / "eval_robot") == [
        {**record, "path": "../inference/001-t/a.mp4"}
    ]
