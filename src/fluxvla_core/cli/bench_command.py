"""``fluxvla bench-policy``: how long a policy takes to answer, stage by stage."""

from __future__ import annotations

import argparse
import shutil
import textwrap
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fluxvla_core import atomic
from fluxvla_core.cli.parser import Parser, add_overrides, add_plugin_files, natural, positive
from fluxvla_core.cli.reporters import heartbeat
from fluxvla_core.cli.terminal import say
from fluxvla_core.config.load import load_config
from fluxvla_core.config.overrides import apply_overrides
from fluxvla_core.errors import ConfigError, UsageError
from fluxvla_core.plugins.registry import load_plugin_files

if TYPE_CHECKING:
    from fluxvla_core.policies.local import LocalPolicy

_MODES = ("eager", "compiled", "graph")
_WIDTH, _COLUMN = 13, 22


class BenchPolicy:
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
            "--precision",
            default="float32",
            choices=("float32", "bf16"),
            help="dtype of the model, default float32",
        )
        parser.once(
            "--threads",
            type=positive,
            metavar="N",
            help="CPU threads of torch (default: torch's own)",
        )
        parser.once(
            "--modes",
            default="eager",
            metavar="LIST",
            help="of eager, compiled (each block by torch.compile) and graph (all denoising steps "
            "as one CUDA graph), measured one after the other; default eager",
        )
        parser.once(
            "--quantization",
            choices=("int8", "fp8", "fp8_dynamic"),
            help="of the blocks' linear layers, by torchao",
        )
        parser.once(
            "--calls", type=positive, default=50, metavar="N", help="measured calls, default 50"
        )
        parser.once(
            "--warmup", type=natural, default=5, metavar="N", help="calls before, default 5"
        )
        parser.once("--seed", type=natural, default=0, metavar="N", help="random seed, default 0")
        parser.once(
            "--peak-tflops", type=float, metavar="X", help="of the device, to compute its share"
        )
        parser.once("--json", metavar="FILE", help="write the figures there, too")
        parser.once(
            "--out",
            metavar="DIR",
            help="write the figures and the fixture there, for others to check: figures.json, "
            "inputs.npz, answers.npz, and the config",
        )
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
            policy, config = _policy(args)
        figures, arrays = _figures(policy, modes, args)
        for line in table(figures, shutil.get_terminal_size().columns):
            say(line)
        if args.json is not None:
            path = Path(args.json)
            path.parent.mkdir(parents=True, exist_ok=True)
            atomic.write_json(path, figures)
        if args.out is not None:
            _keep(Path(args.out), figures, arrays, config)
        return 0


def _modes(text: str) -> list[str]:
    modes = text.split(",")
    unknown = [mode for mode in modes if mode not in _MODES]
    if unknown:
        raise UsageError(f"--modes: {unknown[0]!r} is none of {', '.join(_MODES)}")
    # A model that is compiled stays so.
    return sorted(set(modes), key=_MODES.index)


def _policy(args: argparse.Namespace) -> tuple[LocalPolicy, Mapping[str, Any]]:
    """The policy, and the config that it was built from."""
    import torch

    from fluxvla_core.checkpoints.checkpoint import Checkpoint
    from fluxvla_core.policies.benchmark import untrained_policy
    from fluxvla_core.policies.loading import load_policy
    from fluxvla_core.training.export import embodiment_in

    if args.threads is not None:
        torch.set_num_threads(args.threads)
    if args.checkpoint is not None:
        policy = load_policy(
            args.checkpoint,
            device=args.device,
            mixed_precision_dtype=args.precision,
            quantization=args.quantization,
        )
        return policy, Checkpoint.open(args.checkpoint).config()
    tree = apply_overrides(load_config(args.config), args.overrides).tree
    robot = None if args.embodiment is None else embodiment_in(args.embodiment)
    settings = (args.device, args.precision, args.seed, args.quantization)
    return untrained_policy(tree, robot, *settings), tree


def _figures(
    policy: LocalPolicy, modes: Sequence[str], args: argparse.Namespace
) -> tuple[dict[str, Any], dict[str, Any]]:
    """The figures, and the fixture's arrays: ``inputs`` and ``answers``, by file."""
    from fluxvla_core.policies import benchmark

    observations = benchmark.random_observations(policy, args.task, args.seed)
    inputs = benchmark.fixture(observations)
    work = benchmark.inference_work(policy, observations[0])
    peak, origin = benchmark.peak_tflops(args.device, args.precision, args.peak_tflops)
    rate, rate_origin = benchmark.bandwidth_gb_s(args.device)
    operations = sum(part.flops for part in work.values())
    found: dict[str, Any] = {
        "model": type(policy.model).__name__,
        "parameters": sum(p.numel() for p in policy.model.parameters()),
        "weights": policy.source,
        "cameras": {c.name: [c.height, c.width] for c in policy.embodiment.cameras},
        "horizon": policy.horizon,
        "precision": args.precision,
        "quantization": args.quantization,
        "task": args.task,
        "seed": args.seed,
        "calls": args.calls,
        "warmup": args.warmup,
        "inputs_sha256": benchmark.digest(inputs),
        **benchmark.machine(args.device),
        "gflops": round(operations / 1e9, 3),
        "peak_tflops": round(peak, 4),
        "peak_is": origin,
        "bandwidth_gb_s": round(rate, 1),
        "bandwidth_is": rate_origin,
        "floor_ms": {
            stage: round(part.seconds(peak * 1e12, rate * 1e9) * 1e3, 3)
            for stage, part in work.items()
        },
        "modes": {},
    }
    chunks: dict[str, Any] = {}
    for mode in modes:
        try:
            policy.execute(mode)
        except ConfigError as error:
            if mode != "graph":
                raise
            found["modes"][mode] = {"not_run": error.what}
            continue
        with heartbeat(f"{mode}: {args.warmup + args.calls} calls"):
            seconds = benchmark.measure(policy, observations, args.calls, args.warmup)
            chunks[mode] = benchmark.answers(policy, observations)
        taken = seconds.to_dict()
        first = chunks[next(iter(chunks))]
        share = operations / (taken["inference"]["p50_ms"] / 1e3 * peak * 1e12)
        found["modes"][mode] = {
            **taken,
            "share_of_peak": round(share, 4),
            "apart": float(abs(chunks[mode] - first).max()),
        }
    found["answers_sha256"] = benchmark.digest(chunks)
    return found, {"inputs": inputs, "answers": chunks}


