"""Episodes: order, resuming after anything, errors that are not failures, summaries."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from fluxvla_core.contracts.runner import SilentReporter
from fluxvla_core.errors import RunFailed, UsageError
from fluxvla_core.evaluation.episodes import EpisodeKey, EvalLog, open_eval_log
from fluxvla_core.evaluation.pool import WorkerPool
from fluxvla_core.evaluation.results_file import describe_rate, summarise
from fluxvla_core.evaluation.worker import run_in_pool
from tests.evaluation.workers import Episodes


class Listener(SilentReporter):
    def __init__(self):
        self.lines, self.steps, self.events = [], [], []

    def info(self, text):
        self.lines.append(text)

    def warn(self, text):
        self.lines.append(f"warning: {text}")

    def progress(self, name, done, total, **fields):
        self.steps.append((name, done, total, fields["successes"]))

    def event(self, kind, **fields):
        self.events.append((kind, fields))


def keys_of(count, task="task", group="policy"):
    return [EpisodeKey(group, task, seed) for seed in range(count)]


def run(folder, keys, workers=2, reporter=None, what=None):
    reporter = reporter or Listener()
    log = open_eval_log(folder / "episodes.jsonl", what or {"about": "this"}, reporter)
    with WorkerPool(Episodes(str(folder)), workers) as pool:
        return run_in_pool(pool, keys, log, reporter)


def runs(folder):
    return (folder / "runs.txt").read_text().split()


@pytest.mark.parametrize("workers", [1, 2, 4])
def test_records_are_the_same_for_any_number_of_workers(tmp_path, workers):
    records = run(tmp_path, keys_of(6), workers)
    assert records == [
        {
            "group": "policy",
            "task": "task",
            "seed": seed,
            "status": "done",
            "success": seed % 2 == 0,
            "steps": seed * 10,
            "attempts": 1,
        }
        for seed in range(6)
    ]


def test_progress_and_events_tell_of_every_episode(tmp_path):
    listener = Listener()
    run(tmp_path, keys_of(4), 1, listener)
    assert listener.steps == [("episodes", n, 4, (n + 1) // 2) for n in (1, 2, 3, 4)]
    assert [kind for kind, _ in listener.events] == ["episode"] * 4


def test_finished_episodes_are_never_run_again(tmp_path):
    first = run(tmp_path, keys_of(3))
    listener = Listener()
    more = run(tmp_path, keys_of(5), reporter=listener)
    assert more[:3] == first
    assert len(runs(tmp_path)) == 5
    assert listener.lines == ["3 of 5 episodes are there already; running the others"]
    assert listener.steps[-1] == ("episodes", 5, 5, 3)
    assert run(tmp_path, keys_of(5)) == more
    assert len(runs(tmp_path)) == 5


def test_another_evaluation_counts_nothing_of_the_one_before(tmp_path):
    run(tmp_path, keys_of(2), what={"checkpoint": "a"})
    listener = Listener()
    run(tmp_path, keys_of(2), what={"checkpoint": "b"}, reporter=listener)
    assert len(runs(tmp_path)) == 4
    aside = list(tmp_path.glob("episodes-*.jsonl"))
    assert len(aside) == 1
    assert listener.lines == [
        f"episodes.jsonl was about another evaluation; it is {aside[0].name} now"
    ]


CODE = {"versions": {"mujoco": "3.3.0", "numpy": "2"}, "hash": "abc"}


def test_an_episode_log_of_other_versions_is_asked_for(tmp_path):
    path, record = tmp_path / "episodes.jsonl", {**keys_of(1)[0].__dict__, "status": "done"}
    EvalLog(path, {"a": 1}, code=CODE).add({**record, "success": True, "return": float("nan")})
    assert json.loads(path.read_text().splitlines()[1])["return"] is None, "JSON has no NaN"
    assert len(EvalLog(path, {"a": 1}, code=CODE).records(keys_of(1))) == 1
    newer = {**CODE, "versions": {"mujoco": "3.4.0", "numpy": "2"}}
    with pytest.raises(UsageError, match=r"run with other code: mujoco 3\.3\.0 -> 3\.4\.0\n"):
        EvalLog(path, {"a": 1}, code=newer)
    beside = tmp_path / "episodes-0000-of-0002.jsonl"
    with pytest.raises(UsageError, match=r"mujoco 3\.3\.0 -> 3\.4\.0"):
        EvalLog(beside, {"a": 1}, "episodes*.jsonl", newer)
    log = EvalLog(path, {"a": 1}, code=newer, reuse=True)
    assert log.reused == set(keys_of(1))
    log.add({**record, "success": False})  # run again, by this code
    assert EvalLog(path, {"a": 1}, code=newer).reused == set()


def test_an_episode_log_of_the_former_format_says_nothing_of_its_code(tmp_path):
    path = tmp_path / "episodes.jsonl"
    lines = [{"format": "fluxvla-episodes-1", "evaluation": {"a": 1}}]
    lines += [{"group": "policy", "task": "task", "seed": 0, "status": "done", "success": True}]
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    with pytest.raises(UsageError, match="a former version of FluxVLA kept these episodes"):
        EvalLog(path, {"a": 1}, code=CODE)
    log = EvalLog(path, {"a": 1}, code=CODE, reuse=True)
    assert (len(log.records(keys_of(1))), len(log.reused)) == (1, 1)
    assert EvalLog(path, {"a": 2}, code=CODE).set_aside is not None, "another evaluation still is"


def test_records_of_version_0_1_are_read_under_the_present_keys(tmp_path):
    path = tmp_path / "episodes.jsonl"
    record = {"group": "policy", "task": "task", "seed": 0, "status": "done", "success": True}
    former = {"skipped_beats": 2, "pictures": {"sizes": {"top": [8, 9]}, "by": "egl: a"}}
    EvalLog(path, {"a": 1}, code=CODE).add({**record, **former})
    (read,) = EvalLog(path, {"a": 1}, code=CODE).records(keys_of(1))
    assert read == {**record, "skipped_ticks": 2, "images": former["pictures"]}


def test_a_crash_is_an_error_and_not_a_failure(tmp_path):
    listener = Listener()
    keys = [*keys_of(2), EpisodeKey("policy", "crash", 4), EpisodeKey("policy", "crashonce", 6)]
    records = run(tmp_path, keys, reporter=listener)
    assert [r["status"] for r in records] == ["done", "done", "error", "done"]
    assert records[2]["error"] == "its process died (exit code 9)"
    assert [r["attempts"] for r in records] == [1, 1, 2, 2]
    assert listener.lines == [
        "warning: episode policy/crash/4 gave no result after 2 attempts: "
        "its process died (exit code 9)"
    ]
    summary = summarise(records)["policy"]
    assert (summary["all"]["episodes"], summary["all"]["successes"]) == (3, 2)
    assert summary["all"]["errors"] == 1
    assert summary["tasks"]["crash"]["rate"] is None
    assert describe_rate("crash", summary["tasks"]["crash"]) == (
        "crash: no episode gave a result (1 errors)"
    )
    run(tmp_path, keys)
    assert runs(tmp_path).count("policy/crash/4") == 4, "an error is tried again the next time"


def started(folder):
    """An evaluation of 40 slow episodes in a process of its own, some of them finished."""
    root = Path(__file__).resolve().parents[2]
    command = [sys.executable, "-m", "tests.evaluation.workers", str(folder)]
    process = subprocess.Popen(command, cwd=root, start_new_session=True)
    log = folder / "episodes.jsonl"
    deadline = time.monotonic() + 60
    while not log.exists() or len(log.read_text().splitlines()) < 5:
        assert time.monotonic() < deadline, "the evaluation does not get going"
        assert process.poll() is None
        time.sleep(0.02)
    return process


def members(group):
    """Processes of a process group that still run (zombies have ended)."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[2]) == group and fields[0] != "Z":
            found.append(int(stat.parent.name))
    return found


