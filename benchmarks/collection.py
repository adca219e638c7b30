"""Benchmarks collecting demonstrations and evaluating policies in simulation.

    python -m benchmarks.collection [--rounds 3] [--episodes 8]

Three comparisons; in each the sides take turns, so that other work on the machine slows them alike,
and the figure is the median over the rounds:

- an image without shadows and multisampling against one as the model file asks for it (also in
  processor time, which other work disturbs less);
- collecting with two worker processes against one, and one against gym-aloha's own environment,
  which draws three 480 x 640 images after every step;
- evaluating through the engine (processes, evaluation log) against the same episodes in a bare
  loop.

Loading libraries and the scene is left out everywhere. Writes
``benchmarks/results/collection.json``.
"""

from __future__ import annotations

import os
import shutil
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("MUJOCO_GL", "egl")
os.environ.setdefault("LP_NUM_THREADS", "1")

from fluxvla_sim.aloha.cube import MAX_STEPS, AlohaScene
from fluxvla_sim.environment import AlohaSimEnvironment
from fluxvla_sim.expert import SimExpert

from benchmarks import _results
from fluxvla_core.contracts.runner import SilentReporter
from fluxvla_core.evaluation.collect import demonstrate
from fluxvla_core.evaluation.episodes import EpisodeKey, open_eval_log
from fluxvla_core.evaluation.policies import PolicySource
from fluxvla_core.evaluation.pool import WorkerPool
from fluxvla_core.evaluation.rollout import RolloutSettings, run_episode
from fluxvla_core.evaluation.worker import EpisodeWorker, Settings, run_in_pool
from fluxvla_core.spec import Camera

CAMERA = Camera("top", 144, 192)
IMAGES = 10


def rendering() -> dict[str, Callable[[], tuple[float, float]]]:
    """Wall and processor milliseconds of one image, cheap and as the model file asks."""

    def side(quality: str) -> Callable[[], tuple[float, float]]:
        scene = AlohaScene(quality)
        scene.reset(0)
        scene.render(CAMERA.name, CAMERA.height, CAMERA.width)

        def measure() -> tuple[float, float]:
            wall, cpu = time.perf_counter(), time.process_time()
            for _ in range(IMAGES):
                scene.render(CAMERA.name, CAMERA.height, CAMERA.width)
            taken = time.perf_counter() - wall, time.process_time() - cpu
            return 1e3 * taken[0] / IMAGES, 1e3 * taken[1] / IMAGES

        return measure

    return {"cheap": side("cheap"), "reference": side("reference")}


class Demonstrate:
    """A worker that collects: one demonstration a job, its frames sent back."""

    def __call__(self) -> Callable[[int], Any]:
        environment = AlohaSimEnvironment(ends_with_success=False)
        expert, tasks = SimExpert(), environment.spec.tasks[:2]
        return lambda seed: demonstrate(environment, expert, tasks[seed % 2], seed, [CAMERA])[0]


def collecting(workers: int, episodes: int) -> float:
    """Control steps a second."""
    with WorkerPool(Demonstrate(), workers) as pool:
        for _ in pool.run(range(workers)):  # every worker is up, and has drawn
            continue
        began = time.perf_counter()
        for _ in pool.run(range(episodes)):
            continue
        return episodes * MAX_STEPS / (time.perf_counter() - began)


def stock(steps: int = 4) -> float:
    """Steps a second of gym-aloha's own environment."""
    import gym_aloha  # noqa: F401 - registers it
    import gymnasium

    env = gymnasium.make(
        "gym_aloha/AlohaTransferCube-v0", obs_type="pixels_agent_pos", disable_env_checker=True
    )
    observation, _ = env.reset(seed=0)
    env.unwrapped.step(observation["agent_pos"])
    began = time.perf_counter()
    for _ in range(steps):
        env.unwrapped.step(observation["agent_pos"])
    return steps / (time.perf_counter() - began)


def evaluating(workers: int, episodes: int) -> tuple[float, float]:
    """Episodes a minute through the engine, and in a bare loop in this process."""
    rollout = RolloutSettings(replan_every=5)
    settings = Settings(
        environment={"type": "AlohaSimEnvironment"},
        tasks=("lift_hold",),
        sources={"policy": PolicySource({"type": "SimExpert"})},
        rollout=rollout,
    )
    keys = [EpisodeKey("policy", "lift_hold", seed) for seed in range(episodes)]
    folder = Path(tempfile.mkdtemp())
    with WorkerPool(partial(EpisodeWorker, settings), workers) as pool:
        for _ in pool.run([EpisodeKey("policy", "lift_hold", 10**6)] * workers):
            continue
        log = open_eval_log(folder / "episodes.jsonl", {}, SilentReporter())
        began = time.perf_counter()
        run_in_pool(pool, keys, log, SilentReporter())
        engine = time.perf_counter() - began
    shutil.rmtree(folder)
    environment, expert = AlohaSimEnvironment(), SimExpert()
    task = environment.spec.task("lift_hold")
    run_episode(environment, expert, task, 10**6, rollout)
    began = time.perf_counter()
    for key in keys:
        run_episode(environment, expert, task, key.seed, rollout)
    bare = time.perf_counter() - began
    return 60 * episodes / engine, 60 * episodes / bare


def main() -> int:
    """Measure, print and write."""
    parser = _results.options(__file__)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--episodes", type=int, default=8)
    args = parser.parse_args()
    begun = _results.head("fluxvla-sim", "mujoco", "gym-aloha")
    rounds, episodes = range(args.rounds), args.episodes
    sides = rendering()
    drawn = [{name: measure() for name, measure in sides.items()} for _ in rounds]
    speed = [{n: collecting(n, episodes) for n in (1, 2)} for _ in rounds]
    own = [stock() for _ in rounds]
    evaluated = [evaluating(1, episodes) for _ in rounds]
    both = [evaluating(2, episodes)[0] for _ in rounds]
    middle = statistics.median
    summary = {
        **begun,
        "rounds": args.rounds,
        "image_ms": {n: round(middle(d[n][0] for d in drawn), 1) for n in sides},
        "image_cpu_ms": {n: round(middle(d[n][1] for d in drawn), 1) for n in sides},
        "cheap_images_times_faster": round(
            middle(d["reference"][1] / d["cheap"][1] for d in drawn), 1
        ),
        "collection_steps_per_s": {n: round(middle(s[n] for s in speed)) for n in (1, 2)},
        "two_workers_times_faster": round(middle(s[2] / s[1] for s in speed), 2),
        "gym_aloha_steps_per_s": round(middle(own), 1),
        "one_worker_times_faster_than_gym_aloha": round(
            middle(s[1] / o for s, o in zip(speed, own, strict=True))
        ),
        "evaluation_episodes_per_min": {
            "engine, 1 worker": round(middle(e for e, _ in evaluated)),
            "engine, 2 workers": round(middle(both)),
            "bare loop": round(middle(b for _, b in evaluated)),
        },
        "engine_share_of_bare_loop": round(middle(e / b for e, b in evaluated), 2),
    }
    _results.keep(args.out, summary)
    return 0


if __name__ == "__main__":
    sys.exit(main())
