"""A working directory with a config, and a toy plugin that records what it was told."""

from __future__ import annotations

import signal
import textwrap
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from fluxvla_core.cli.main import main
from fluxvla_core.config import source
from fluxvla_core.plugins.registry import BY_NAME
from fluxvla_core.signals import requests_to_stop

Write = Callable[[str, str], Path]

TOY = '''\
"""Toy classes, registered by ``--plugin toy.py``."""
import json, os, signal, time
from fluxvla_core import DATASETS, OPERATORS, RUNNERS
from fluxvla_core.errors import DataError


@DATASETS.register_module()
class ToyDataset:
    def __init__(self, size=3):
        self.size = size

    def __len__(self):
        return self.size

    def get_sample(self, index, epoch):
        return {}


@OPERATORS.register_module()
class ToyOperator:
    def __init__(self, port=1): ...
    def get_frame(self): ...


@RUNNERS.register_module()
class ToyTrainRunner:
    def __init__(self, max_epochs, mode="", resume_from=None, context=None):
        self.context, self.mode, self.max_epochs = context, mode, max_epochs

    def run_setup(self, n_train_examples):
        self.examples = n_train_examples

    def run(self, dataset):
        rank = int(os.environ.get("RANK", "0"))
        context, report = self.context, self.context.reporter
        report.progress("train", 1, 2, loss=0.5)
        if self.mode == "denied":
            raise DataError("bad data", where="a.mp4", next="look at it")
        if self.mode == "silent":
            time.sleep(1.5)
        if self.mode == "hints":
            text = "--set <section>.mode=a, --set <ToyDataset>.size=2 or --set <Gone>.size=2"
            raise DataError("bad data", next=text)
        if self.mode == "full":
            raise OSError(28, "No space left on device", "big.bin")
        if self.mode == "ctrl-c":
            raise KeyboardInterrupt("saved at step 3")
        if self.mode == "sigterm":
            os.kill(os.getpid(), 15)
            time.sleep(10)
        if self.mode == "boom":
            raise ValueError("boom")
        if rank == 1 and self.mode == "rank 1 fails":
            raise DataError("bad data", where="rank-1.mp4")
        if rank == 1 and self.mode == "rank 1 raises":
            raise ValueError("boom")
        if rank == 1 and self.mode == "rank 1 dies":
            os.kill(os.getpid(), 9)
        if self.mode == "wait, rank 1 deaf" and rank == 1:
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        if self.mode.startswith(("rank 1", "wait")):
            (context.work_dir / f"pid-{rank}").write_text(str(os.getpid()))
            time.sleep(120)
        record = dict(
            section=context.section, examples=self.examples, resume=context.resume,
            nproc=context.nproc, file=context.config_file, epochs=self.max_epochs,
            threads=os.environ.get("OMP_NUM_THREADS"), world=os.environ.get("WORLD_SIZE"),
            config=context.config, where=context.where("runner.max_epochs"),
        )
        (context.work_dir / f"said-{rank}.json").write_text(json.dumps(record))
        report.progress("train", 2, 2, loss=0.25)
        return {"loss": 0.25, "steps": 2, "curve": [0.5, 0.25]}


@RUNNERS.register_module()
class ToyEvalRunner:
    def __init__(self, operator=None, seeds=1, workers=None, context=None):
        self.context = context

    def run_setup(self):
        self.ready = True

    def run(self):
        (self.context.work_dir / "eval.txt").write_text(
            f"{self.ready} {self.context.task} {self.context.nproc}"
        )
'''
CONFIG = """\
train_dataloader = dict(dataset=dict(type='ToyDataset'))
runner = dict(type='ToyTrainRunner',
              max_epochs=1)
eval = dict(type='ToyEvalRunner', operator=dict(type='ToyOperator'))
"""


@dataclass(frozen=True)
class Ended:
    """How a command ended."""

    code: int
    out: str
    err: str


Fluxvla = Callable[..., Ended]


@pytest.fixture(autouse=True)
def _as_it_was(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Registries, parsed sources, signal handlers and rank variables as they were."""
    before = {name: dict(registry._here) for name, registry in BY_NAME.items()}
    handlers = {number: signal.getsignal(number) for number in requests_to_stop()}
    for name in ("RANK", "WORLD_SIZE", "FLUXVLA_STRICT", "FLUXVLA_ERROR_DIR"):
        monkeypatch.delenv(name, raising=False)
    source.parse.cache_clear()
    yield
    for number, handler in handlers.items():
        signal.signal(number, handler)
    for name, registry in BY_NAME.items():
        registry._here.clear()
        registry._here.update(before[name])
    source.parse.cache_clear()


@pytest.fixture
def write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Write:
    """``write(name, text)`` in a working directory that holds toy.py and c.py."""
    folder = tmp_path / "cwd"
    folder.mkdir()
    monkeypatch.chdir(folder)
    (folder / "toy.py").write_text(TOY)
    (folder / "c.py").write_text(CONFIG)

    def make(name: str, text: str) -> Path:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(textwrap.dedent(text))
        return Path(name)

    return make


@pytest.fixture
def fluxvla(capsys: pytest.CaptureFixture[str]) -> Fluxvla:
    """Run a command in this process."""

    def run(*words: str) -> Ended:
        capsys.readouterr()
        code = main(words)
        out, err = capsys.readouterr()
        return Ended(code, out, err)

    return run


@pytest.fixture
def run(fluxvla: Fluxvla, write: Write) -> Fluxvla:
    """``fluxvla run --plugin toy.py`` with more words; registrations do not pile up."""

    def call(*words: str) -> Ended:
        for registry in BY_NAME.values():
            for name in ("ToyDataset", "ToyOperator", "ToyTrainRunner", "ToyEvalRunner"):
                registry.unregister(name)
        return fluxvla("run", "--plugin", "toy.py", *words)

    return call
