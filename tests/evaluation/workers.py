"""Workers for the pool's tests; here because a worker process imports them by name."""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path

from fluxvla_core.errors import ConfigError, RunFailed, SpecMismatch


def square():
    return lambda job: job * job


def report_environment():
    def work(job):
        return os.environ.get("OMP_NUM_THREADS"), os.environ.get("LP_NUM_THREADS"), os.getpid()

    return work


class Recorder:
    """Leaves a mark in ``folder`` at each attempt; what a job is called says what happens."""

    def __init__(self, folder: str) -> None:
        self.folder = Path(folder)
        self.broken = False

    def __call__(self):
        return self.work

    def attempts(self, job: str) -> int:
        return len(list(self.folder.glob(f"{job}.*")))

    def work(self, job: str) -> str:
        attempt = self.attempts(job)
        (self.folder / f"{job}.{attempt}").touch()
        if self.broken:
            raise RuntimeError("the renderer's context is lost")
        kind = job.partition("-")[0]
        if kind == "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        if kind == "killonce" and attempt == 0:
            os._exit(3)
        if kind == "raise":
            raise ZeroDivisionError("the simulator blew up")
        if kind == "raiseonce" and attempt == 0:
            raise RuntimeError("first time")
        if kind == "breaksonce" and attempt == 0:
            self.broken = True
            raise RuntimeError("the renderer lost its context")
        if kind == "runfailed":
            raise RunFailed("the renderer is gone", next="look for it")
        if kind == "refuse":
            raise SpecMismatch("policy and scene do not fit together", next="train another")
        if kind == "hang" or (kind == "hangonce" and attempt == 0):
            time.sleep(600)
        if kind == "slow":
            time.sleep(0.3)
        return f"{job} done"


def refuses():
    raise ConfigError("there is no task 'juggle'", next="choose another")


def broken():
    raise ImportError("no module named simulator")


def dies():
    os._exit(7)


def uses_plugin_file():
    module = sys.modules["fluxvla_plugin_mine"]
    return lambda job: module.VALUE + job


class Episodes:
    """Runs fake episodes: success when the seed is even; a mark in ``folder`` for each run."""

    def __init__(self, folder: str, seconds: float = 0.0) -> None:
        self.folder = Path(folder)
        self.seconds = seconds

    def __call__(self):
        return self.run

    def run(self, key):
        with (self.folder / "runs.txt").open("a") as file:
            file.write(f"{key.group}/{key.task}/{key.seed}\n")
        time.sleep(self.seconds)
        if key.task == "crash":
            os._exit(9)
        if key.task == "crashonce" and not (self.folder / f"{key.seed}.seen").exists():
            (self.folder / f"{key.seed}.seen").touch()
            os._exit(9)
        return {"success": key.seed % 2 == 0, "steps": key.seed * 10}


def evaluate_forever(folder: str) -> None:
    """What a killed or interrupted evaluation runs: slow episodes into a log."""
    from fluxvla_core.contracts.runner import SilentReporter
    from fluxvla_core.evaluation.episodes import EpisodeKey
    from fluxvla_core.evaluation.eval_log import EvalLog
    from fluxvla_core.evaluation.pool import WorkerPool
    from fluxvla_core.evaluation.runner import run_in_pool

    keys = [EpisodeKey("policy", "task", seed) for seed in range(40)]
    log = EvalLog(Path(folder) / "episodes.jsonl", {"about": "this"})
    try:
        with WorkerPool(Episodes(folder, 0.15), 2) as pool:
            run_in_pool(pool, keys, log, SilentReporter())
    except KeyboardInterrupt:
        sys.exit(130)


if __name__ == "__main__":
    evaluate_forever(sys.argv[1])
