"""The two sides of ``gpu_step.py``, each in processes of its own: two models fit on no GPU."""

from __future__ import annotations

import inspect
import json
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.distributed as dist
from torch.profiler import ProfilerActivity
from torch.utils.data import DataLoader

from benchmarks._gpu_act_models import Case, model_table
from benchmarks._pi05_model import SIZES, BenchPi05
from fluxvla_core import RunContext, build_runner_from_cfg
from fluxvla_core.build import build_vla_from_cfg
from fluxvla_core.data.loader import DictCollator
from fluxvla_core.data.sampler import SampleKey, StepPlan, StepSampler
from fluxvla_core.training import cost
from fluxvla_core.training.model import checkpoint_activations, compile_units, units_of

BENCH = "bench"
FAMILIES = (BENCH, "pi05", "gr00t")
"""``BenchPi05``, and models of plugins, with the weights that they draw."""
OURS, HAND = "runner", "by hand"
KEYS = ("images", "lang_tokens", "lang_masks", "actions", "noise", "time")
LEARNING_RATE, WEIGHT_DECAY, MAX_NORM = 5e-5, 0.01, 1.0
POOL, SEED, PROFILED = 64, 42, 3
MIXED = {"param_dtype": torch.bfloat16, "reduce_dtype": torch.float32, "cast_forward_inputs": False}


@dataclass(frozen=True)
class Setup:
    """What both sides do; ``batch`` is a process's."""

    family: str = BENCH
    size: str = "pi05"
    device: str = "cuda"
    nproc: int = 1
    batch: int = 16
    workers: int = 2
    warm_up: int = 5
    steps: int = 10
    blocks: int = 3
    recompute: bool = False
    compile: bool = False
    strategy: str = "full-shard"
    attention: str = "sdpa"
    whole_prompts: bool = False
    peak_tflops: float | None = None

    @property
    def model(self) -> dict[str, str]:
        """Arguments of the model."""
        return {"size": self.size, "attention": self.attention, "device": self.device}

    @property
    def table(self) -> dict[str, Any]:
        """The model in a config."""
        if self.family == BENCH:
            return {"type": "BenchPi05", **self.model}
        return model_table(self.family, self.size == "tiny")

    def built(self, device: str) -> Any:
        """The model, in train mode; on ``meta`` it takes no memory."""
        if self.family == BENCH:
            return BenchPi05(**{**self.model, "device": device})
        with torch.device(device):
            return build_vla_from_cfg(self.table)


def keys_of(setup: Setup) -> Sequence[str]:
    """What a batch has; of ``BenchPi05`` always the same."""
    return KEYS if setup.family == BENCH else tuple(_of_family(setup))


