"""Benchmarks a whole training in samples/s: ``fluxvla run`` and ``lerobot-train``, ACT on the demo.

    python -m benchmarks.end_to_end [--rounds 5] [--steps 10] [--workers 0] [--fps 10]

Collects demonstrations as the demo does (simulated ALOHA, top camera, 144 x 192, mp4) and trains
LeRobot's ``act`` in its default size on them with both commands, as a user would: the same files,
image size, batch, loader workers, chunk, optimizer and clipping, in fp32 on the CPU, nothing
pretrained. ``_act_model.py`` is the same network; that both give equal actions, losses and
gradients with equal weights is checked first, and kept with the results. The sides take turns;
figures are medians over the rounds of the rate over the steps after the first ``--warm-up``, by
each side's own record of its steps (LeRobot: ``updt_s`` and ``data_s`` of its log).

Our side runs twice: as the model is, and computing also the actions that lie beyond the episode's
end (``all actions``), as LeRobot does. The second ratio is what loop, data path, optimizer and
operations gain alone; the first is what a user sees on this dataset, whose episodes are shorter
than a chunk. Goal: 1.5 times LeRobot's rate. Writes ``benchmarks/results/end_to_end.json``.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from benchmarks import _act_agreement, _lerobot, _results

MODEL = Path(__file__).with_name("_act_model.py")
GOAL = 1.5
LEROBOT, OURS, ALL = "lerobot", "fluxvla", "fluxvla, all actions"
# Everything is computed in fp32 by the same network; what is done otherwise than there.
OTHERWISE = {
    ALL: "data path; fused AdamW; frozen batch norms folded into convolutions; attention gives no "
    "weights back; one token, the one that is used, of the action encoder's last layer",
    OURS: "the same; actions beyond the episode's end are not computed",
}
IMAGENET = {"means": [[123.675, 116.28, 103.53]], "stds": [[58.395, 57.12, 57.375]]}
LEARNING_RATE, WEIGHT_DECAY, MAX_NORM = 1e-5, 1e-4, 10.0
LOGGED = re.compile(r"\bstep:(\S+) .*\bupdt_s:([\d.]+) data_s:([\d.]+)")


@dataclass(frozen=True)
class Course:
    """What both sides do."""

    steps: int = 10
    warm_up: int = 2
    batch: int = 8
    workers: int = 0
    chunk: int = 100

    @property
    def whole(self) -> int:
        return self.warm_up + self.steps


@dataclass(frozen=True)
class Step:
    """Seconds of one step, and those of them that it waited for its batch."""

    seconds: float
    waited: float


def collect(root: Path, episodes: int, fps: int) -> None:
    """Demonstrations as ``fluxvla collect aloha`` makes them."""
    words = ["--episodes", str(episodes), "--fps", str(fps)]
    run([program("fluxvla"), "collect", "aloha", "--out", str(root), *words], {})


def program(name: str) -> str:
    return str(Path(sys.executable).with_name(name))


def run(command: Sequence[str], variables: Mapping[str, str]) -> str:
    """What a command says, on either stream. Raises SystemExit if it fails."""
    done = subprocess.run(
        command,
        env={**os.environ, **variables},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    if done.returncode:
        sys.exit(f"{Path(command[0]).name} failed with {done.returncode}:\n{done.stdout[-3000:]}")
    return done.stdout


def our_config(root: Path, course: Course, skip: bool) -> dict[str, Any]:
    """The config tree of our side."""
    transforms = [
        {"type": "NormalizeImages", **IMAGENET},
        {"type": "NormalizeStatesAndActions", "norm_type": "mean_std", "std_floor": 1e-8},
    ]
    return {
        "model": {"type": "BenchACT", "chunk": course.chunk, "skip_padding": skip},
        "train_dataloader": {
            "per_device_batch_size": course.batch,
            "per_device_num_workers": course.workers,
            "dataset": {
                "type": "ParquetDataset",
                "data_root_path": str(root),
                "img_keys": ["top"],
                "action_window_size": course.chunk,
                "transforms": transforms,
            },
        },
        "runner": {
            "type": "DDPTrainRunner",
            "max_steps": course.whole,
            "learning_rate": LEARNING_RATE,
            "weight_decay": WEIGHT_DECAY,
            "max_grad_norm": MAX_NORM,
            "device": "cpu",
            "collator": {
                "type": "DictCollator",
                "keys": ["images", "states", "actions", "action_masks", "sample_ids"],
                "meta_keys": ["img_masks", "task_description", "info", "timestamp"],
            },
        },
    }


def train_ours(root: Path, course: Course, skip: bool, folder: Path) -> list[Step]:
    """``fluxvla run``; its steps by ``metrics.jsonl``."""
    config, work = folder / "config.json", folder / "work"
    tree = our_config(root, course, skip)
    folder.mkdir()
    config.write_text(
        json.dumps({"format": "fluxvla-config-1", "config": tree, "origins": {}}), encoding="utf-8"
    )
    words = ["--config", config, "--section", "runner", "--work-dir", work, "--plugin", MODEL]
    run([program("fluxvla"), "run", *map(str, words)], {})
    found = our_steps((work / "metrics.jsonl").read_text(encoding="utf-8"))
    shutil.rmtree(work)  # its last checkpoint, which LeRobot does not write, is large
    return found


def our_steps(text: str) -> list[Step]:
    """Of ``metrics.jsonl``."""
    found = [json.loads(line) for line in text.splitlines()]
    return [Step(r["step_time"], r["step_time"] * r["data_wait"]) for r in found if "loss" in r]


def lerobot_words(root: Path, course: Course, out: Path) -> list[str]:
    """The words after ``lerobot-train``; what is not said here is its default."""
    settings = {
        "dataset.repo_id": "bench/aloha",
        "dataset.root": root,
        "policy.type": "act",
        "policy.device": "cpu",
        "policy.push_to_hub": "false",
        "policy.pretrained_backbone_weights": "null",
        "policy.chunk_size": course.chunk,
        "policy.n_action_steps": course.chunk,
        "output_dir": out,
        "batch_size": course.batch,
        "num_workers": course.workers,
        "steps": course.whole,
        "log_freq": 1,
        "save_checkpoint": "false",
        "eval_freq": 0,
        "wandb.enable": "false",
    }
    return [f"--{name}={value}" for name, value in settings.items()]


def lerobot_steps(text: str) -> list[Step]:
    """Of what ``lerobot-train`` logs, which it may do into its progress bar's line."""
    found = [(float(m[2]), float(m[3])) for m in LOGGED.finditer(text.replace("\r", "\n"))]
    return [Step(update + data, data) for update, data in found]


