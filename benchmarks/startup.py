"""How long ``fluxvla --help`` and ``fluxvla plugins list`` take beside bare Python and LeRobot.

    python benchmarks/startup.py [--lerobot PATH/TO/lerobot-train] [--rounds 15]

The commands take turns, so that other work on the machine slows all of them alike; figures are
medians over the rounds. Goals: at most 100 ms more than bare Python, and at least 20 times faster
than ``lerobot-train --help`` (an environment of its own: LeRobot needs an older torch). Writes
``benchmarks/results/startup.json``.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

RESULTS = Path(__file__).with_name("results") / "startup.json"
MOST_EXTRA_MS = 100.0
LEAST_RATIO = 20.0


def measure(commands: dict[str, Sequence[str]], rounds: int) -> dict[str, list[float]]:
    """Milliseconds of each command in each round, after one round that fills caches.

    Raises:
        SystemExit: a command fails.
    """
    taken: dict[str, list[float]] = {name: [] for name in commands}
    for number in range(rounds + 1):
        for name, command in commands.items():
            began = time.perf_counter()
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            seconds = time.perf_counter() - began
            if done.returncode:
                sys.exit(f"{name} failed with {done.returncode}:\n{done.stderr[-2000:]}")
            if number:
                taken[name].append(seconds * 1e3)
    return taken


def summarise(taken: dict[str, list[float]]) -> dict[str, object]:
    """Medians and minima (ms), extra time over bare Python, ratios to LeRobot."""
    medians = {name: statistics.median(values) for name, values in taken.items()}
    bare = medians["python"]
    ours = [name for name in medians if name.startswith("fluxvla")]
    summary: dict[str, object] = {
        "median_ms": {name: round(value, 1) for name, value in medians.items()},
        "minimum_ms": {name: round(min(values), 1) for name, values in taken.items()},
        "extra_over_python_ms": {name: round(medians[name] - bare, 1) for name in ours},
        "goal_extra_ms": MOST_EXTRA_MS,
        "goal_extra_met": all(medians[name] - bare <= MOST_EXTRA_MS for name in ours),
    }
    if "lerobot-train --help" in medians:
        ratios = {name: medians["lerobot-train --help"] / medians[name] for name in ours}
        summary["times_faster_than_lerobot"] = {n: round(r, 1) for n, r in ratios.items()}
        summary["goal_times_faster"] = LEAST_RATIO
        summary["goal_times_faster_met"] = all(r >= LEAST_RATIO for r in ratios.values())
    return summary


def main() -> int:
    """Measure, print and write; 0 also when a goal is missed, for a benchmark is no test."""
    parser = argparse.ArgumentParser(allow_abbrev=False)
    parser.add_argument("--lerobot", type=Path, help="the lerobot-train of another environment")
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--out", type=Path, default=RESULTS)
    args = parser.parse_args()
    program = str(Path(sys.executable).with_name("fluxvla"))
    commands: dict[str, Sequence[str]] = {
        "python": [sys.executable, "-c", "pass"],
        "fluxvla --help": [program, "--help"],
        "fluxvla plugins list": [program, "plugins", "list"],
    }
    if args.lerobot:
        commands["lerobot-train --help"] = [str(args.lerobot), "--help"]
    summary = {
        "python": platform.python_version(),
        "machine": f"{platform.machine()}, {os.cpu_count()} CPUs",
        "rounds": args.rounds,
        **summarise(measure(commands, args.rounds)),
    }
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps(summary, indent=1) + "\n", encoding="utf-8")
    print(json.dumps(summary, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
