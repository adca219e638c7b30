"""Benchmarks real-time chunking of a flow-matching policy: inference delays of 0 to 300 ms.

    python -m benchmarks.rtc [--checkpoint work_dirs/aloha_sim_pi05_tiny] [--episodes 10]

The tiny PI0.5 of ``configs/aloha_sim_pi05_tiny.py`` hands the cube over in the simulated ALOHA. It
is queried every 0.5 s and answers after a delay, simulated as in ``chunk_joining.py``. In
each row another joiner goes from one chunk to the next: the new one replaces the old one
(``latest_only``), is faded in (``overlap``), averaged with it (``temporal_ensemble``) or continues
it by guidance in every denoising step (``rtc``; a policy that was trained with
``prefix_conditioning`` continues as it was trained to). Figures of a row, over all its episodes:
successes with their 95 % Wilson interval; seconds until done; ``gap_rad``, how far the first action
of a chunk that is not over when the chunk arrives lies from where the chunk before it would have
been by then, mean and largest over the joins (of the joint that differs most); the largest step of
the joined target from one command to the next; acceleration and jerk of the commands (rms over the
arms' joints); and the share of late chunks, for which the arm had to wait.
Writes ``benchmarks/results/rtc.json``.
"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from benchmarks import _results
from benchmarks.chunk_joining import ARM_COLUMNS, HZ, commands, drive
from fluxvla_core.checkpoints.checkpoint import Checkpoint
from fluxvla_core.control.chunks import Chunk
from fluxvla_core.control.joiners import STREAMED
from fluxvla_core.errors import SafetyStop
from fluxvla_core.evaluation.success_rates import wilson_interval
from fluxvla_core.policies.loading import find_checkpoint, load_policy

WAYS = tuple(STREAMED)
DELAYS = (0.0, 0.05, 0.1, 0.2, 0.3)
Array = npt.NDArray[np.float64]


def chunks_of(events: list[dict[str, Any]]) -> list[tuple[Chunk, float]]:
    """The chunks of an episode's record, each with the time of its arrival."""
    sent = [(row["t"], row["command"]) for row in events if row["event"] == "command"]
    found = []
    for row in events:
        if row["event"] == "chunk":
            actions = np.array(row["keyframes"])
            before = [command for at, command in sent if at <= row["observed"]]
            anchor = np.array(before[-1]) if before else actions[0]
            found.append((Chunk(actions, row["rate_hz"], row["observed"], anchor), row["t"]))
    return found


def gap(old: Chunk, new: Chunk, arrived: float) -> float | None:
    """How far the first action of ``new`` that is to come lies from ``old``; None beyond its end.

    In rad, of the arms' joint that differs most.
    """
    row = int((arrived - new.observed) * new.rate_hz + 1e-6)
    elapsed = new.observed + (row + 1) / new.rate_hz - old.observed
    if row >= len(new.actions) or not old.reaches(elapsed):
        return None
    apart: Array = np.abs(new.actions[row] - old.at(elapsed))[ARM_COLUMNS]
    return float(apart.max())


def late(events: list[dict[str, Any]]) -> list[bool]:
    """For each chunk but the first whether the arm had to wait for it."""
    held = [row["t"] for row in commands(events) if row.get("held")]
    arrivals = [arrived for _, arrived in chunks_of(events)]
    return [any(one <= at < other for at in held) for one, other in pairwise(arrivals)]


def figures(events: list[dict[str, Any]]) -> dict[str, Any]:
    """What is measured in one episode; ``gaps`` and ``late`` have an entry a join."""
    wanted, sent = (
        np.array([row[key] for row in commands(events)])[:, ARM_COLUMNS]
        for key in ("wanted", "command")
    )
    joins = pairwise(chunks_of(events))
    gaps = [gap(old, new, arrived) for (old, _), (new, arrived) in joins]
    return {
        "gaps": [each for each in gaps if each is not None],
        "late": late(events),
        "largest_step_rad": float(np.abs(np.diff(wanted, axis=0)).max()),
        "acceleration_rms": float(np.sqrt(np.square(np.diff(sent, 2, axis=0) * HZ**2).mean())),
        "jerk_rms": float(np.sqrt(np.square(np.diff(sent, 3, axis=0) * HZ**3).mean())),
    }


def measured(checkpoint: Path, way: str, delay: float, episodes: int) -> dict[str, Any]:
    """One row of the results; an episode that the safety layer ends is no success."""
    torch.set_num_threads(1)
    policy = load_policy(checkpoint)
    found, successes, seconds, stopped = [], 0, [], 0
    for seed in range(episodes):
        try:
            result, events = drive(policy, way, delay, seed)
        except SafetyStop:
            stopped += 1
            continue
        found.append(figures(events))
        if result["success"]:
            successes += 1
            seconds.append(result["steps"] / HZ)
    gaps = [each for one in found for each in one["gaps"]]
    waited = [each for one in found for each in one["late"]]
    row = {
        "delay_s": delay,
        "chunk_joining": way,
        "episodes": episodes,
        "successes": successes,
        "interval": [round(end, 3) for end in wilson_interval(successes, episodes)],
        "stopped": stopped,
        "seconds": mean(seconds),
        "gap_rad": mean(gaps),
        "largest_gap_rad": max(gaps, default=None),
        "largest_step_rad": max((one["largest_step_rad"] for one in found), default=None),
        "acceleration_rms": mean([one["acceleration_rms"] for one in found]),
        "jerk_rms": mean([one["jerk_rms"] for one in found]),
        "late": mean(waited),
    }
    print(", ".join(f"{key} {_short(value)}" for key, value in row.items()), flush=True)
    return row


def mean(values: list[Any]) -> float | None:
    """None of nothing."""
    return float(np.mean(values)) if values else None


def main() -> None:
    parser = _results.options(__file__)
    parser.add_argument("--checkpoint", type=Path, default="work_dirs/aloha_sim_pi05_tiny")
    parser.add_argument("--episodes", type=int, default=10, help="for each row")
    parser.add_argument("--delays", type=float, nargs="+", default=DELAYS, help="in seconds")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    arguments = parser.parse_args()
    begun = _results.head("fluxvla-pi", "fluxvla-sim", "torch", "mujoco")
    checkpoint = find_checkpoint(None, arguments.checkpoint)
    # Simulated time: how fast a process is changes nothing.
    with ProcessPoolExecutor(arguments.workers, get_context("spawn")) as pool:
        asked = [
            pool.submit(measured, checkpoint, way, delay, arguments.episodes)
            for delay in arguments.delays
            for way in WAYS
        ]
        rows = [each.result() for each in asked]
    begun["step"] = Checkpoint.open(checkpoint).step
    _results.keep(arguments.out, {**begun, "rows": rows}, show=False)


def _short(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    main()
