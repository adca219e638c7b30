"""A work dir as training, evaluation and inference leave it, with numbers made up."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fluxvla_core.evaluation.results_file import summarise
from fluxvla_core.evaluation.success_rates import rate
from fluxvla_core.robot.recording.video import VideoWriter

JOINTS = [f"{side}_{name}" for side in ("left", "right") for name in ("waist", "elbow", "gripper")]
TASKS = ("lift_hold", "transfer_cube")
RATES = {"policy": 0.85, "swapped": 0.05, "untrained": 0.0}


def write_lines(path: Path, rows: list[dict[str, Any]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")


def write_json(path: Path, content: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content), encoding="utf-8")


def video(path: Path, brightness: int) -> None:
    with VideoWriter(path, 10.0, 48, 64) as writer:
        for step in range(10):
            writer.add(np.full((48, 64, 3), brightness + 5 * step, np.uint8))


def training(work_dir: Path, steps: int = 300) -> None:
    noise = np.random.default_rng(0).normal(1.0, 0.1, steps)
    rows = [
        {
            "step": step,
            "epoch": step / 100,
            "loss": 1.5 * math.exp(-step / 80) * noise[step - 1] + 0.05,
            "lr": 1e-3 * min(1, step / 20) * (1 - step / (steps + 1)),
            "grad_norm": 2.0 * math.exp(-step / 100) * noise[step - 1] + 0.2,
            "step_time": 0.25,
            "samples_per_s": 256 * noise[step - 1],
            "data_wait": 0.01,
        }
        for step in range(1, steps + 1)
    ]
    write_lines(work_dir / "metrics.jsonl", rows)


def evaluation(work_dir: Path, episodes: int = 20) -> None:
    records: list[dict[str, Any]] = []
    videos: list[dict[str, Any]] = []
    for group, share in RATES.items():
        for task in TASKS:
            for number in range(episodes):
                success = number < round(share * episodes)
                key = {"group": group, "task": task, "seed": 500 + number, "success": success}
                records.append({**key, "status": "done", "steps": 250})
                shown = (0, episodes - 1) if group == "policy" else (0,) if task == TASKS[0] else ()
                if number in shown:
                    path = f"videos/{group}-{task}-{500 + number}.mp4"
                    videos.append({**key, "path": path})
                    video(work_dir / "eval" / path, 20 + number)
    results = {
        "format": "fluxvla-eval-1",
        "policy": "checkpoint",
        "checkpoint": {"path": "checkpoints/step-000000300", "step": 300, "sha256": "0"},
        "settings": {"replan_every": 5, "dataset": None},
        "groups": summarise(records),
        "behaviours": {
            "policy": {"hold it": {"episodes": 20, "neither": 3, "lift_hold": 17}},
            "swapped": {"hand it over": {"episodes": 20, "neither": 1, "lift_hold": 1}},
        },
        "obeyed": {"policy": rate(34, 40), "swapped": rate(40, 40)},
        "provenance": {
            "date": "2026-01-02T03:04:05+00:00",
            "commit": "abc123",
            "versions": {"mujoco": "3.3.0"},
            "machine": "x86_64, 2 CPUs",
        },
        "videos": sorted(videos, key=lambda row: row["success"]),
        "timing": {
            "episodes": 120,
            "steps": 30_000,
            "seconds": 100.0,
            "steps_per_s": 300.0,
            "workers": 2,
            "policy_ms": 12.34,
        },
    }
    write_json(work_dir / "eval" / "results.json", results)


def inference(work_dir: Path, commands: int = 200) -> None:
    folder = work_dir / "inference" / "001-lift"
    joints = [{"name": name, "unit": "rad", "lower": -3.0, "upper": 3.0} for name in JOINTS]
    start = {"event": "start", "t": 99.9, "began": 1.7e9, "embodiment": {"joints": joints}}
    events: list[dict[str, Any]] = [
        {**start, "instruction": "lift the cube & hold it"},
        {"event": "chunk", "t": 100.0, "ms": {"policy": 12.0}},
    ]
    for number in range(commands):
        angle = [math.sin(number / 40 + joint) for joint in range(len(JOINTS))]
        clamp = {"joint": "left_waist", "wanted": 2.0, "given": angle[0], "reason": "velocity"}
        events.append(
            {
                "event": "command",
                "t": 100.0 + number * 0.02,
                "phase": "run",
                "wanted": angle,
                "command": angle,
                "state": [0.95 * value for value in angle],
                "clamps": [clamp] if 50 <= number < 53 else [],
            }
        )
    write_lines(folder / "trace.jsonl", events)
    timing = {"count": 200, "p50_ms": 0.2, "p95_ms": 0.5, "p99_ms": 0.9, "max_ms": 1.4}
    write_json(
        folder / "episode.json",
        {
            "task": "1",
            "instruction": "lift the cube & hold it",
            "outcome": "success",
            "success": True,
            "problem": None,
            "steps": commands,
            "chunks": 40,
            "robot": "AlohaSimOperator",
            "joints": JOINTS,
            "rate_hz": 50.0,
            "skipped_ticks": 0,
            "clamps": {"left_waist": {"velocity": 3}},
            "trips": [],
            "timings": {"policy": {**timing, "count": 40, "p50_ms": 11.3}, "late": timing},
        },
    )
    video(folder / "top.mp4", 80)


def surroundings(work_dir: Path, dataset: Path) -> None:
    config = {"train_dataloader": {"dataset": {"data_root_path": str(dataset)}}, "note": "<b>"}
    origins = {"note": "configs/two_arms.py:3"}
    write_json(work_dir / "config.resolved.json", {"config": config, "origins": origins})
    write_json(
        work_dir / "environment.json",
        {
            "format": "fluxvla-environment-1",
            "python": "3.11.7",
            "packages": {"torch": "2.13.0+cpu"},
            "plugins": [{"distribution": "fluxvla-aloha", "version": "0.1.0", "name": "A"}] * 2,
        },
    )
    info = {"codebase_version": "v3.0", "total_episodes": 240, "total_frames": 11280}
    write_json(dataset / "meta" / "info.json", {**info, "total_tasks": 2})
    joints = [{"name": name, "unit": "rad"} for name in JOINTS]
    write_json(work_dir / "checkpoints" / "step-000000300" / "embodiment.json", {"joints": joints})
    stages = [("install", 90.0), ("collect", 85.5), ("train", 601.0), ("evaluate", 130.0)]
    rows = [{"name": n, "seconds": s, "command": f"fluxvla {n}"} for n, s in stages]
    write_json(work_dir / "stages.json", {"stages": rows})


@pytest.fixture(scope="session")
def complete(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Not to be written to."""
    work_dir = tmp_path_factory.mktemp("complete") / "work"
    training(work_dir)
    evaluation(work_dir)
    inference(work_dir)
    surroundings(work_dir, work_dir.parent / "dataset")
    return work_dir
