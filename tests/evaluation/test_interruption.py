"""kill -9 at any moment, and several processes on one evaluation: nothing lost, nothing twice."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter

import pytest

from tests.evaluation.conftest import WALKING

EPISODES = 12


@pytest.fixture
def config(tmp_path):
    """A config whose environment leaves a mark for each episode that is begun."""
    marks = tmp_path / "marks"
    marks.mkdir()
    file = tmp_path / "walk.py"
    file.write_text(
        "eval = dict(type='EvalRunner', policy='expert', episodes=6, record_videos=0,\n"
        f"    environment=dict(type='Walk', slow=0.02, marks={str(marks)!r}))\n"
    )
    return file


def words(config, work_dir, *more):
    return [
        "run",
        "--config",
        str(config),
        "--plugin",
        str(WALKING),
        "--work-dir",
        str(work_dir),
        *more,
    ]


def records(work_dir):
    found = []
    for path in (work_dir / "eval").glob("episodes*.jsonl"):
        for line in path.read_text().split("\n")[1:-1]:
            found.append(json.loads(line))
    return found


def courses(work_dir):
    return {
        (r["task"], r["seed"]): (r["success"], r["steps"], r["return"], r["state_hash"])
        for r in records(work_dir)
    }


def start(config, work_dir, *more, **variables):
    return subprocess.Popen(
        [sys.executable, "-m", "fluxvla_core", *words(config, work_dir, *more)],
        env={**os.environ, **variables},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )


def whole(config, work_dir):
    began = time.monotonic()
    process = start(config, work_dir)
    _, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors.decode()
    return time.monotonic() - began


@pytest.mark.slow
def test_an_evaluation_goes_on_after_kill_9_at_any_moment(tmp_path, config):
    usual, chance = whole(config, tmp_path / "whole"), random.Random(3)
    expected = courses(tmp_path / "whole")
    assert len(expected) == EPISODES
    for attempt in range(10):
        work_dir = tmp_path / f"cut-{attempt}"
        process = start(config, work_dir)
        time.sleep(chance.uniform(0.05, 1.0) * usual)
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate(timeout=60)
        before = courses(work_dir) if (work_dir / "eval").exists() else {}
        whole(config, work_dir)
        assert courses(work_dir) == expected
        assert before.items() <= expected.items()
        assert max(Counter((r["task"], r["seed"]) for r in records(work_dir)).values()) == 1
        results = json.loads((work_dir / "eval" / "results.json").read_text())
        assert results["groups"]["policy"]["all"]["episodes"] == EPISODES


def test_what_was_finished_before_kill_9_is_not_run_again(tmp_path, config):
    work_dir = tmp_path / "cut"
    process = start(config, work_dir)
    deadline = time.monotonic() + 120
    while not records(work_dir) and time.monotonic() < deadline:
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate(timeout=60)
    finished = {f"{r['task']}-{r['seed']}" for r in records(work_dir)}
    assert len(finished) > 0
    marks = tmp_path / "marks"
    before = {mark.name for mark in marks.iterdir()}
    whole(config, work_dir)
    again = {mark.name.split(".")[0] for mark in marks.iterdir() if mark.name not in before}
    assert not again & finished
    assert len(courses(work_dir)) == EPISODES


def test_torchruns_processes_share_an_evaluation(tmp_path, config):
    pytest.importorskip("torch")
    whole(config, tmp_path / "whole")
    # It takes a port by itself: one that is found free here may be taken by then.
    launcher = ["--nproc-per-node", "2", "--standalone", "--local-addr", "127.0.0.1"]
    ended = subprocess.run(
        [sys.executable, "-m", "torch.distributed.run", *launcher, "-m", "fluxvla_core"]
        + words(config, tmp_path / "two", "--set", "eval.workers+=1"),
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert ended.returncode == 0, ended.stderr
    folder = tmp_path / "two" / "eval"
    assert {path.name for path in folder.glob("episodes*")} == {
        "episodes-0000-of-0002.jsonl",
        "episodes-0001-of-0002.jsonl",
    }
    assert courses(tmp_path / "two") == courses(tmp_path / "whole")
    results = [
        json.loads((tmp_path / name / "eval" / "results.json").read_text())
        for name in ("whole", "two")
    ]
    assert results[0]["groups"] == results[1]["groups"]


@pytest.mark.slow
def test_the_tasks_of_a_slurm_array_share_an_evaluation(tmp_path, config):
    array = {"SLURM_ARRAY_TASK_MIN": "1", "SLURM_ARRAY_TASK_COUNT": "2"}
    for index in ("2", "1"):
        process = start(config, tmp_path / "array", SLURM_ARRAY_TASK_ID=index, **array)
        _, errors = process.communicate(timeout=300)
        assert process.returncode == 0, errors.decode()
    results = json.loads((tmp_path / "array" / "eval" / "results.json").read_text())
    assert results["groups"]["policy"]["all"]["episodes"] == EPISODES
    assert len(records(tmp_path / "array")) == EPISODES