def wait_until_gone(group):
    deadline = time.monotonic() + 20
    while members(group) and time.monotonic() < deadline:
        time.sleep(0.05)
    return members(group)


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs Linux's /proc")
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_an_evaluation_that_was_ended_goes_on_where_it_was(tmp_path, how):
    process = started(tmp_path)
    if how == signal.SIGINT:
        os.killpg(process.pid, how)  # as a terminal's Ctrl-C reaches the workers too
        assert process.wait(20) == 130
    else:
        process.kill()
        process.wait(20)
    assert wait_until_gone(process.pid) == [], "workers outlive the evaluation"
    kept = len((tmp_path / "episodes.jsonl").read_text().splitlines()) - 1
    before = len(runs(tmp_path))
    assert 4 <= kept < 40
    records = run(tmp_path, keys_of(40))
    assert [r["seed"] for r in records] == list(range(40))
    assert len(runs(tmp_path)) - before == 40 - kept, "finished episodes ran again"


def test_a_last_line_cut_short_is_no_episode(tmp_path):
    run(tmp_path, keys_of(3), 1)
    path = tmp_path / "episodes.jsonl"
    data = path.read_bytes()
    path.write_bytes(data[:-20])
    records = run(tmp_path, keys_of(3), 1)
    assert [r["seed"] for r in records] == [0, 1, 2]
    assert len(runs(tmp_path)) == 4
    assert all(json.loads(line) for line in path.read_text().splitlines())


def test_an_episode_log_that_cannot_be_written_is_named(tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("")
    with pytest.raises(RunFailed, match="episodes cannot be kept") as caught:
        EvalLog(blocked / "episodes.jsonl", {})
    assert str(blocked) in str(caught.value)


def test_a_full_disk_says_how_to_go_on(tmp_path, monkeypatch):
    log = EvalLog(tmp_path / "episodes.jsonl", {})

    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(RunFailed, match="No space left on device") as caught:
        log.add({"group": "policy", "task": "task", "seed": 1, "status": "done"})
    assert "run the same command again; finished episodes are kept" in str(caught.value)


def test_summaries_are_by_group_and_task():
    records = [
        {"group": g, "task": t, "seed": s, "status": "done", "success": s < n}
        for g, t, n in [("policy", "a", 4), ("policy", "b", 1), ("untrained", "a", 0)]
        for s in range(5)
    ]
    summary = summarise(records)
    assert summary["policy"]["tasks"]["a"]["successes"] == 4
    assert summary["policy"]["all"]["successes"] == 5
    assert summary["policy"]["all"]["episodes"] == 10
    assert summary["untrained"]["all"]["rate"] == 0.0
    line = describe_rate("a", summary["policy"]["tasks"]["a"])
    assert line == "a: 4/5 = 80% (95% interval 38% to 96%)"
