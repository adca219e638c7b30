"""Benchmarks policy evaluation against LeRobot's evaluation and against bare stepping.

    python -m benchmarks.evaluation [--rounds 3] [--checkpoint DIR]

gym-aloha's transfer task with a policy that costs nothing, in as many processes as there are cores
(at most 4), the top camera looked at in 480 x 640 at every step: the engine with stock images
(shadows, multisampling) and with its own cheap ones, ``lerobot-eval``'s rollout over its
asynchronous vector environments, Gymnasium's asynchronous vector environment around the engine's
own scene, and the engine's environment in a bare loop in as many processes. Renderer (EGL), MuJoCo
and resolution are the same on all sides. LeRobot's environment always draws three cameras where the
others draw one, so most of ``times_lerobot`` is images that nobody looks at;
``times_gymnasium_vector`` compares equal images, and is what the engine itself is worth. LeRobot
is given the processes that its own command cannot use. The sides take turns;
figures are medians over the rounds. An episode is 300 steps. Where the machine is shared, ratios of
processor time say more than those of rates.

With ``--checkpoint`` also: a model in each worker against one model for all of them, in batches.

Goals: 1.5 times LeRobot's episodes a minute with stock images, 0.9 of bare stepping. Writes
``benchmarks/results/evaluation.json``.
"""

from __future__ import annotations

import json
import os
import statistics
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchmarks import _lerobot, _results
from tools import rendering, shell

SIDE = Path(__file__).with_name("_evaluation_side.py")
EPISODE = 300
NEEDS = ("gym-aloha==0.1.5", "mujoco==3.3.0")
"""The simulator, in addition to what LeRobot itself imports."""
KEYS = {"engine, stock images": "times_lerobot", "engine": "times_lerobot_cheap_images"}
GOALS = {"times_lerobot": 1.5, "share_of_bare": 0.9}
# side -> words of _evaluation_side.py: side, steps, episodes for each process, images
SIDES = {
    "lerobot": ("lerobot", 20, 1, "reference"),
    "gymnasium.vector, stock images": ("vector", 20, 2, "reference"),
    "engine, stock images": ("engine", 20, 2, "reference"),
    "engine": ("engine", 100, 2, "cheap"),
    "bare": ("bare", 100, 2, "cheap"),
}


def measure(python: Path | str, words: Mapping[str, Any], variables: Mapping[str, str]) -> Any:
    """One side's figures."""
    threads = {"OMP_NUM_THREADS": "1", **rendering.VARIABLES}
    command = [python, SIDE, *map(str, words.values())]
    output = shell.run(command, env={**variables, **threads}, quiet=True, echo=False)
    return json.loads(output.strip().splitlines()[-1])


def placements(checkpoint: str, workers: int, episodes: int) -> dict[str, float]:
    """Control steps a second of a checkpoint's policy: in each worker, or one for all of them."""
    from fluxvla_core.build import RunContext
    from fluxvla_core.evaluation.runner import EvalRunner

    found = {}
    for serve in (False, True):
        for batch in (1, 4) if serve else (1,):
            with tempfile.TemporaryDirectory() as folder:
                runner = EvalRunner(
                    context=RunContext(work_dir=Path(folder), section="eval"),
                    environment={"type": "AlohaSimEnvironment"},
                    ckpt_path=checkpoint,
                    tasks=["lift_hold"],
                    episodes=episodes,
                    replan_every=5,
                    workers=workers,
                    batch_size=batch,
                    serve_policy=serve,
                    record_videos=0,
                )
                runner.run_setup()
                name = f"one model, batches of {batch}" if serve else "a model in each worker"
                found[name] = round(runner.run()["timing"]["steps_per_s"], 1)
    return found


def main() -> int:
    """Measure, print and write."""
    parser = _results.options(__file__)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--processes", type=int, default=min(4, os.cpu_count() or 1))
    parser.add_argument("--checkpoint", metavar="DIR")
    args = parser.parse_args()
    begun = _results.head("mujoco", "numpy")
    pythons: dict[str, tuple[Path | str, dict[str, str]]] = {}
    env = _lerobot.prepared(*NEEDS, folder="lerobot-eval")
    if env is not None:
        pythons["lerobot"] = (env.python, {**os.environ, **env.variables()})
    runs: dict[str, list[Any]] = {}
    for _ in range(args.rounds):
        for name, (side, steps, each, render) in SIDES.items():
            if side == "lerobot" and side not in pythons:
                continue
            python, variables = pythons.get(side, (sys.executable, dict(os.environ)))
            words = {
                "side": side,
                "processes": args.processes,
                "steps": steps,
                "episodes": each * args.processes,
                "render": render,
            }
            runs.setdefault(name, []).append(measure(python, words, variables))
            print(f"{name}: {runs[name][-1]}", file=sys.stderr)
    pace = {n: statistics.median(r["steps_per_s"] for r in found) for n, found in runs.items()}
    cost = {n: statistics.median(r["cpu_ms_per_step"] for r in found) for n, found in runs.items()}
    shares = [
        engine["steps_per_s"] / bare["steps_per_s"]
        for engine, bare in zip(runs["engine"], runs["bare"], strict=True)
    ]
    figures: dict[str, Any] = {
        "share_of_bare": round(statistics.median(shares), 3),
        "share_of_bare_by_cpu": round(cost["bare"] / cost["engine"], 3),
    }
    own, theirs = "engine, stock images", "gymnasium.vector, stock images"
    figures["times_gymnasium_vector"] = round(pace[own] / pace[theirs], 2)
    figures["times_gymnasium_vector_by_cpu"] = round(cost[theirs] / cost[own], 2)
    if "lerobot" in runs:
        for name, key in KEYS.items():
            figures[key] = round(pace[name] / pace["lerobot"], 2)
            figures[f"{key}_by_cpu"] = round(cost["lerobot"] / cost[name], 2)
    summary = {
        **begun,
        **_lerobot.versions(env),
        "processes": args.processes,
        "cameras_drawn": {name: 3 if name == "lerobot" else 1 for name in runs},
        "rounds": args.rounds,
        "steps_per_s": {name: round(value, 2) for name, value in pace.items()},
        "steps_per_s_by_round": {
            name: [round(r["steps_per_s"], 2) for r in found] for name, found in runs.items()
        },
        "cpu_ms_per_step": {name: round(value, 1) for name, value in cost.items()},
        "episodes_per_min": {n: round(60 * value / EPISODE, 2) for n, value in pace.items()},
        "worker_mb": {
            name: max(r["worker_mb"] for r in found)
            for name, found in runs.items()
            if "worker_mb" in found[0]
        },
        **figures,
        "goals": GOALS,
        "goals_met": {n: figures[n] >= goal for n, goal in GOALS.items() if n in figures},
    }
    if args.checkpoint:
        summary["policy_steps_per_s"] = placements(args.checkpoint, args.processes, 8)
    _results.keep(args.out, summary)
    return 0


if __name__ == "__main__":
    sys.exit(main())
