"""One side of ``evaluation.py``: control steps a second in gym-aloha's transfer task.

    python _evaluation_side.py engine|bare|vector|lerobot PROCESSES STEPS EPISODES RENDER

Prints JSON. ``lerobot`` runs in an environment of its own and imports nothing of the rest. Every
side has one thread a process, looks at the top camera in 480 x 640 at each step, and commands the
pose that it sees: a policy that costs nothing. Episodes are cut off after STEPS steps; what is
built and loaded before the first of them is left out.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

TASK = "transfer_cube"
HEIGHT, WIDTH = 480, 640


def engine(processes: int, steps: int, episodes: int, render: str) -> dict[str, Any]:
    """The evaluation engine: workers, evaluation log, records."""
    from fluxvla_core.contracts.runner import SilentReporter
    from fluxvla_core.evaluation.episodes import EpisodeKey
    from fluxvla_core.evaluation.eval_log import open_eval_log
    from fluxvla_core.evaluation.policies import PolicySource
    from fluxvla_core.evaluation.pool import WorkerPool
    from fluxvla_core.evaluation.rollout import RolloutSettings, Settings
    from fluxvla_core.evaluation.runner import run_in_pool
    from fluxvla_core.plugins.registry import load_plugin_files

    load_plugin_files([__file__])
    settings = Settings(
        environment={"type": "AlohaSimEnvironment", "render": render},
        tasks=(TASK,),
        sources={"policy": PolicySource({"type": "Still"})},
        rollout=RolloutSettings(max_steps=steps),
    )
    keys = [EpisodeKey("policy", TASK, seed) for seed in range(episodes)]
    warm = [EpisodeKey("policy", TASK, 10**6 + n) for n in range(processes)]
    with WorkerPool(_Worker(settings), processes) as pool, tempfile.TemporaryDirectory() as folder:
        for _ in pool.run(warm):
            continue
        log = open_eval_log(Path(folder) / "episodes.jsonl", {}, SilentReporter())
        began, own = time.perf_counter(), time.process_time()
        records = run_in_pool(pool, keys, log, SilentReporter())
        seconds, own = time.perf_counter() - began, time.process_time() - own
    assert all(record["steps"] == steps for record in records)
    memory = max(record["timing"]["memory_mb"] for record in records)
    cpu = own + sum(record["cpu_s"] for record in records)
    return {**_pace(steps * episodes, seconds, cpu), "worker_mb": memory}


def _pace(steps: int, seconds: float, cpu: float) -> dict[str, float]:
    return {"steps_per_s": steps / seconds, "cpu_ms_per_step": 1e3 * cpu / steps}


class _Worker:
    def __init__(self, settings: Any) -> None:
        self.settings = settings

    def __call__(self) -> Any:
        from fluxvla_core.evaluation.rollout import EpisodeWorker

        work, ended = EpisodeWorker(self.settings), time.process_time()

        def measured(key: Any) -> Any:
            nonlocal ended
            record, before = work(key), ended
            ended = time.process_time()
            # Since the last episode's end: what it takes to send and to wait is in it.
            return {**record, "cpu_s": ended - before}

        return measured


def bare(processes: int, steps: int, episodes: int, render: str) -> dict[str, Any]:
    """The same environment in a loop, in as many processes, with nothing around it."""
    context = multiprocessing.get_context("spawn")
    ready, go = context.Barrier(processes + 1), context.Barrier(processes + 1)
    share, spent = episodes // processes, context.SimpleQueue()
    workers = [
        context.Process(target=_loop, args=(n, share, steps, render, ready, go, spent))
        for n in range(processes)
    ]
    for worker in workers:
        worker.start()
    ready.wait()
    began = time.perf_counter()
    go.wait()
    cpu = sum(spent.get() for _ in workers)
    seconds = time.perf_counter() - began
    for worker in workers:
        worker.join()
    return _pace(steps * share * processes, seconds, cpu)


def _loop(
    first: int, episodes: int, steps: int, render: str, ready: Any, go: Any, spent: Any
) -> None:
    from fluxvla_sim.environment import AlohaSimEnvironment

    from fluxvla_core.spec import Camera

    environment = AlohaSimEnvironment(render=render)
    cameras = [Camera("top", HEIGHT, WIDTH)]

    def episode(seed: int) -> None:
        environment.reset(seed, TASK)
        for _ in range(steps):
            environment.observe(cameras)
            environment.step(environment.state)

    episode(10**6 + first)  # as the engine's workers have done one before the clock starts
    ready.wait()
    go.wait()
    before = time.process_time()
    for seed in range(first * episodes, (first + 1) * episodes):
        episode(seed)
    spent.put(time.process_time() - before)
    os._exit(0)


class _Single:
    """Makes, in a process of the vector environment, the engine's scene as one of Gymnasium's."""

    def __init__(self, steps: int, render: str) -> None:
        self.steps, self.render = steps, render

    def __call__(self) -> Any:
        import gymnasium
        import numpy as np
        from fluxvla_sim.environment import AlohaSimEnvironment

        from fluxvla_core.spec import Camera

        camera, limit = Camera("top", HEIGHT, WIDTH), self.steps
        environment = AlohaSimEnvironment(render=self.render)

        class Single(gymnasium.Env[Any, Any]):
            observation_space = gymnasium.spaces.Dict(
                {
                    "qpos": gymnasium.spaces.Box(-np.inf, np.inf, (14,), np.float32),
                    "top": gymnasium.spaces.Box(0, 255, (HEIGHT, WIDTH, 3), np.uint8),
                }
            )
            action_space = gymnasium.spaces.Box(-np.inf, np.inf, (14,), np.float32)

            def reset(self, *, seed: Any = None, options: Any = None) -> Any:
                super().reset(seed=seed)
                self.left = limit
                environment.reset(int(self.np_random.integers(2**31)), TASK)
                return self._seen(), {}

            def step(self, action: Any) -> Any:
                found = environment.step(np.asarray(action, np.float64))
                self.left -= 1
                return self._seen(), found.reward, False, self.left == 0, {}

            def _seen(self) -> Any:
                seen = environment.observe((camera,))
                return {"qpos": seen["qpos"], "top": seen["images"]["top"]}

        return Single()


def vector(processes: int, steps: int, episodes: int, render: str) -> dict[str, Any]:
    """``gymnasium.vector.AsyncVectorEnv`` over the engine's scene: one camera, equal images."""
    from gymnasium.vector import AsyncVectorEnv, AutoresetMode

    env = AsyncVectorEnv(
        [_Single(steps, render)] * processes,
        context="spawn",
        autoreset_mode=AutoresetMode.DISABLED,
    )
    rounds = max(1, episodes // processes)
    env.reset(seed=10**6)
    pids = [child.pid for child in multiprocessing.active_children() if child.pid is not None]
    began, before = time.perf_counter(), time.process_time() + sum(map(_cpu_s, pids))
    for number in range(rounds):
        seen, _ = env.reset(seed=[number * processes + n for n in range(processes)])
        ended = [False]
        while not any(ended):
            seen, _, _, ended, _ = env.step(seen["qpos"])
    seconds = time.perf_counter() - began
    cpu = time.process_time() + sum(map(_cpu_s, pids)) - before
    memory = max(map(_peak_mb, pids))
    env.close()
    return {**_pace(steps * rounds * processes, seconds, cpu), "worker_mb": memory}


def lerobot(processes: int, steps: int, episodes: int, render: str) -> dict[str, Any]:
    """``lerobot-eval``'s own rollout over its asynchronous vector environment."""
    import torch
    from lerobot.envs.configs import AlohaEnv
    from lerobot.envs.factory import make_env
    from lerobot.scripts import lerobot_eval

    # 0.4.4 looks for each environment's task in ``env.envs``, which asynchronous ones do not have:
    # its command can only use them one after the other. With these two it gets its processes.
    lerobot_eval.check_env_attributes_and_types = lambda env: None
    lerobot_eval.add_envs_task = lambda env, observation: observation

    class Still(torch.nn.Module):
        def reset(self) -> None:
            return

        def select_action(self, observation: Any) -> Any:
            return observation["observation.state"]

    def same(values: Any) -> Any:
        return values

    torch.set_num_threads(1)
    config = AlohaEnv(task="AlohaTransferCube-v0", episode_length=steps)
    env = make_env(config, n_envs=processes, use_async_envs=True)["aloha"][0]
    env.reset(seed=list(range(processes)))
    rounds = max(1, episodes // processes)
    pids = [child.pid for child in multiprocessing.active_children() if child.pid is not None]
    began, before = time.perf_counter(), time.process_time() + sum(map(_cpu_s, pids))
    for number in range(rounds):
        seeds = [number * processes + n for n in range(processes)]
        found = lerobot_eval.rollout(env, Still(), same, same, same, same, seeds=seeds)
        assert found["done"].shape == (processes, steps)
    seconds = time.perf_counter() - began
    cpu = time.process_time() + sum(map(_cpu_s, pids)) - before
    memory = max(map(_peak_mb, pids))
    env.close()
    return {**_pace(steps * rounds * processes, seconds, cpu), "worker_mb": memory}


def _cpu_s(pid: int) -> float:
    user, system = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


def _peak_mb(pid: int) -> float:
    lines = Path(f"/proc/{pid}/status").read_text(encoding="utf-8").splitlines()
    return next(round(int(line.split()[1]) / 1024, 1) for line in lines if line.startswith("VmHWM"))


SIDES = {"engine": engine, "bare": bare, "vector": vector, "lerobot": lerobot}


def main() -> int:
    side, processes, steps, episodes, render = sys.argv[1:]
    print(json.dumps(SIDES[side](int(processes), int(steps), int(episodes), render)))
    return 0


if __name__ == "__main__":
    sys.exit(main())

if __name__.startswith("fluxvla_plugin_"):
    # This file is also the plugin that brings the policy which costs nothing.
    from fluxvla_core import POLICIES

    @POLICIES.register_module()
    class Still:
        """Wants to be where it is."""

        cameras = ("top",)
        action_rate_hz = 50.0

        def reset(self, seed: int) -> None:
            return

        def predict_action(self, observation: Any) -> Any:
            return observation["qpos"][None]