class Samples:
    """Random samples from a pool in memory; prompts are 3/10 to all of the longest."""

    def __init__(self, setup: Setup) -> None:
        if setup.family != BENCH:
            self.data = _of_family(setup)
            return
        s, rng = SIZES[setup.size], np.random.default_rng(0)
        images = (POOL, 3 * s.cameras, s.image_size, s.image_size)
        chunk = (POOL, s.actions, s.action_dim)
        self.data = {
            "images": rng.integers(0, 256, images, np.uint8),
            "lang_tokens": rng.integers(0, s.words, (POOL, s.prompt)),
            "actions": rng.standard_normal(chunk, np.float32),
            "noise": rng.standard_normal(chunk, np.float32),
            "time": 1 - rng.beta(1.5, 1.0, POOL).astype(np.float32),
        }
        if not setup.whole_prompts:
            lengths = rng.integers(3 * s.prompt // 10, s.prompt + 1, (POOL, 1))
            self.data["lang_masks"] = np.arange(s.prompt) < lengths

    def __len__(self) -> int:
        return POOL * 1000

    def __getitem__(self, key: SampleKey) -> dict[str, Any]:
        return self.get_sample(key.index, key.epoch)

    def get_sample(self, index: int, epoch: int) -> dict[str, Any]:
        """What the runner asks for."""
        return {name: values[index % POOL] for name, values in self.data.items()}


def _of_family(setup: Setup) -> dict[str, Any]:
    """``POOL`` samples of what a plugin's model learns from, with two cameras."""
    model, rng = setup.built("meta"), np.random.default_rng(0)
    case = Case(setup.family, 2, 0.0)
    rows = [case.batch(model, seed) for seed in range(POOL)]
    found = {name: torch.cat([row[name] for row in rows]).numpy() for name in rows[0]}
    if setup.whole_prompts:
        found["lang_masks"][:] = True
    found["noise"] = found["noise"][:, None]
    found["actions"] = rng.standard_normal((POOL, *model.action_shape), np.float32)
    found["action_masks"] = np.ones((POOL, model.action_shape[0]), np.float32)
    found["time"] = 1 - rng.beta(1.5, 1.0, (POOL, 1)).astype(np.float32)
    taken = inspect.signature(type(model).forward).parameters
    return {name: values for name, values in found.items() if name in taken}


def our_config(setup: Setup) -> dict[str, Any]:
    """The config tree of our side."""
    return {
        "model": setup.table,
        "train_dataloader": {
            "per_device_batch_size": setup.batch,
            "per_device_num_workers": setup.workers,
        },
        "runner": {
            "type": "FSDPTrainRunner",
            "sharding_strategy": setup.strategy,
            "max_steps": 1_000_000,
            "learning_rate": LEARNING_RATE,
            "weight_decay": WEIGHT_DECAY,
            "max_grad_norm": MAX_NORM,
            "enable_mixed_precision_training": True,
            "enable_gradient_checkpointing": setup.recompute,
            "compile_blocks": setup.compile,
            "seed": SEED,
            "device": setup.device,
            "peak_tflops": setup.peak_tflops,
            "collator": {"type": "DictCollator", "keys": list(keys_of(setup))},
        },
    }


def by_runner(setup: Setup, work_dir: Path) -> tuple[Callable[[int], float], Any]:
    """What does so many steps and gives the last loss, and the runner; nothing is saved."""
    from fluxvla_core.training.state import Progress
    from fluxvla_core.training.stop import StopRequest
    from fluxvla_core.training.trainer import Trainer

    config = our_config(setup)
    context = RunContext(config=config, section="runner", work_dir=work_dir)
    runner = build_runner_from_cfg(config["runner"], context)
    runner.save_checkpoint = lambda *args: None
    dataset = Samples(setup)
    runner.run_setup(len(dataset))
    runner.progress = Progress()
    runner._trainer = Trainer(runner, dataset, StopRequest(runner.world))

    def run(steps: int) -> float:
        target = runner.progress.step + steps
        runner.trainer.run(lambda: runner.progress.step >= target, lambda: False)
        return float(runner.progress.loss)

    return run, runner


def by_hand(setup: Setup) -> Callable[[int], float]:
    """The same as one would write it for this model alone; batches come in the same order."""
    device = torch.device(setup.device, int(os.environ.get("LOCAL_RANK", "0")))
    if setup.device == "cuda":
        torch.cuda.set_device(device)
    if setup.nproc > 1:
        dist.init_process_group("nccl" if setup.device == "cuda" else "gloo")
    torch.manual_seed(SEED)
    model: Any = setup.built(setup.device)
    if setup.recompute:
        checkpoint_activations(model)
    if setup.compile:
        compile_units(model)
    if setup.nproc > 1:
        from torch.distributed.fsdp import MixedPrecisionPolicy, fully_shard

        for unit in units_of(model):
            fully_shard(list(unit), mp_policy=MixedPrecisionPolicy(**MIXED))
        fully_shard(model, mp_policy=MixedPrecisionPolicy(**MIXED))
    optimizer = torch.optim.AdamW(
        model.parameters(), lr=LEARNING_RATE, weight_decay=WEIGHT_DECAY, fused=True
    )
    dataset: Any = Samples(setup)
    rank = dist.get_rank() if setup.nproc > 1 else 0
    plan = StepPlan(len(dataset), setup.batch, 1, setup.nproc, SEED)
    order: Any = StepSampler(plan, rank)
    stream = iter(
        DataLoader(
            dataset,
            batch_sampler=order,
            num_workers=setup.workers,
            collate_fn=DictCollator(keys_of(setup)),
            pin_memory=setup.device == "cuda",
        )
    )

    def run(steps: int) -> float:
        for _ in range(steps):
            batch = {k: v.to(device, non_blocking=True) for k, v in next(stream).items()}
            with torch.autocast(device.type, torch.bfloat16):
                loss = model(**batch)["loss"]
            loss.backward()
            torch.nn.utils.clip_grad_norm_(model.parameters(), MAX_NORM)
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        summed = loss.detach()
        if setup.nproc > 1:
            dist.all_reduce(summed)
        return float(summed) / setup.nproc

    return run


def measure(side: str, setup: Setup, profile: bool, out: Path) -> None:
    """One process of one side; the first writes what it found to ``out``."""
    cuda = setup.device == "cuda"
    found: dict[str, Any] = {}
    runner: Any = None
    if side == OURS:
        run, runner = by_runner(setup, out.parent / "work")
    else:
        run = by_hand(setup)
    run(setup.warm_up)
    taken = []
    for _ in range(setup.blocks):
        if setup.nproc > 1:
            dist.barrier()
        if cuda:
            torch.cuda.synchronize()
        began = time.perf_counter()
        found["last_loss"] = run(setup.steps)
        if cuda:
            torch.cuda.synchronize()
        taken.append((time.perf_counter() - began) / setup.steps)
    found |= {"step_s": taken, "peak_bytes": cost.peak_bytes(cuda)}
    found["device"] = torch.cuda.get_device_name() if cuda else "cpu"
    if runner is not None and runner.flops is not None:
        found |= {"flops": runner.flops.per_batch, "peak_flops": runner.flops.peak}
        found["mfu"] = [runner.flops.mfu(1, seconds) for seconds in taken]
    if profile:
        found["profile"] = profiled(run, cuda)
    if not dist.is_initialized() or dist.get_rank() == 0:
        out.write_text(json.dumps(found))
    if runner is not None:
        runner.trainer.close()
    if dist.is_initialized():
        dist.destroy_process_group()


def profiled(run: Callable[[int], Any], cuda: bool) -> str:
    """Where the time of a few steps goes: the 15 operations that take most."""
    kinds = [ProfilerActivity.CPU, *([ProfilerActivity.CUDA] if cuda else [])]
    with torch.profiler.profile(activities=kinds) as found:
        run(PROFILED)
    by = "self_cuda_time_total" if cuda else "self_cpu_time_total"
    return str(found.key_averages().table(sort_by=by, row_limit=15))
