"""The stages of the demo: which command each is, and what to do when it was begun before."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tools.demo.sizes import Size
from tools.torch_build import nvidia_gpus

CONFIG = Path("configs") / "aloha_sim_transfer.py"
TASKS = ("1", "2")
MEASURED_STEPS = 10


@dataclass(frozen=True)
class Places:
    """Where a demo keeps what it makes."""

    root: Path

    @property
    def dataset(self) -> Path:
        return self.root / "dataset"

    @property
    def work(self) -> Path:
        return self.root / "work"

    @property
    def speed(self) -> Path:
        return self.root / "speed"

    @property
    def report(self) -> Path:
        return self.root / "report.html"

    @property
    def journal(self) -> Path:
        return self.root / "journal.json"


@dataclass(frozen=True)
class Stage:
    """One command of the demo.

    Args:
        name: short, for the journal and the report.
        title: for people.
        command: program and arguments.
        resume: arguments that make a second start go on; None: it goes on, or may simply be
            done again, without any.
        clears: what is deleted before a start from nothing.
    """

    name: str
    title: str
    command: tuple[str, ...]
    resume: tuple[str, ...] = ()
    clears: tuple[Path, ...] = ()


def collect(size: Size, places: Places) -> Stage:
    """Demonstrations of the scripted expert."""
    words = ["fluxvla", "collect", "aloha", "--out", str(places.dataset)]
    words += ["--episodes", str(size.demonstrations), "--workers", str(cores())]
    title = f"collect {size.demonstrations} demonstrations of the scripted expert"
    return Stage("collect", title, tuple(words), ("--resume",), (places.dataset,))


def measure(size: Size, places: Places) -> Stage:
    """A few training steps, to see how many fit into the time there is."""
    words = _run(places, places.speed, size, "runner", MEASURED_STEPS)
    title = f"measure the speed of training over {MEASURED_STEPS} steps"
    return Stage("measure", title, words, ("--resume", "auto"), (places.speed,))


def train(size: Size, places: Places, steps: int) -> Stage:
    """The training itself."""
    words = _run(places, places.work, size, "runner", steps)
    title = f"train for {steps} steps in {processes()} process(es)"
    return Stage("train", title, words, ("--resume", "auto"), (places.work,))


def evaluate(size: Size, places: Places) -> Stage:
    """The trained policy, the same one with the wrong instruction, and an untrained one."""
    words = ["fluxvla", "run", "--config", str(CONFIG), "--section", "eval"]
    words += ["--work-dir", str(places.work), "--nproc", str(cores())]
    words += ["--set", f"eval.episodes={size.episodes}"]
    title = f"evaluate {size.episodes} evaluation seeds for each task and way of acting"
    return Stage("evaluate", title, tuple(words), (), (places.work / "eval",))


def robot(places: Places, task: str) -> Stage:
    """One episode through the simulated robot's operator, with its safety."""
    words = ["fluxvla", "run", "--config", str(CONFIG), "--section", "inference"]
    words += ["--work-dir", str(places.work), "--task", task]
    title = f"run instruction {task} on the simulated robot"
    return Stage(f"robot {task}", title, tuple(words))


def report(places: Places) -> Stage:
    """The page."""
    words = ("fluxvla", "report", str(places.work), "--out", str(places.report))
    return Stage("report", "write the report", (*words, "--title", "ALOHA, two instructions"))


def cores() -> int:
    """Processes for collection and evaluation; more than 8 gain little and need memory."""
    there = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return max(1, min(8, there or 1))


def processes() -> int:
    """Ranks that train: one for each GPU, at most 2, and 2 where there is none."""
    return min(2, nvidia_gpus()) or 2


def _run(places: Places, work_dir: Path, size: Size, section: str, steps: int) -> tuple[str, ...]:
    words = ["fluxvla", "run", "--config", str(CONFIG), "--section", section]
    words += ["--work-dir", str(work_dir), "--nproc", str(processes())]
    overrides: Sequence[str] = (
        f"train_dataloader.dataset.data_root_path={places.dataset}",
        f"runner.max_steps={steps}",
        *size.overrides,
    )
    for override in overrides:
        words += ["--set", override]
    return tuple(words)
