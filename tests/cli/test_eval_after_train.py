"""``--eval-after-train``: a fresh process, only after success, checked before training."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from fluxvla_core.cli.run import EVALUATION

from .conftest import Fluxvla, Write

EVALUATES = '''\

@RUNNERS.register_module()
class Asking:
    """Writes down what process it is in."""

    def __init__(self, context=None):
        self.context = context

    def run_setup(self): ...

    def run(self):
        ranked = [n for n in os.environ if n in ("RANK", "WORLD_SIZE") or "TORCHELASTIC" in n]
        done = sorted(p.name for p in self.context.work_dir.glob("said-*"))
        (self.context.work_dir / "asked.json").write_text(json.dumps([os.getpid(), ranked, done]))
'''


@pytest.fixture
def asking(write: Write) -> None:
    toy = Path("toy.py")
    toy.write_text(toy.read_text() + EVALUATES)
    config = Path("c.py").read_text().rpartition("eval = ")[0]
    write("c.py", config + "eval = dict(type='Asking')\n")


def start(*words: str) -> tuple[int, str, str, int]:
    command = [sys.executable, "-m", "fluxvla_core", "run", "--config", "c.py"]
    command += ["--plugin", "toy.py", "--section", "runner", "--eval-after-train", *words]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        out, err = process.communicate(timeout=600)
    return process.returncode, out, err, process.pid


def asked() -> Any:
    import json

    return json.loads(Path("work_dirs/c/asked.json").read_text())


def test_it_follows_a_training_in_the_same_place(asking: None) -> None:
    code, out, err, pid = start()
    assert (code, err) == (0, "")
    assert out.count("work dir: work_dirs/c") == 2
    assert asked() == [pid, [], ["said-0.json"]]
    assert Path("work_dirs/c/eval/config.resolved.json").exists()


def test_it_follows_the_launcher_of_several_processes(asking: None) -> None:
    pytest.importorskip("torch")
    code, _, err, pid = start("--nproc", "2", "--set", "runner.max_epochs=2")
    assert (code, err) == (0, "")
    assert asked() == [pid, [], ["said-0.json", "said-1.json"]]


def test_a_training_that_fails_is_not_evaluated(asking: None) -> None:
    code, _, err, _ = start("--set", "runner.mode+=denied")
    assert code == 2
    assert "a.mp4: bad data" in err
    assert not Path("work_dirs/c/asked.json").exists()


def test_what_cannot_be_evaluated_is_told_before_training(run: Fluxvla, write: Write) -> None:
    write("c.py", Path("c.py").read_text().replace("eval = ", "later = "))
    ended = run("--config", "c.py", "--section", "runner", "--eval-after-train")
    assert ended.code == 2
    assert ended.err == (
        "c.py: --eval-after-train needs a section 'eval' that evaluates\n"
        "  next: sections that do not train: later\n"
    )
    assert not Path("work_dirs").exists()
    ended = run("--config", "c.py", "--section", "later", "--eval-after-train")
    assert "--eval-after-train is for training, and section 'later' does not" in ended.err


def test_under_torchrun_the_first_rank_evaluates_and_is_no_rank_then(
    run: Fluxvla, monkeypatch: pytest.MonkeyPatch
) -> None:
    became: list[tuple[list[str], dict[str, str]]] = []
    monkeypatch.setattr(os, "execve", lambda path, words, env: became.append((words, env)))
    for name, value in {"RANK": "1", "WORLD_SIZE": "2", "MASTER_PORT": "1"}.items():
        monkeypatch.setenv(name, value)
    Path("work_dirs/c").mkdir(parents=True)
    command = ("--config", "c.py", "--section", "runner", "--eval-after-train")
    assert run(*command, "--set", "runner.max_epochs=3").code == 0
    assert became == []
    monkeypatch.setenv("RANK", "0")
    assert run(*command, "--set", "runner.max_epochs=3").code == 0
    ((words, environment),) = became
    assert words[1:5] == ["-m", "fluxvla_core", "run", "--config"]
    assert words[words.index("--section") + 1] == EVALUATION
    assert "runner.max_epochs=3" in words
    assert not {"RANK", "WORLD_SIZE", "MASTER_PORT"} & set(environment)


TINY = """\
from fluxvla_core import COLLATORS, DATASETS, RUNNERS, VLAS
from fluxvla_core.data.loader import DictCollator
from fluxvla_core.testing import training

for registry, made in (
    (COLLATORS, DictCollator),
    (DATASETS, training.TinyDataset),
    (RUNNERS, training.OneProcessRunner),
    (VLAS, training.TinyVLA),
):
    registry.register_module(force=True)(made)
"""
TRAINS = """\
model = dict(type="TinyVLA")
train_dataloader = dict(per_device_batch_size=2, dataset=dict(type="TinyDataset"))
runner = dict(type="OneProcessRunner", max_steps=9, learning_rate=1e-2, collator=dict(
    type="DictCollator", keys=["states", "actions", "noise", "sample_ids"]))
eval = dict(type="ToyEvalRunner", operator=dict(type="ToyOperator"))
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_nothing_is_evaluated_after_a_stop_during_the_last_save(
    run: Fluxvla, write: Write, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    pytest.importorskip("torch")
    from fluxvla_core import BaseTrainRunner

    settle = BaseTrainRunner.finish_pending_save

    def settled(run: BaseTrainRunner, wait: bool = True) -> None:
        settle(run, wait)
        if wait:  # not after a step
            os.kill(os.getpid(), number)

    monkeypatch.setattr(BaseTrainRunner, "finish_pending_save", settled)
    monkeypatch.setattr(os, "execve", lambda *words: pytest.fail("it is evaluated"))
    write("tiny.py", TINY)
    config = write("t.py", TRAINS)
    words = ("--config", str(config), "--plugin", "tiny.py", "--set", "runner.max_steps=2")
    ended = run(*words, "--section", "runner", "--eval-after-train")
    assert (ended.code, ended.err) == (
        0,
        f"training is complete and saved, but not evaluated: {number.name} came at its end\n"
        "  next: fluxvla run --config t.py --section eval --work-dir work_dirs/t "
        "--set runner.max_steps=2 --plugin toy.py --plugin tiny.py --log-format text\n",
    )
    assert Path("work_dirs/t/checkpoints/step-000000002/manifest.json").exists()
