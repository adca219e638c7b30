"""``fluxvla bench-policy``: how long a policy takes to answer, stage by stage."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fluxvla_core import atomic
from fluxvla_core.cli.parser import Parser, add_overrides, add_plugin_files, natural, positive
from fluxvla_core.cli.reporters import heartbeat
from fluxvla_core.cli.terminal import say
from fluxvla_core.config.load import load_config
from fluxvla_core.config.overrides import apply_overrides
from fluxvla_core.errors import UsageError
from fluxvla_core.plugins.files import load_plugin_files

if TYPE_CHECKING:
    from fluxvla_core.policies.local import LocalPolicy

_MODES = ("eager", "compiled")


class BenchPolicy:
    api = "1.0"
    help = (
        "Measure how long a policy takes from observation to chunk, by stage: that of a "
        "checkpoint, or that of a config with random weights. Observations are random, from --seed."
    )

    def add_arguments(self, parser: Parser) -> None:
        parser.once("--config", metavar="FILE", help="a config; the weights are random")
        parser.once("--checkpoint", metavar="DIR", help="a checkpoint or a work dir instead")
        parser.once(
            "--embodiment",
            metavar="FILE",
            help="the robot of a config without inference.operator: an embodiment.json, or a "
            "dataset's or checkpoint's folder with one",
        )
        parser.once("--task", default="pick up the cube", metavar="TEXT", help="the instruction")
        parser.once("--device", default="cpu", help="a torch device, default cpu")
        parser.once(
            "--precision", default="float32", choices=("float32", "bf16"), help="default float32"
        )
        parser.once("--threads", type=positive, metavar="N", help="of torch; its own choice")
        parser.once(
            "--modes",
            default="eager",
            metavar="LIST",
            help="of eager and compiled (each block by torch.compile), measured one after the "
            "other; default eager",
        )
        parser.once("--calls", type=positive, default=50, metavar="N", help="default 50")
        parser.once("--warmup", type=natural, default=5, metavar="N", help="default 5")
        parser.once("--seed", type=natural, default=0, metavar="N", help="default 0")
        parser.once(
            "--peak-tflops", type=float, metavar="X", help="of the device, to compute its share"
        )
        parser.once("--json", metavar="FILE", help="write the figures there, too")
        add_overrides(parser)
        add_plugin_files(parser)

    def run(self, args: argparse.Namespace) -> int:
        modes = _modes(args.modes)
        if (args.config is None) == (args.checkpoint is None):
            raise UsageError("give either --config FILE or --checkpoint DIR")
        if args.peak_tflops is not None and not 0 < args.peak_tflops < float("inf"):
            raise UsageError(f"--peak-tflops {args.peak_tflops:g} is no number of operations")
        load_plugin_files(args.plugin_files)
        with heartbeat("building the policy"):
            policy = _policy(args)
        figures = _figures(policy, modes, args)
        for line in table(figures):
            say(line)
        if args.json is not None:
            path = Path(args.json)
            path.parent.mkdir(parents=True, exist_ok=True)
            atomic.write_json(path, figures)
        return 0


def _modes(text: str) -> list[str]:
    modes = text.split(",")
    unknown = [mode for mode in modes if mode not in _MODES]
    if unknown:
        raise UsageError(f"--modes: {unknown[0]!r} is none of {', '.join(_MODES)}")
    # A model that is compiled stays so.
    return sorted(set(modes), key=_MODES.index)


def _policy(args: argparse.Namespace) -> LocalPolicy:
    import torch

    from fluxvla_core.policies.benchmark import untrained_policy
    from fluxvla_core.policies.loading import load_policy
    from fluxvla_core.training.foreign import embodiment_in

    if args.threads is not None:
        torch.set_num_threads(args.threads)
    if args.checkpoint is not None:
        return load_policy(
            args.checkpoint, device=args.device, mixed_precision_dtype=args.precision
        )
    config = apply_overrides(load_config(args.config), args.overrides)
    robot = None if args.embodiment is None else embodiment_in(args.embodiment)
    return untrained_policy(config.tree, robot, args.device, args.precision, args.seed)


def _figures(policy: LocalPolicy, modes: Sequence[str], args: argparse.Namespace) -> dict[str, Any]:
    from fluxvla_core.policies import benchmark
    from fluxvla_core.training.model import compile_units

    observations = benchmark.random_observations(policy, args.task, args.seed)
    parameters = sum(p.numel() for p in policy.model.parameters())
    found: dict[str, Any] = {
        "model": type(policy.model).__name__,
        "parameters": parameters,
        "weights": policy.source,
        "cameras": {c.name: [c.height, c.width] for c in policy.embodiment.cameras},
        "horizon": policy.horizon,
        "precision": args.precision,
        "seed": args.seed,
        "calls": args.calls,
        "warmup": args.warmup,
        **benchmark.machine(args.device),
        "modes": {},
    }
    operations = benchmark.inference_flops(policy, observations[0])
    peak, origin = benchmark.peak_tflops(args.device, args.precision, args.peak_tflops)
    found |= {"gflops": round(operations / 1e9, 3)}
    found |= {"peak_tflops": round(peak, 4), "peak_is": origin}
    for mode in modes:
        if mode == "compiled":
            compile_units(policy.model)
        with heartbeat(f"{mode}: {args.warmup + args.calls} calls"):
            seconds = benchmark.measure(policy, observations, args.calls, args.warmup)
        found["modes"][mode] = seconds.to_dict()
        inference_s = found["modes"][mode]["inference"]["p50_ms"] / 1e3
        share = operations / (inference_s * peak * 1e12)
        found["modes"][mode]["share_of_peak"] = round(share, 4)
    return found


def table(figures: Mapping[str, Any]) -> list[str]:
    """The figures for people, a line a stage."""
    lines = [
        f"{figures['model']}: {figures['parameters'] / 1e6:.1f} M parameters, "
        f"{figures['precision']}, {figures['gflops']:g} GFLOP an answer; "
        f"{figures['device']}, {figures['threads']} threads"
    ]
    for mode, found in figures["modes"].items():
        lines.append(f"{mode:12}{'p50':>10}{'p95':>10}{'p99':>10}  ms")
        for stage in ("preprocess", "inference", "postprocess", "total"):
            row = "".join(f"{found[stage][f'p{p}_ms']:10.2f}" for p in (50, 95, 99))
            lines.append(f"  {stage:10}{row}")
        lines.append(
            f"  {found['hz']:g} Hz, first call {found['first_call_s']:.2f} s, "
            f"{found['memory_mb']:.0f} MB, {found['share_of_peak']:.1%} of the peak of "
            f"{figures['peak_tflops']:g} TFLOP/s ({figures['peak_is']})"
        )
    return lines