def _keep(
    folder: Path,
    figures: Mapping[str, Any],
    arrays: Mapping[str, Mapping[str, Any]],
    config: Mapping[str, Any],
) -> None:
    """What somebody else needs to check the figures, in ``folder``."""
    import numpy as np

    folder.mkdir(parents=True, exist_ok=True)
    for name, content in arrays.items():
        np.savez_compressed(folder / f"{name}.npz", **content)
    atomic.write_json(folder / "config.json", {"model": config["model"], **config})
    atomic.write_json(folder / "figures.json", figures)
    say(f"the fixture is in {folder}")


def table(figures: Mapping[str, Any], columns: int = 80) -> list[str]:
    """The figures for people: a line a stage, the modes side by side, or below where they are more
    than ``columns`` hold (80 hold three)."""
    versions = ", ".join(f"{n} {v}" for n, v in figures["versions"].items() if v is not None)
    modes, threads = figures["modes"], figures["threads"]
    run = [name for name, found in modes.items() if "not_run" not in found]
    beside = max(1, (columns - _WIDTH) // _COLUMN)
    before = [
        f"{figures['model']}: {figures['parameters'] / 1e6:.1f} M parameters, "
        f"{figures['precision']}, {figures['gflops']:g} GFLOP an answer; "
        f"{figures['device']}, {threads} thread{'s' * (threads != 1)}"
    ]
    rows: list[str] = []
    for first in range(0, len(run), beside):
        rows += _columns({name: modes[name] for name in run[first : first + beside]})
    floor = ", ".join(f"{stage} {ms:g} ms" for stage, ms in figures["floor_ms"].items())
    after = [f"{name}: not run: {f['not_run']}" for name, f in modes.items() if "not_run" in f]
    after += [
        f"peak: {figures['peak_tflops']:g} TFLOP/s ({figures['peak_is']}), "
        f"{figures['bandwidth_gb_s']:g} GB/s ({figures['bandwidth_is']}); at that: {floor}",
        f"fixture: seed {figures['seed']}, inputs {figures['inputs_sha256'][:12]}, answers "
        f"{figures['answers_sha256'][:12]}; {versions}",
    ]
    return [*_wrapped(before, columns), *rows, *_wrapped(after, columns)]


def _columns(run: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Modes side by side."""
    from fluxvla_core.policies.benchmark import STAGES

    lines = [
        f"{'ms':{_WIDTH}}" + "".join(f"{mode:>{_COLUMN}}" for mode in run),
        " " * _WIDTH + f"{'p50':>8}{'p95':>7}{'p99':>7}" * len(run),
    ]
    for stage in STAGES:
        if all(stage in found for found in run.values()):
            cells = (_row(found[stage]) for found in run.values())
            lines.append(f"{stage:{_WIDTH}}" + "".join(cells))
    summary: dict[str, Callable[[Mapping[str, Any]], str]] = {
        "Hz": lambda found: f"{found['hz']:g}",
        "first call s": lambda found: f"{found['first_call_s']:.2f}",
        "memory MB": lambda found: f"{found['memory_mb']:.0f}",
        "of the peak": lambda found: f"{found['share_of_peak']:.1%}",
        "apart": lambda found: f"{found['apart']:.1e}",
    }
    for name, said in summary.items():
        cells = (f"{said(found):>{_COLUMN}}" for found in run.values())
        lines.append(f"{name:{_WIDTH}}" + "".join(cells))
    return lines


def _wrapped(lines: Sequence[str], columns: int) -> list[str]:
    """Each of ``lines`` in as many as it needs, broken between words."""
    return [
        part
        for line in lines
        for part in textwrap.wrap(
            line,
            columns,
            subsequent_indent="  ",
            break_long_words=False,
            break_on_hyphens=False,
        )
    ]


def _row(stage: Mapping[str, float]) -> str:
    """p50, p95 and p99 in ``_COLUMN`` characters."""
    p50, p95, p99 = (
        f"{ms:.2f}" if ms < 1000 else f"{ms:.0f}"
        for ms in (stage["p50_ms"], stage["p95_ms"], stage["p99_ms"])
    )
    return f"{p50:>8}{p95:>7}{p99:>7}"
