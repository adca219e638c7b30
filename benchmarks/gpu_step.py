"""A training step of a model of pi0.5's size (3.35 B parameters) on GPUs: rate, MFU, memory.

    python -m benchmarks.gpu_step [--batch 16] [--nproc 1] [--recompute] [--compile] [--profile]
    python -m benchmarks.gpu_step --size tiny --device cpu     the same in seconds, no figures kept

``--family pi05`` and ``gr00t`` measure the models of ``fluxvla-pi`` and ``fluxvla-gr00t`` instead
(any size but ``tiny`` is the published one), and write a file of their own. GR00T looks for the
places of its images in each prompt: its operations cannot be counted, and there is no MFU.

``FSDPTrainRunner`` against a torch loop written by hand: the same model (``_pi05_model.py``),
random batches made on the host (images as uint8), bf16 compute over fp32 weights, fused AdamW
and clipping. By hand one process has plain autocast; several have ``fully_shard``. The sides take
turns as processes of their own (``--rounds``), each of which measures ``--blocks`` blocks of
``--steps`` steps after a warm-up; the hand-written loop waits for the device at the ends of a block
only. Figures are medians over blocks, the ratio the median over the rounds.

Operations are those that the runner counts for its ``mfu``: forward and backward pass as PaLM has
it, without recomputing; padding counts. ``--profile`` also writes where a step's time goes, to
``gpu_step.profile.txt``. Goals on one H200: 25 samples/s and an MFU above 35 %. Writes
``benchmarks/results/gpu_step.json``, and nothing where there is no GPU.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from benchmarks import _results
from benchmarks._gpu_step_sides import BENCH, FAMILIES, HAND, OURS, Setup, measure
from benchmarks._pi05_model import ATTENTION, SIZES
from fluxvla_core.testing.training import run_ranks
from fluxvla_core.training import cost

RATE_GOAL, MFU_GOAL = 25.0, 0.35
LONGEST_S = 3600.0
_WHAT = {BENCH: "a model of pi0.5's size", "pi05": "PI05FlowMatching", "gr00t": "GR00T N1.5"}
Found = Mapping[str, Any]


def summarise(runs: Mapping[str, Sequence[Found]], setup: Setup) -> dict[str, Any]:
    """Medians of each side, their ratio, and whether the goals are met.

    Args:
        runs: what the first process of each round found, by side.
    """
    ours = runs[OURS][0]
    samples, counted = setup.batch * setup.nproc, ours.get("flops")
    sides = {}
    for side, rounds in runs.items():
        seconds = statistics.median(s for found in rounds for s in found["step_s"])
        shares = [share for found in rounds for share in found.get("mfu", ())]
        if not shares and counted is not None:
            shares = [counted / seconds / ours["peak_flops"]]
        sides[side] = {
            "samples_per_s": samples / seconds,
            "step_s": seconds,
            "steps_s": [found["step_s"] for found in rounds],
            "mfu": statistics.median(shares) if shares else None,
            "peak_memory_gb": max(found["peak_bytes"] for found in rounds) / cost.GB,
            "last_loss": rounds[-1]["last_loss"],
        }
    pairs = zip(runs[HAND], runs[OURS], strict=True)
    ratios = [statistics.median(a["step_s"]) / statistics.median(b["step_s"]) for a, b in pairs]
    summary = {
        "device": ours["device"],
        "tflop_per_sample": None if counted is None else counted / setup.batch / 1e12,
        "sides": sides,
        "rate_of_runner_to_by_hand": statistics.median(ratios),
    }
    mfu = sides[OURS]["mfu"]
    if setup.size == "pi05" and setup.family != "gr00t" and "H200" in ours["device"]:
        summary["goals"] = {"samples_per_s_of_a_gpu": RATE_GOAL, "mfu": MFU_GOAL}
        summary["goals_met"] = {
            "samples_per_s_of_a_gpu": setup.batch / sides[OURS]["step_s"] >= RATE_GOAL,
            "mfu": mfu is not None and mfu > MFU_GOAL,
        }
    return summary


def rounded(value: Any) -> Any:
    """Five digits of every number are enough to read."""
    if isinstance(value, float):
        return float(f"{value:.5g}")
    if isinstance(value, Mapping):
        return {key: rounded(inner) for key, inner in value.items()}
    return [rounded(inner) for inner in value] if isinstance(value, list) else value


def missing(setup: Setup) -> str | None:
    """Why this cannot be measured here."""
    gpus = 0 if setup.device == "cpu" else torch.cuda.device_count()
    if setup.device == "cpu" or gpus >= setup.nproc:
        return None
    return f"{gpus} GPUs for {setup.nproc} processes" if gpus else "no GPU"


def options() -> argparse.ArgumentParser:
    """Every field of :class:`Setup` is an option."""
    parser = _results.options(__file__)
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--profile", action="store_true", help="where a step's time goes, as text")
    choices = {"family": FAMILIES, "size": SIZES, "device": ("cuda", "cpu"), "attention": ATTENTION}
    for name, value in asdict(Setup()).items():
        word = f"--{name.replace('_', '-')}"
        if isinstance(value, bool):
            parser.add_argument(word, action="store_true")
        else:
            kind = float if value is None else type(value)
            parser.add_argument(word, type=kind, default=value, choices=choices.get(name))
    return parser


def alternate(setup: Setup, rounds: int, profile: bool) -> tuple[dict[str, list[Found]], str]:
    """What each side found in each round, and the profile of ours if it is wanted."""
    runs: dict[str, list[Found]] = {OURS: [], HAND: []}
    table = ""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "found.json"
        for number in range(rounds):
            for side in runs if number % 2 == 0 else reversed(runs):
                wanted = profile and side == OURS and number == 0
                codes = run_ranks(setup.nproc, measure, side, setup, wanted, out, timeout=LONGEST_S)
                if any(codes):
                    sys.exit(f"gpu_step: {side} failed with {codes}")
                found = json.loads(out.read_text())
                table = found.pop("profile", table)
                runs[side].append(found)
                print(f"{side}: {rounded(found)}", file=sys.stderr, flush=True)
    return runs, table


def main(words: Sequence[str] | None = None) -> int:
    """Measure, print and write; 0 also when a goal is missed, for a benchmark is not a test.

    Without a GPU that is said: bad surroundings (2) for who asked for something, and nothing to
    fail for (0) where every benchmark is run as it is.
    """
    words = sys.argv[1:] if words is None else words
    parser = options()
    args = parser.parse_args(words)
    setup = Setup(**{name: getattr(args, name) for name in asdict(Setup())})
    full = setup.size == "pi05"
    if full and setup.device == "cpu":
        parser.error("on a CPU only the tiny size can be run: --size tiny --device cpu")
    why = missing(setup)
    if why is not None:
        print(f"gpu_step: {why}: not measured (--size tiny --device cpu shows that it runs)")
        return 2 if words else 0
    begun = _results.head("fluxvla-fsdp", "torch", "numpy")
    runs, table = alternate(setup, args.rounds, args.profile)
    model = setup.built("meta")
    summary = {
        **begun,
        "what": f"a training step of {_WHAT[setup.family]}, bf16 over fp32 weights",
        "cuda": torch.version.cuda,
        "parameters": sum(p.numel() for p in model.parameters()),
        **asdict(setup),
        "rounds": args.rounds,
        **rounded(summarise(runs, setup)),
    }
    default = args.out == parser.get_default("out")
    if not full and default:  # a tiny model's figures are not results
        print(json.dumps(summary, indent=1), table, sep="\n")
        return 0
    if default and setup.family != BENCH:
        args.out = args.out.with_stem(f"{args.out.stem}_{setup.family}")
    _results.keep(args.out, summary)
    if table:
        args.out.with_suffix(".profile.txt").write_text(table + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
