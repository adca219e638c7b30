"""``--max-restarts``: a job whose process dies goes on by itself, and ends as if none had."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from fluxvla_core.cli import launch, ranks

from .conftest import Fluxvla, Write

pytest.importorskip("torch")

PLUGIN = '''\
import os, signal, time
from pathlib import Path
from fluxvla_core import COLLATORS, DATASETS
from fluxvla_core.data.loader import DictCollator
from fluxvla_core.testing import training


@DATASETS.register_module()
class Tiny(training.TinyDataset):
    def __init__(self, length=37):
        super().__init__(length)


@COLLATORS.register_module()
class Ending(DictCollator):
    """Ends rank 1 on the way to its ``batch``-th batch, in the first ``lives`` attempts.

    It waits for a checkpoint, which may still be on its way.
    """

    def __init__(self, batch=5, how="killed", lives=1):
        super().__init__(training.KEYS)
        self.left, self.how, self.lives = batch, how, lives

    def __call__(self, samples):
        self.left -= 1
        attempt = int(os.environ.get("TORCHELASTIC_RESTART_COUNT", "0"))
        if self.left == 0 and attempt < self.lives and os.environ.get("RANK") == "1":
            while not list(Path().glob("*/checkpoints/step-*/manifest.json")):
                time.sleep(0.01)
            if self.how == "killed":
                os.kill(os.getpid(), signal.SIGKILL)
            raise ValueError("a bad sample")
        return super().__call__(samples)
'''
CONFIG = """\
model = dict(type="TinyVLA")
train_dataloader = dict(per_device_batch_size=2, dataset=dict(type="Tiny"))
runner = dict(type="DDPTrainRunner", max_steps=9, save_iter_interval=3, max_keep_ckpts=0,
              learning_rate=1e-2, collator=dict(type="Ending", how="killed", lives=1))
"""


@pytest.fixture
def tiny(write: Write) -> None:
    write("tiny.py", PLUGIN)
    write("tiny_config.py", CONFIG)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The work dir of a run in which nothing ends before its time."""
    place = tmp_path_factory.mktemp("whole")
    (place / "tiny.py").write_text(PLUGIN)
    (place / "tiny_config.py").write_text(CONFIG)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        code, _, err = start("work", "--nproc", "2", "--set", "runner.collator.lives=0")
    assert (code, err) == (0, "")
    return place / "work"


def start(work_dir: str, *words: str, module: tuple[str, ...] = ()) -> tuple[int, str, str]:
    command = [sys.executable, "-m", *(module or ("fluxvla_core",)), "run"]
    command += ["--config", "tiny_config.py", "--plugin", "tiny.py", "--work-dir", work_dir]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    ended = subprocess.run(
        [*command, *words], capture_output=True, text=True, timeout=600, env=environment
    )
    return ended.returncode, ended.stdout, ended.stderr


def differing(a: Path, b: Path) -> list[str]:
    from fluxvla_core.testing.training import differences

    # The two runs' configs differ in how often the collator ends them.
    found = differences(a, b)
    return [name for name in found if not name.endswith("config.resolved.json")]


def test_a_killed_rank_costs_nothing_but_time(tiny: None, whole: Path) -> None:
    code, out, err = start("cut", "--nproc", "2", "--max-restarts", "1")
    assert (code, err) == (0, "")
    assert "warning: restart 1: rank 1 ended without an error message: killed, or crashed" in out
    assert "resuming from cut/checkpoints/step-000000003 (step 3)" in out
    assert differing(whole, Path("cut")) == []


def test_a_restart_before_the_first_save_begins_where_the_run_did(tiny: None, whole: Path) -> None:
    shutil.copytree(whole, "whole")
    place = "whole/checkpoints/step-000000006"
    words = ("--set", f"runner.resume_from+={place}", "--set", "runner.collator.batch+=1")
    code, out, err = start("cut", "--nproc", "2", "--max-restarts", "1", *words)
    assert (code, err) == (0, "")
    told = out.partition("warning: restart 1:")
    assert all(f"resuming from {place} (step 6)" in part for part in (told[0], told[2]))


