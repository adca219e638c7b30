"""Memory of each process that fine-tunes a published model, by family and strategy.

    python -m benchmarks.memory [--families ACT SmolVLA]

Nothing is trained, and no weights are there: it is what ``fluxvla run --dry-run`` estimates for the
configs of this repository, with the strategies and settings below instead of their own. Writes
``benchmarks/results/memory.json``, which the table of docs/models.md is made of (``--table``
prints it).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import nn

from benchmarks import _results
from fluxvla_core.build import RunContext, build_runner_from_cfg
from fluxvla_core.config.load import load_config
from fluxvla_core.training.cost import NO_ACTIVATIONS, SavedActivations, footprint, optimizer_bytes
from fluxvla_core.training.dry_run import activations_of, dry_run

CONFIGS = Path(__file__).parents[1] / "configs"
BATCH = 8
"""Samples of each process."""


@dataclass(frozen=True)
class Family:
    """Its configs, by what they train; None where there is none.

    Args:
        published: parameters of the published weights; more than the model's where parts of them
            are never read.
    """

    full: str
    lora: str | None = None
    frozen: str | None = None
    published: int | None = None


FAMILIES = {
    "PI0": Family("pi0_libero", "pi0_libero_lora", "pi0_libero_frozen", 3_501_372_176),
    "PI0-FAST": Family("pi0_fast_libero", "pi0_fast_libero_lora", "pi0_fast_libero_frozen"),
    "PI0.5": Family("pi05_aloha", "pi05_aloha_lora", "pi05_aloha_frozen", 3_616_757_520),
    "GR00T N1.5": Family(
        "gr00t_n15_aloha_full", "gr00t_n15_aloha_lora", "gr00t_n15_aloha", 2_724_163_520
    ),
    "GR00T N1.7": Family(
        "gr00t_n17_libero_full", "gr00t_n17_libero_lora", "gr00t_n17_libero", 3_144_016_000
    ),
    "SmolVLA": Family("smolvla_libero_full", "smolvla_libero_lora", "smolvla_libero", 450_046_176),
    "OpenVLA": Family(
        "openvla_libero_full", "openvla_libero", "openvla_libero_frozen", 7_541_237_184
    ),
    "OpenVLA-OFT": Family(
        "openvla_oft_libero_full", "openvla_oft_libero", "openvla_oft_libero_frozen"
    ),
    "LlavaVLA": Family("llava_aloha_full", "llava_aloha_lora", "llava_aloha_frozen"),
    "CompactVLA": Family("aloha_sim_transfer"),
    "ACT": Family("aloha_sim_act"),
    "Diffusion Policy": Family("aloha_sim_diffusion"),
}


@dataclass(frozen=True)
class Strategy:
    """A column of the table.

    Args:
        kind: which of a family's configs.
        processes: that train together; of ``DDPTrainRunner`` each holds the same for any number.
        bf16: compute in bf16.
    """

    title: str
    kind: str
    runner: Mapping[str, Any]
    processes: int = 1
    bf16: bool = True


DDP, FSDP, ZERO = "DDPTrainRunner", "FSDPTrainRunner", "DeepSpeedTrainRunner"
STRATEGIES = (
    Strategy("DDP fp32", "full", {"type": DDP}, bf16=False),
    Strategy("DDP", "full", {"type": DDP}),
    Strategy("FSDP x2", "full", {"type": FSDP}, 2),
    Strategy("FSDP x8", "full", {"type": FSDP}, 8),
    Strategy("ZeRO-2 x8", "full", {"type": ZERO, "zero_stage": 2}, 8),
    Strategy("ZeRO-3 x8", "full", {"type": ZERO, "zero_stage": 3}, 8),
    Strategy("LoRA", "lora", {"type": DDP}),
    Strategy("frozen", "frozen", {"type": DDP}),
)
_OF_STRATEGIES = ("sharding_strategy", "zero_stage", "find_unused_parameters", "static_graph")


def of_family(family: Family, activations: bool = True) -> dict[str, Any]:
    """Parameters of a family, and bytes of each process by the titles of ``STRATEGIES``.

    Args:
        activations: count these too, which takes as long as ten forward passes of nothing.
    """
    found: dict[str, Any] = {"published": family.published, "bytes": {}, "trained": {}}
    for kind in ("full", "lora", "frozen"):
        name = {"full": family.full, "lora": family.lora, "frozen": family.frozen}[kind]
        if name is None:
            continue
        tree = dict(load_config(CONFIGS / f"{name}.py").tree)
        tree["train_dataloader"] = {
            **tree["train_dataloader"],
            "per_device_batch_size": BATCH,
            "per_device_num_workers": 0,
        }
        columns = [one for one in STRATEGIES if one.kind == kind]
        counted, trained, parameters = _of_config(tree, columns, activations)
        found["bytes"] |= counted
        found["trained"][kind] = trained
        if kind == "full":
            found["parameters"] = parameters
    return found


def _of_config(
    tree: dict[str, Any], columns: Sequence[Strategy], activations: bool
) -> tuple[dict[str, Any], int, int]:
    built = dry_run(_context(tree, columns[0]), processes=())
    model, batch = built.skeleton, built.inputs
    assert model is not None, built.notes
    kept: dict[Any, SavedActivations | None] = {}
    found = {}
    for column in columns:
        context = _context(tree, column)
        runner = build_runner_from_cfg(context.config["runner"], context)
        layout = runner.memory_layout(model, column.processes, "cuda")
        key = (runner.compute_dtype, tuple(layout.gathered_as.items()))
        if key not in kept:
            kept[key] = NO_ACTIVATIONS if not activations else _kept(model, layout, runner, batch)
        state = optimizer_bytes(runner.optimizer_settings.build, layout.optimized)
        passing = kept[key] or NO_ACTIVATIONS
        counted = footprint(layout, passing, state, averaged=False, recompute=True).to_dict()
        if kept[key] is None:
            counted["activations"] = counted["total"] = None
        found[column.title] = counted
    return found, built.trained, built.parameters


def _kept(model: nn.Module, layout: Any, runner: Any, batch: Any) -> SavedActivations | None:
    """None of a model that decides by the values of its inputs."""
    from torch._subclasses.fake_tensor import (
        DataDependentOutputException,
        DynamicOutputShapeException,
    )

    try:
        return activations_of(model, layout, runner, batch)
    except (DataDependentOutputException, DynamicOutputShapeException):
        return None


def _context(tree: dict[str, Any], column: Strategy) -> RunContext:
    """The tree with a column's strategy and nothing that differs between families but the model."""
    own = {k: v for k, v in tree["runner"].items() if k not in _OF_STRATEGIES}
    runner = {
        **own,
        **column.runner,
        "enable_mixed_precision_training": column.bf16,
        "enable_gradient_checkpointing": True,
        "grad_accumulation_steps": 1,
        "ema_decay": None,
        "metric": None,
    }
    return RunContext(config={**tree, "runner": runner}, section="runner")


