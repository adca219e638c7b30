"""``fluxvla wandb``: send the evaluations of a work dir, with their videos."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from fluxvla_core.errors import UsageError
from fluxvla_wandb.runs import MODES, open_run, place, video

FOLDERS = ("eval", "eval_live", "eval_robot")
"""Folders of a work dir that have a ``results.json``: simulated, real-time, on a robot."""
FORMAT = "fluxvla-eval-1"


class WandbCommand:
    """Logs success rates and videos to the W&B run of a work dir, beside a training's metrics."""

    api = "1.0"
    help = (
        "Send the evaluations of a work dir to Weights & Biases: success rates and videos, into "
        "the run that its training's tracker has written to."
    )

    def add_arguments(self, parser: Any) -> None:
        parser.add_argument("work_dir", metavar="WORK_DIR", type=Path)
        parser.add_argument("--project", metavar="NAME", help="WANDB_PROJECT, or fluxvla")
        parser.add_argument("--mode", choices=MODES, help="WANDB_MODE, or online")

    def run(self, args: argparse.Namespace) -> int:
        found = evaluations(args.work_dir)
        if not found:
            raise UsageError(
                f"{args.work_dir} has no evaluation: no {', '.join(FOLDERS)} with a results.json",
                next="fluxvla run with a section that evaluates writes one",
            )
        run = open_run(args.work_dir, args.project, args.mode)
        for name, results in found.items():
            run.log({**rates(name, results), **_videos(name, results, args.work_dir / name)})
        run.finish()
        print(f"{', '.join(found)} of {args.work_dir} went to {place(run)}")
        return 0


def evaluations(work_dir: Path) -> dict[str, dict[str, Any]]:
    """Folder -> the ``results.json`` of each evaluation in a work dir.

    Raises:
        UsageError: one is no evaluation's results.
    """
    found = {}
    for name in FOLDERS:
        path = work_dir / name / "results.json"
        if not path.is_file():
            continue
        try:
            results = json.loads(path.read_text(encoding="utf-8"))
        except ValueError as error:
            raise UsageError(f"{path} is no JSON: {error}") from error
        if not isinstance(results, dict) or results.get("format") != FORMAT:
            raise UsageError(f"{path} is not of the format {FORMAT}, which this version reads")
        found[name] = results
    return found


def rates(name: str, results: dict[str, Any]) -> dict[str, float]:
    """``<folder>/<group>/<task>`` -> success rate, of groups and tasks with episodes."""
    shown = {}
    for group, counted in results["groups"].items():
        for task, rate in {**counted["tasks"], "all": counted["all"]}.items():
            if rate["rate"] is not None:
                shown[f"{name}/{group}/{task}"] = float(rate["rate"])
    return shown


def _videos(name: str, results: dict[str, Any], folder: Path) -> dict[str, Any]:
    """``<folder>/videos/<number>`` -> video, of those that are there still."""
    shown = {}
    for number, row in enumerate(results["videos"]):
        path = folder / row["path"]
        if path.is_file():
            word = "success" if row["success"] else "no success"
            caption = f"{row['group']} {row['task']}, seed {row['seed']}: {word}"
            shown[f"{name}/videos/{number}"] = video(path, caption)
    return shown
