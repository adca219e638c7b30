"""Small runs of the base class that validate, in this process."""

from __future__ import annotations

import json
from pathlib import Path

from fluxvla_core.build import RunContext, build_runner_from_cfg
from fluxvla_core.testing.training import Notes, TinyDataset, tiny_config
from fluxvla_core.training.validation import Validation


class Held(TinyDataset):
    """Samples 100 to 106."""

    def __init__(self, length=7):
        super().__init__(length)

    def get_sample(self, index, epoch):
        return super().get_sample(100 + index, epoch)


def make(work_dir, resume=None, val=None, model=None, **settings):
    table = {"type": "OneProcessRunner", "max_steps": 8, "max_keep_ckpts": 0, **settings}
    config = tiny_config(table, **(model or {}))
    config["val_dataloader"] = {"dataset": Held()} if val is None else val
    context = RunContext(
        config=config,
        section="runner",
        work_dir=Path(work_dir),
        resume=resume,
        reporter=Notes(Path(work_dir)),
    )
    return build_runner_from_cfg(config["runner"], context)


def run(work_dir, resume=None, **settings):
    runner = make(work_dir, resume, **settings)
    runner.run_setup(37)
    runner.run(TinyDataset())
    return runner


def losses(work_dir):
    rows = [json.loads(line) for line in (work_dir / "metrics.jsonl").open()]
    return {row["step"]: row["val_loss"] for row in rows if "val_loss" in row}


def best_of(work_dir):
    found = losses(work_dir)
    return min(found, key=found.get)


def says(monkeypatch, **losses):
    """Let the validation of ``step_N`` say its loss."""
    monkeypatch.setattr(Validation, "loss", lambda _, *parts: losses[f"step_{parts[-1]}"])
