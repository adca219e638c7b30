"""An answer of PI0.5 and GR00T N1.5 on a GPU: eager, compiled, and as a CUDA graph.

    python -m benchmarks.gpu_act [--calls 100] [--precision bf16] [--quantization fp8_dynamic]
    python -m benchmarks.gpu_act --size tiny --device cpu      the same in seconds, no figures kept
    python -m benchmarks.gpu_act --roofline                    no GPU: PI0.5's least time by shapes

Random weights, batch 1, 10 steps (GR00T 4), prompts padded to their budget; PI0.5 with two and
three cameras, GR00T with two. What is measured goes from a batch on the host to actions on the
host: ``transfer``, ``prefix`` (once an observation), ``denoise`` (all steps), ``total``. Pre- and
postprocessing, which depend on the robot, are ``fluxvla bench-policy``'s. Inputs follow from
``--seed``; answers are kept as a checksum, and ``apart`` is their distance from eager's.

``floor_ms`` is the roofline of the device: every matrix product, convolution and attention at the
device's peak or its memory's bandwidth, see ``fluxvla_core.policies.roofline``. ``--roofline``
counts it on the meta device for the devices that the published figures are of. Goals on one H200:
PI0.5 below 20 ms and five times eager, GR00T below 15 ms. Writes
``benchmarks/results/gpu_act.json``, and nothing where there is no GPU.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from benchmarks import _results
from benchmarks._gpu_act_models import CASES, SIZES, Case
from fluxvla_core.errors import ConfigError
from fluxvla_core.policies import benchmark
from fluxvla_core.policies.execution import (
    EXECUTIONS,
    Eager,
    Transfer,
    clock_of,
    execution_of,
)
from fluxvla_core.policies.inference_weights import QUANTIZATIONS, check_quantization, ready
from fluxvla_core.policies.local import PRECISIONS
from fluxvla_core.policies.roofline import BANDWIDTHS_GB_S, Work, work_of
from fluxvla_core.training.cost import PEAK_TFLOPS

PUBLISHED = (
    {"who": "FlashRT", "what": "pi0.5, 2 views, FP8, RTX 5090", "ms": 17.58},
    {"who": "FlashRT", "what": "pi0.5, 2 views, FP8, L40", "ms": 26.6},
    {"who": "vllm-omni", "what": "pi0.5, 1 view, RTX PRO 5000", "ms": 20.55},
    {"who": "vllm-omni", "what": "pi0.5, 3 views, RTX PRO 5000", "ms": 41.30},
    {"who": "upstream FluxVLA", "what": "pi0.5, A100 (21.2 Hz)", "ms": 47.2},
    {"who": "upstream FluxVLA", "what": "GR00T, A100 (32.6 Hz)", "ms": 30.7},
)
"""By their makers; none comes with its inputs."""
SPEEDUP_GOAL = 5.0
ROOFLINE_DEVICES = ("H200", "H100", "A100", "L40S", "RTX 4090")


def measure(case: Case, args: argparse.Namespace) -> dict[str, Any]:
    """Every execution of one policy, one after the other; a model that is compiled stays so."""
    model = ready(case.model(args.size, args.device), args.precision, args.quantization)
    batches = [case.batch(model, args.seed + number) for number in range(4)]
    peak, origin = benchmark.peak_tflops(args.device, args.precision, None)
    rate, rate_origin = benchmark.bandwidth_gb_s(args.device)
    parts = _work(model, batches[0], args)
    found: dict[str, Any] = {
        "parameters": sum(p.numel() for p in model.parameters()),
        "gflops": {name: work.flops / 1e9 for name, work in parts.items()},
        "gigabytes": {name: work.bytes / 1e9 for name, work in parts.items()},
        "peak_tflops": peak,
        "peak_is": origin,
        "bandwidth_gb_s": rate,
        "bandwidth_is": rate_origin,
        "floor_ms": {n: w.seconds(peak * 1e12, rate * 1e9) * 1e3 for n, w in parts.items()},
        "inputs_sha256": benchmark.digest(
            {f"{i}.{n}": t.numpy() for i, b in enumerate(batches) for n, t in b.items()}
        ),
        "modes": {},
    }
    first: Any = None
    for number, name in enumerate(EXECUTIONS):
        try:
            execution = execution_of(name, model, compiled=number > 1)
        except ConfigError as error:
            found["modes"][name] = {"not_run": error.what}
            continue
        taken, answers = timed(execution, batches, args)
        first = answers if first is None else first
        found["modes"][name] = {**taken, "apart": float(np.abs(answers - first).max())}
    found["answers_sha256"] = benchmark.digest({"eager": first})
    return found


def timed(
    execution: Eager, batches: Sequence[Mapping[str, torch.Tensor]], args: argparse.Namespace
) -> tuple[dict[str, Any], Any]:
    """Percentiles in ms by part, memory and the first call; and the answers to ``batches``."""
    transfer = Transfer(args.device)
    if transfer.device.type == "cuda":
        torch.cuda.reset_peak_memory_stats()
    rows: list[dict[str, float]] = []
    answers = []
    for call in range(1 + args.warmup + args.calls):
        begun, clock = time.perf_counter(), clock_of(args.device)
        with torch.inference_mode(), _mixed(args, execution.caches_casts):
            batch = transfer.to_device(batches[call % len(batches)])
            clock.mark("transfer")
            answer = transfer.fetch(execution.answer(batch, clock))
        total = time.perf_counter() - begun
        if len(answers) < len(batches):
            answers.append(answer)
        rows.append({**clock.seconds(), "total": total})
    counted = rows[1 + args.warmup :]
    found: dict[str, Any] = {
        part: {
            f"p{share}": float(np.percentile([row[part] for row in counted], share)) * 1e3
            for share in (50, 95, 99)
        }
        for part in rows[0]
    }
    if transfer.device.type == "cuda":
        found["peak_memory_gb"] = torch.cuda.max_memory_allocated() / 1e9
    return {**found, "first_call_s": rows[0]["total"]}, np.stack(answers)


def judged(cases: Mapping[str, Any], device: str) -> dict[str, Any]:
    """Whether the goals are met; nothing but for an H200."""
    if "H200" not in device:
        return {}
    met = {}
    for case in CASES:
        modes = cases[case.name]["modes"]
        p50 = modes["graph"]["total"]["p50"]
        met[f"{case.name}: below {case.goal_ms:g} ms"] = p50 < case.goal_ms
        if case.family == "pi05":
            faster = modes["eager"]["total"]["p50"] / p50
            met[f"{case.name}: {SPEEDUP_GOAL:g} times eager"] = faster >= SPEEDUP_GOAL
    return {"goals_met": met}


def roofline() -> dict[str, Any]:
    """PI0.5's least times in bf16 on known devices, counted on the meta device.

    That computes in float32, so that bytes are halved.
    """
    peaks, rates = dict(PEAK_TFLOPS), dict(BANDWIDTHS_GB_S)
    found: dict[str, Any] = {}
    for case in (case for case in CASES if case.family == "pi05"):
        model = case.model("full", "meta")
        batch = {name: value.to("meta") for name, value in case.batch(model, 0).items()}
        parts = {
            name: Work(tuple((f, b // 2) for f, b in work.kernels))
            for name, work in _parts(model, batch).items()
        }
        found[case.name] = {
            "gflops": {name: work.flops / 1e9 for name, work in parts.items()},
            "gigabytes": {name: work.bytes / 1e9 for name, work in parts.items()},
            "floor_ms": {
                device: {
                    n: w.seconds(peaks[device] * 1e12, rates[device] * 1e9) * 1e3
                    for n, w in parts.items()
                }
                for device in ROOFLINE_DEVICES
            },
        }
    return found


def main(words: Sequence[str] | None = None) -> int:
    """Measure, print and write; 0 also when a goal is missed, for a benchmark is not a test."""
    words = sys.argv[1:] if words is None else words
    parser = _results.options(__file__)
    parser.add_argument("--size", choices=SIZES, default="full")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--precision", choices=PRECISIONS, default="bf16")
    parser.add_argument("--quantization", choices=QUANTIZATIONS)
    parser.add_argument("--calls", type=int, default=100)
    parser.add_argument("--warmup", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--roofline", action="store_true")
    args = parser.parse_args(words)
    if args.roofline:
        print(json.dumps(_rounded(roofline()), indent=1))
        return 0
    full, cuda = args.size == "full", torch.device(args.device).type == "cuda"
    if full and not cuda:
        parser.error("on a CPU only the tiny size can be run: --size tiny --device cpu")
    if cuda and not torch.cuda.is_available():
        print("gpu_act: no GPU: not measured (--size tiny --device cpu shows that it runs)")
        return 2 if words else 0
    check_quantization(args.quantization, args.device)
    begun = _results.head("fluxvla-pi", "fluxvla-gr00t", "torch", "torchao", "transformers")
    device = torch.cuda.get_device_name() if cuda else "cpu"
    cases = {}
    for case in CASES:
        cases[case.name] = measure(case, args)
        print(f"{case.name}: {json.dumps(_rounded(cases[case.name]['modes']))}", file=sys.stderr)
    summary = {
        **begun,
        "what": "answers of policies with random weights, batch 1",
        "device": device,
        "cuda": torch.version.cuda,
        **{name: value for name, value in vars(args).items() if name not in ("out", "roofline")},
        "cases": _rounded(cases),
        **(judged(cases, device) if full else {}),
        "published": list(PUBLISHED),
    }
    if not full and args.out == parser.get_default("out"):
        print(json.dumps(summary, indent=1))
        return 0
    _results.keep(args.out, summary)
    return 0


def _work(model: Any, batch: Mapping[str, Any], args: argparse.Namespace) -> dict[str, Work]:
    there = {name: value.to(args.device) for name, value in batch.items()}
    with _mixed(args, True):
        return _parts(model, there)


def _parts(model: Any, batch: Mapping[str, Any]) -> dict[str, Work]:
    parts = Eager(model).parts
    assert parts is not None
    with torch.inference_mode():
        seen, prefix = work_of(lambda: model.observe(**parts.observation(batch)))
        tables = model.step_tables()
        _, steps = work_of(lambda: model.denoise(seen, batch["noise"], tables))
    return {"prefix": prefix, "denoise": steps}


def _mixed(args: argparse.Namespace, caches: bool) -> torch.autocast:
    kind = torch.device(args.device).type
    return torch.autocast(
        kind, torch.bfloat16, enabled=args.precision == "bf16", cache_enabled=caches
    )


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return float(f"{value:.5g}")
    if isinstance(value, Mapping):
        return {key: _rounded(inner) for key, inner in value.items()}
    return [_rounded(inner) for inner in value] if isinstance(value, list) else value


if __name__ == "__main__":
    raise SystemExit(main())