def rate(steps: Sequence[Step], course: Course) -> dict[str, float]:
    """Samples a second after the warm-up, and the share of the time that batches were waited for.

    Raises:
        ValueError: it did not do all its steps.
    """
    if len(steps) != course.whole:
        raise ValueError(f"{len(steps)} steps are on record, and there should be {course.whole}")
    kept = steps[course.warm_up :]
    seconds = sum(step.seconds for step in kept)
    return {
        "samples_per_s": course.batch * len(kept) / seconds,
        "data_wait": sum(step.waited for step in kept) / seconds,
    }


def summarise(runs: Mapping[str, Sequence[Mapping[str, float]]]) -> dict[str, Any]:
    """Medians, single rounds, and ratios to LeRobot as medians of the rounds' ratios."""
    rates = {side: [r["samples_per_s"] for r in found] for side, found in runs.items()}
    waits = {side: [r["data_wait"] for r in found] for side, found in runs.items()}
    summary: dict[str, Any] = {
        "median_samples_per_s": {s: round(statistics.median(v), 3) for s, v in rates.items()},
        "samples_per_s": {s: [round(r, 3) for r in v] for s, v in rates.items()},
        "data_wait_share": {s: round(statistics.median(v), 4) for s, v in waits.items()},
    }
    if LEROBOT in rates:
        ratios = {
            side: statistics.median(a / b for a, b in zip(found, rates[LEROBOT], strict=True))
            for side, found in rates.items()
            if side != LEROBOT
        }
        summary["times_lerobot"] = {side: round(ratio, 2) for side, ratio in ratios.items()}
        summary["goal"] = GOAL
        summary["goal_met"] = {side: ratio >= GOAL for side, ratio in ratios.items()}
    return summary


def main() -> int:
    """Measure, print and write; 0 also when the goal is missed, for a benchmark is not a test."""
    parser = _results.options(__file__)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--episodes", type=int, default=16, help="to collect")
    parser.add_argument("--fps", type=int, default=10, help="of the demonstrations")
    for name, value in asdict(Course()).items():
        parser.add_argument(f"--{name.replace('_', '-')}", type=int, default=value)
    args = parser.parse_args()
    course = Course(args.steps, args.warm_up, args.batch, args.workers, args.chunk)
    begun = _results.head("fluxvla-ddp", "torch", "av", "numpy")
    env = _lerobot.prepared()
    sides = [OURS, ALL] if env is None else [LEROBOT, OURS, ALL]
    runs: dict[str, list[dict[str, float]]] = {side: [] for side in sides}
    with tempfile.TemporaryDirectory() as name:
        folder, root = Path(name), Path(name) / "dataset"
        collect(root, args.episodes, args.fps)
        same = {} if env is None else {"same_model": _act_agreement.check(env, root, folder)}
        for number in range(args.rounds):
            for side in sides:
                out = folder / f"{number} {side}"
                if env is not None and side == LEROBOT:
                    words = lerobot_words(root, course, out)
                    said = run([str(env.bin / "lerobot-train"), *words], env.variables())
                    steps = lerobot_steps(said)
                else:
                    steps = train_ours(root, course, side == OURS, out)
                runs[side].append(rate(steps, course))
                print(f"{side}: {runs[side][-1]}", file=sys.stderr, flush=True)
        info = json.loads((root / "meta" / "info.json").read_text(encoding="utf-8"))
    summary = {
        **begun,
        **_lerobot.versions(env),
        "what": "samples a second of training ACT in LeRobot's default size, fp32, CPU",
        "dataset": {
            **{key: info[key] for key in ("total_episodes", "total_frames", "fps")},
            "top": info["features"]["observation.images.top"]["shape"],
        },
        **asdict(course),
        "threads": torch.get_num_threads(),
        "rounds": args.rounds,
        "otherwise_than_lerobot": OTHERWISE,
        **same,
        **summarise(runs),
    }
    _results.keep(args.out, summary)
    return 0


if __name__ == "__main__":
    sys.exit(main())
