"""Benchmarks the data path (samples/s) against LeRobot's ``LeRobotDataset``, on the same files.

    python -m benchmarks.data_path [--rounds 3] [--seconds 4] [--episodes 4] [--frames 100]

Makes two datasets of version 3.0 (three cameras of 480 x 640 in mp4; and none) and reads each at
random through both sides' loaders, in batches of 8 with chunks of 50 actions, with 0 and 2
workers. The sides take turns, each in its own environment (``tools/lerobot_env.py`` makes
LeRobot's) with as many threads as it takes by itself: without workers, FluxVLA decodes with
several. Figures are medians over the rounds. Where the machine is shared, ratios of processor time
(without workers) say more than those of rates. FluxVLA's images stay uint8, LeRobot's become
float32, for that is what each hands to training. Goals: 3 times LeRobot's rate with video, 5 times
without. Writes ``benchmarks/results/data_path.json``.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import _lerobot, _results
from benchmarks._data_path_side import CAMERAS, FPS, KINDS

SIDE = Path(__file__).with_name("_data_path_side.py")
GOALS = {"mp4": 3.0, "parquet": 5.0}
JOINTS = 14
HEIGHT, WIDTH = 480, 640


def make_datasets(folder: Path, episodes: int, frames: int) -> None:
    """``mp4`` and ``parquet`` below ``folder``: textured images that move, smooth joints."""
    from fluxvla_core.data.writer import LeRobotWriter
    from fluxvla_core.spec import Camera, EmbodimentSpec, Joint

    joints = tuple(Joint(f"joint_{i}", "rad", -3.0, 3.0, 2.0, 4.0) for i in range(JOINTS))
    scene = make_scene()
    for kind in KINDS:
        cameras = tuple(Camera(c, HEIGHT, WIDTH) for c in CAMERAS) if kind == "mp4" else ()
        spec = EmbodimentSpec("bench", joints, cameras, float(FPS))
        with LeRobotWriter(folder / kind, FPS, spec) as writer:
            for episode in range(episodes):
                for t in range(frames):
                    state = np.sin(np.arange(JOINTS) + 0.05 * t + episode)
                    images = {
                        c.name: draw(scene, t, i + 3 * episode) for i, c in enumerate(cameras)
                    }
                    writer.add_frame(images, state, state + 0.01, "hold the cube")
                writer.save_episode()


def make_scene() -> np.ndarray:
    """A texture of several scales with a little grain, ``(HEIGHT, 2 * WIDTH, 3)`` uint8."""
    rng = np.random.default_rng(0)
    image = rng.normal(120, 1.5, (HEIGHT, 2 * WIDTH, 3))
    for size, contrast in ((80, 40), (20, 25), (5, 8)):
        coarse = rng.uniform(-contrast, contrast, (HEIGHT // size, 2 * WIDTH // size, 3))
        image += coarse.repeat(size, axis=0).repeat(size, axis=1)
    return image.clip(0, 255).astype(np.uint8)


def draw(scene: np.ndarray, t: int, which: int) -> np.ndarray:
    """A still scene with an arm's worth of pixels that move through it."""
    image = scene[:, 31 * which : 31 * which + WIDTH].copy()
    left = (5 * t + 97 * which) % (WIDTH - 160)
    image[160:320, left : left + 160] = scene[:160, ::2][:, left : left + 160][::-1]
    return image


def measure(
    side: str, python: str | Path, folder: Path, seconds: float, env: dict[str, str]
) -> Any:
    """One run of one side. Raises SystemExit if it fails."""
    done = subprocess.run(
        [python, SIDE, side, folder, str(seconds)],
        env={**os.environ, **env},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        sys.exit(f"{side} failed with {done.returncode}:\n{done.stderr[-3000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def summarise(runs: Mapping[str, list[Any]]) -> dict[str, Any]:
    """Medians and single rounds of each side, and the ratios with their goals."""
    every = {side: table(found, "samples_per_s") for side, found in runs.items()}
    rates = {side: medians(found) for side, found in every.items()}
    busy = {side: medians(table(found, "cpu_ms")) for side, found in runs.items()}
    alone = [name for name in rates["fluxvla"] if name.endswith(" 0 workers")]
    summary: dict[str, Any] = {
        "median_samples_per_s": rates,
        "samples_per_s": every,
        "cpu_ms_per_sample": {s: {n: found[n] for n in alone} for s, found in busy.items()},
        "batch": {s: {n: r["batch"] for n, r in f[0]["rates"].items()} for s, f in runs.items()},
        "versions": {side: found[0]["versions"] for side, found in runs.items()},
    }
    if "lerobot" in rates:
        times = {n: round(r / rates["lerobot"][n], 2) for n, r in rates["fluxvla"].items()}
        cpu = {n: round(busy["lerobot"][n] / busy["fluxvla"][n], 2) for n in alone}
        summary["times_lerobot"] = times
        summary["times_lerobot_by_cpu"] = cpu
        summary["goals"] = GOALS
        summary["goals_met"] = {n: r >= GOALS[n.partition(",")[0]] for n, r in times.items()}
    return summary


def table(runs: Sequence[Any], figure: str) -> dict[str, list[float]]:
    """One figure of each measurement, round by round."""
    return {name: [round(r["rates"][name][figure], 3) for r in runs] for name in runs[0]["rates"]}


def medians(found: Mapping[str, Sequence[float]]) -> dict[str, float]:
    return {name: round(statistics.median(values), 3) for name, values in found.items()}


def main() -> int:
    """Measure, print and write; 0 also when a goal is missed, for a benchmark is not a test."""
    parser = _results.options(__file__)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=4.0, help="of each measurement, at least")
    parser.add_argument("--episodes", type=int, default=4)
    parser.add_argument("--frames", type=int, default=100, help="of an episode")
    args = parser.parse_args()
    begun = _results.head()
    sides: dict[str, tuple[str | Path, dict[str, str]]] = {"fluxvla": (sys.executable, {})}
    env = _lerobot.prepared()
    if env is not None:
        sides["lerobot"] = (env.python, env.variables())
    runs: dict[str, list[Any]] = {side: [] for side in sides}
    with tempfile.TemporaryDirectory() as folder:
        make_datasets(Path(folder), args.episodes, args.frames)
        for _ in range(args.rounds):
            for side, (python, variables) in sides.items():
                runs[side].append(measure(side, python, Path(folder), args.seconds, variables))
    summary = {
        **begun,
        "dataset": f"{args.episodes} episodes of {args.frames} frames, {len(CAMERAS)} cameras "
        f"{HEIGHT} x {WIDTH}, h264",
        "rounds": args.rounds,
        **summarise(runs),
    }
    _results.keep(args.out, summary)
    return 0


if __name__ == "__main__":
    sys.exit(main())