def table(families: Mapping[str, Any]) -> str:
    """The table of docs/models.md: GB of each process."""
    titles = [column.title for column in STRATEGIES]
    lines = [
        f"| family | parameters | {' | '.join(titles)} |",
        f"|---{'|---:' * (1 + len(titles))}|",
    ]
    for name, found in families.items():
        cells = [_cell(found["bytes"].get(title)) for title in titles]
        lines.append(f"| {name} | {found['parameters']:,} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _cell(counted: Mapping[str, Any] | None) -> str:
    if counted is None:
        return "–"
    if counted["total"] is None:
        known = sum(v for k, v in counted.items() if v is not None and k != "total")
        return f"> {known / 1e9:.1f}"
    return f"{counted['total'] / 1e9:.1f}"


def main() -> None:
    parser = _results.options(__file__)
    parser.add_argument("--families", nargs="+", choices=list(FAMILIES), default=list(FAMILIES))
    parser.add_argument("--table", action="store_true", help="print the table of what is recorded")
    args = parser.parse_args()
    if args.table:
        print(table(json.loads(args.out.read_text(encoding="utf-8"))["families"]))
        return
    begun = _results.head("torch", "transformers", "peft", "deepspeed")
    before = json.loads(args.out.read_text())["families"] if args.out.is_file() else {}
    for name in args.families:
        before[name] = of_family(FAMILIES[name])
        print(table({name: before[name]}).splitlines()[-1], flush=True)
        ordered = {key: before[key] for key in FAMILIES if key in before}
        kept = {**begun, "batch": BATCH, "recompute": True, "families": ordered}
        _results.keep(args.out, kept, show=False)


if __name__ == "__main__":
    main()
