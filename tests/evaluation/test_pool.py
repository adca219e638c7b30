"""Worker processes: order, crashes, hangs, refusals, and leaving nothing behind."""

from __future__ import annotations

import multiprocessing
import os
import time

import pytest

from fluxvla_core.errors import ConfigError, RunFailed, SpecMismatch
from fluxvla_core.evaluation import pool
from fluxvla_core.evaluation.pool import WorkerPool
from fluxvla_core.plugins.registry import load_plugin_files
from tests.evaluation import workers


@pytest.fixture(autouse=True)
def no_process_is_left():
    yield
    assert multiprocessing.active_children() == []


def outcomes(factory, jobs, processes=2, **options):
    with WorkerPool(factory, processes, **options) as running:
        return sorted(running.run(jobs), key=lambda o: o.index)


@pytest.mark.parametrize("processes", [1, 3])
def test_every_job_gets_its_result(processes):
    results = [o.result for o in outcomes(workers.square, range(10), processes)]
    assert results == [n * n for n in range(10)]


def test_no_jobs_need_no_process():
    assert outcomes(workers.square, []) == []


def test_workers_have_one_thread_each_and_the_parent_keeps_its_environment(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "8")
    monkeypatch.delenv("LP_NUM_THREADS", raising=False)
    found = [o.result for o in outcomes(workers.report_environment, range(2))]
    assert {(omp, lp) for omp, lp, _ in found} == {("1", "1")}
    assert os.getpid() not in {pid for *_, pid in found}
    assert os.environ["OMP_NUM_THREADS"] == "8"
    assert "LP_NUM_THREADS" not in os.environ


def test_a_crash_is_retried_once_and_the_others_go_on(tmp_path):
    jobs = ["fine-1", "killonce-1", "kill-1", "fine-2", "fine-3"]
    recorder = workers.Recorder(str(tmp_path))
    found = outcomes(recorder, jobs)
    assert [o.result for o in found] == [
        "fine-1 done",
        "killonce-1 done",
        None,
        "fine-2 done",
        "fine-3 done",
    ]
    assert [o.attempts for o in found] == [1, 2, 2, 1, 1]
    assert found[2].error == "its process died (SIGKILL)"
    assert [recorder.attempts(job) for job in jobs] == [1, 2, 2, 1, 1]


def test_an_exception_is_retried_once_and_then_reported_with_its_traceback(tmp_path):
    found = outcomes(workers.Recorder(str(tmp_path)), ["raiseonce-1", "raise-1", "fine"], 1)
    assert found[0].result == "raiseonce-1 done"
    assert found[1].result is None
    assert "workers.py" in found[1].error
    assert found[1].error.strip().endswith("ZeroDivisionError: the simulator blew up")
    assert found[2].result == "fine done"


@pytest.mark.parametrize("processes", [1, 2])
def test_a_process_that_raised_gets_no_more_jobs(tmp_path, processes):
    """What broke in it would break every later job."""
    jobs = ["breaksonce", "fine-1", "breaksonce-2", "fine-2", "fine-3"]
    found = outcomes(workers.Recorder(str(tmp_path)), jobs, processes)
    assert [o.error for o in found] == [None] * 5
    assert [o.attempts for o in found] == [2, 1, 2, 1, 1]


def test_any_number_of_jobs_may_raise(tmp_path):
    """A process that raised was not one that could not be started."""
    jobs = [f"raise-{n}" for n in range(4)]
    found = outcomes(workers.Recorder(str(tmp_path)), jobs, 1)
    assert [o.attempts for o in found] == [2] * 4


def test_a_failure_of_the_run_is_an_error_of_its_job_alone(tmp_path):
    found = outcomes(workers.Recorder(str(tmp_path)), ["runfailed", "fine"])
    assert found[0].error == "the renderer is gone\n  next: look for it"
    assert found[1].result == "fine done"


def test_a_hanging_job_is_ended_and_retried(tmp_path):
    jobs = ["hangonce", "hang", "fine"]
    found = outcomes(workers.Recorder(str(tmp_path)), jobs, timeout_s=3.0)
    assert [o.result for o in found] == ["hangonce done", None, "fine done"]
    assert found[1].error == "took longer than 3 s"


def test_an_answer_that_came_while_this_process_stood_still_is_in_time(monkeypatch):
    wait = pool.wait

    def stands_still(connections, timeout):
        """Nothing is readable when the time is over, and an answer is there a moment later."""
        if timeout is None:
            return wait(connections)
        assert wait(connections, 60)
        time.sleep(timeout)
        return []

    monkeypatch.setattr(pool, "wait", stands_still)
    (found,) = outcomes(workers.square, [3], 1, timeout_s=0.2)
    assert (found.result, found.attempts) == (9, 1)


def test_bad_input_ends_the_run_with_its_own_message(tmp_path):
    jobs = ["refuse", *[f"slow-{n}" for n in range(50)]]
    with pytest.raises(SpecMismatch, match="do not fit together") as caught:
        outcomes(workers.Recorder(str(tmp_path)), jobs)
    assert caught.value.next == "train another"


def test_a_factory_that_refuses_ends_the_run():
    with pytest.raises(ConfigError, match="there is no task 'juggle'") as caught:
        outcomes(workers.refuses, [1, 2])
    assert caught.value.next == "choose another"


def test_a_factory_that_raises_is_shown_with_its_traceback():
    with pytest.raises(RunFailed, match="could not be set up") as caught:
        outcomes(workers.broken, [1])
    assert "ImportError: no module named simulator" in str(caught.value)


def test_workers_that_die_at_once_do_not_go_on_for_ever():
    with pytest.raises(RunFailed, match=r"die before they have begun.*exit code 7") as caught:
        outcomes(workers.dies, [1, 2, 3])
    assert "--set <section>.workers=1" in str(caught.value)


def test_closing_the_iterator_ends_the_workers(tmp_path):
    recorder = workers.Recorder(str(tmp_path))
    iterator = WorkerPool(recorder, 2).run([f"slow-{n}" for n in range(50)])
    next(iterator)
    iterator.close()
    assert multiprocessing.active_children() == []
    assert len(list(tmp_path.iterdir())) < 10


def test_a_pool_keeps_its_workers_from_one_run_to_the_next():
    with WorkerPool(workers.report_environment, 2) as pool:
        assert pool.ready_s is None
        first = {o.result[2] for o in pool.run(range(8))}
        assert pool.ready_s > 0
        second = {o.result[2] for o in pool.run(range(8))}
    assert second <= first
    assert len(first) <= 2


def test_a_pool_grows_with_its_jobs_and_replaces_who_died(tmp_path):
    with WorkerPool(workers.Recorder(str(tmp_path)), 3) as pool:
        assert [o.result for o in pool.run(["fine-1"])] == ["fine-1 done"]
        assert len(multiprocessing.active_children()) == 1
        assert next(pool.run(["kill-1"])).error == "its process died (SIGKILL)"
        found = {o.result for o in pool.run(["slow-1", "slow-2", "slow-3"])}
        assert found == {"slow-1 done", "slow-2 done", "slow-3 done"}


def test_workers_below_one_are_refused():
    with pytest.raises(ValueError, match="at least 1, got 0"):
        WorkerPool(workers.square, 0)


def test_plugin_files_of_the_parent_are_loaded_in_the_workers(tmp_path):
    file = tmp_path / "mine.py"
    file.write_text("VALUE = 40\n")
    load_plugin_files([file])
    assert [o.result for o in outcomes(workers.uses_plugin_file, [2])] == [42]