def test_an_error_is_told_at_the_restart_and_again_when_there_is_none_left(tiny: None) -> None:
    words = ("--set", "runner.collator.how='raises'", "--set", "runner.collator.lives=2")
    code, out, err = start("work", "--nproc", "2", "--max-restarts", "1", *words)
    assert code == 1
    assert "warning: restart 1: rank 1 failed:\nTraceback" in out
    assert "ValueError: a bad sample" in out
    assert err.startswith("rank 1 failed:\nTraceback")
    assert err.rstrip().endswith("ValueError: a bad sample")


def test_torchrun_starts_ranks_and_restarts_them_too(tiny: None, whole: Path) -> None:
    module = ("torch.distributed.run", "--nproc-per-node", "2", "--standalone")
    module += ("--max-restarts", "1", "-m", "fluxvla_core")
    code, out, err = start("cut", module=module)
    assert code == 0, err
    # The line itself: on a busy machine heartbeats ("… 4 s since: resuming") repeat it.
    assert out.count("s] resuming from cut/checkpoints/step-000000003 (step 3)") == 1
    assert differing(whole, Path("cut")) == []


def going_on(place: str, steps: int, *words: str, module: tuple[str, ...] = ()) -> str:
    """What a training says whose config, and no option, tells it to resume."""
    words += ("--set", f"runner.resume_from+={place}", "--set", f"runner.max_steps={steps}")
    code, out, err = start("work", *words, "--set", "runner.collator.lives=0", module=module)
    assert code == 0, err
    return out


@pytest.mark.slow
def test_a_config_that_resumes_needs_no_option(tiny: None) -> None:
    assert "training starts from scratch" in going_on("auto", 3)
    assert "resuming from work/checkpoints/step-000000003 (step 3)" in going_on(
        "auto", 4, "--nproc", "2"
    )
    torchrun = ("torch.distributed.run", "--standalone", "-m", "fluxvla_core")
    assert "resuming from work/checkpoints/step-000000004 (step 4)" in going_on(
        "auto", 5, module=torchrun
    )
    out = going_on("work/checkpoints/step-000000003", 6)
    assert "a later checkpoint is set aside as step-000000005.set-aside" in out
    assert "resuming from work/checkpoints/step-000000003 (step 3)" in out


# -- in this process -------------------------------------------------------------------------


def test_what_a_restart_resumes_from(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    agent(monkeypatch)
    ranks.mark_started(tmp_path)
    assert ranks.resume_from(None, tmp_path) is None
    assert ranks.resume_from("there", tmp_path) == "there"
    agent(monkeypatch, attempt=1)
    assert ranks.resume_from(None, tmp_path) == "auto"
    assert ranks.resume_from("there", tmp_path) == "there"
    saved = tmp_path / "checkpoints" / "step-000000003"
    saved.mkdir(parents=True)
    (saved / "manifest.json").write_text("{}")
    assert ranks.resume_from("there", tmp_path) == "auto"
    (tmp_path / ranks.JOB).unlink()
    assert ranks.resume_from(None, tmp_path) is None, "this job had not begun here"
    assert ranks.resume_from("there", tmp_path) == "there"


def agent(
    patch: pytest.MonkeyPatch, name: str = "a", job: str = "none", host: str = "h", attempt: int = 0
) -> None:
    """The environment of a rank that the agent ``name`` of torchrun started on ``host``."""
    patch.setenv("TORCHELASTIC_RUN_ID", job)
    patch.setenv("TORCHELASTIC_RESTART_COUNT", str(attempt))
    patch.setenv("TORCHELASTIC_ERROR_FILE", f"/tmp/{name}/attempt_{attempt}/0/error.json")
    patch.setattr(socket, "gethostname", lambda: host)


@pytest.mark.parametrize(
    ("later", "goes_on"),
    [
        ({}, True),
        ({"name": "b"}, False),
        ({"name": "b", "host": "other"}, False),
        ({"job": "7"}, False),
        ({"first": "7", "job": "7"}, True),
        # Another machine of the job has the first rank now.
        ({"first": "7", "job": "7", "name": "b", "host": "other"}, True),
        # The next job by the same name.
        ({"first": "7", "job": "7", "name": "b"}, False),
        ({"first": "7", "job": "8", "name": "b", "host": "other"}, False),
    ],
)
def test_only_the_job_that_had_begun_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, later: dict[str, str], goes_on: bool
) -> None:
    agent(monkeypatch, job=later.pop("first", "none"))
    ranks.mark_started(tmp_path)
    agent(monkeypatch, **later, attempt=1)
    assert ranks.resume_from(None, tmp_path) == ("auto" if goes_on else None)


