"""Small runs of the base class in this process."""

from __future__ import annotations

from pathlib import Path

from fluxvla_core.build import RunContext, build_runner_from_cfg
from fluxvla_core.contracts.runner import SilentReporter
from fluxvla_core.testing.training import (
    TinyDataset,
    tiny_config,
)


class Said(SilentReporter):
    def __init__(self):
        self.lines, self.steps, self.artifacts = [], [], []

    def info(self, text):
        self.lines.append(text)

    def warn(self, text):
        self.lines.append(f"warning: {text}")

    def progress(self, name, done, total, **fields):
        self.steps.append((name, done, total, fields))

    def artifact(self, kind, path):
        self.artifacts.append((kind, path.name))


def make(work_dir, resume=None, batch=4, model=None, reporter=None, hooks=None, **settings):
    table = {"type": "OneProcessRunner", **settings}
    if "max_epochs" not in settings:
        table.setdefault("max_steps", 6)
    config = tiny_config(table, batch, **(model or {}))
    if hooks:
        config["hooks"] = hooks
    context = RunContext(
        config=config,
        section="runner",
        work_dir=Path(work_dir),
        resume=resume,
        reporter=reporter or Said(),
    )
    return build_runner_from_cfg(config["runner"], context)


def run(work_dir, resume=None, length=37, **settings):
    runner = make(work_dir, resume, **settings)
    runner.run_setup(length)
    runner.run(TinyDataset(length))
    return runner