def test_the_work_dir_is_the_last_ones_that_began(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    agent(monkeypatch)
    ranks.mark_started(tmp_path)
    with monkeypatch.context() as patch:
        patch.delenv("TORCHELASTIC_RUN_ID")
        ranks.mark_started(tmp_path)
    agent(monkeypatch, attempt=1)
    assert ranks.resume_from(None, tmp_path) is None
    monkeypatch.setenv("RANK", "1")
    ranks.mark_started(tmp_path)
    assert not (tmp_path / ranks.JOB).exists(), "the first rank speaks for all"
    (tmp_path / ranks.JOB).write_text("[")
    assert ranks.resume_from(None, tmp_path) is None


def test_without_its_folder_an_agent_is_the_parent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    agent(monkeypatch)
    monkeypatch.setenv("TORCHELASTIC_ERROR_FILE", "")
    ranks.mark_started(tmp_path)
    monkeypatch.setenv("TORCHELASTIC_RESTART_COUNT", "1")
    assert ranks.resume_from(None, tmp_path) == "auto"
    monkeypatch.setattr(os, "getppid", lambda: 1)
    assert ranks.resume_from(None, tmp_path) is None


@pytest.mark.parametrize("words", [(), ("--resume", "elsewhere")])
def test_a_refused_training_is_refused_again_after_a_restart(
    run: Fluxvla, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...]
) -> None:
    monkeypatch.setattr(launch, "die_with_parent", lambda: None)
    saved = Path("work_dirs/c/checkpoints/step-000000003")
    saved.mkdir(parents=True)
    (saved / "manifest.json").write_text("{}")
    Path("elsewhere").mkdir()
    for attempt in range(3):
        agent(monkeypatch, attempt=attempt)
        ended = run("--config", "c.py", "--section", "runner", *words)
        assert ended.code == 2
        assert "the work dir already holds checkpoints, up to step 3" in ended.err
    agent(monkeypatch, attempt=0)
    assert run("--config", "c.py", "--section", "runner", "--resume", "auto").code == 0
    agent(monkeypatch, attempt=1)
    assert run("--config", "c.py", "--section", "runner").code == 0, "it had begun"


def test_why_there_was_a_restart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert ranks.restart_notice() == []
    monkeypatch.setenv(ranks.ERROR_DIR, str(tmp_path))
    monkeypatch.setenv("RANK", "1")
    ranks.record_failure("a.mp4: bad data\n", 2, expected=True)
    monkeypatch.setenv("TORCHELASTIC_RESTART_COUNT", "1")
    assert ranks.restart_notice() == ["restart 1: rank 1 failed:\na.mp4: bad data"]
    monkeypatch.setenv("RANK", "0")
    lost = "rank 0 of 2 lost another rank during step 3"
    ranks.record_failure(lost, 1, expected=True, reason="rank lost")
    assert list(ranks.failures(tmp_path)) == [0]
    assert list(ranks.failures(tmp_path, 0)) == [1]
    monkeypatch.setenv("TORCHELASTIC_RESTART_COUNT", "2")
    monkeypatch.setenv("WORLD_SIZE", "3")
    assert ranks.restart_notice() == [
        "restart 2: rank 1, 2 ended without an error message: killed, or crashed below Python"
    ]
    monkeypatch.delenv(ranks.ERROR_DIR)
    assert ranks.restart_notice() == ["restart 2: a process ended without an error message"]


def test_only_a_training_restarts(run: Fluxvla) -> None:
    ended = run("--config", "c.py", "--section", "eval", "--max-restarts", "2")
    assert ended.code == 2
    assert "--max-restarts is for training, and section 'eval' does not train" in ended.err
    ended = run("--config", "c.py", "--section", "runner", "--max-restarts", "-1")
    assert "argument --max-restarts: -1 is less than 0" in ended.err
