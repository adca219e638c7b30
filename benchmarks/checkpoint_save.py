"""Benchmarks how long saving a checkpoint holds up the training, against ``torch.save``.

    python -m benchmarks.checkpoint_save [--gigabytes 1] [--saves 4] [--steps 12]

One process trains a model of so many gigabytes with AdamW (its state is twice that). Before every
save the same weights and optimizer state are written by ``torch.save`` to the same disk, without
flushing it; then the runner saves: what counts is how long the step loop stands still, in the save
itself and in the next optimizer step that waits for the copy. The first save makes the memory that
the later ones copy into and is given by itself. What writing in the background costs the
steps that run meanwhile is given as the ratio of their times to those of steps without it. Goal:
under a tenth. Writes ``benchmarks/results/checkpoint_save.json``.
"""

from __future__ import annotations

import statistics
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from benchmarks import _results
from fluxvla_core import RUNNERS, VLAS, BaseTrainRunner, RunContext, build_runner_from_cfg
from fluxvla_core.testing.training import TinyDataset
from fluxvla_core.training.saving import Saver

MOST_RATIO = 0.10
WIDTH = 4096


@VLAS.register_module()
class WideVLA(nn.Module):
    """``layers`` square matrices of 64 MiB each, one after the other."""

    def __init__(self, layers: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList(nn.Linear(WIDTH, WIDTH, bias=False) for _ in range(layers))

    def forward(self, states: Tensor) -> dict[str, Tensor]:
        """``(B, 6)`` -> ``{"loss": scalar}``."""
        x = states.repeat(1, WIDTH // states.shape[1] + 1)[:, :WIDTH]
        for layer in self.layers:
            x = torch.tanh(layer(x))
        return {"loss": x.square().mean()}


@RUNNERS.register_module()
class TimedRunner(BaseTrainRunner):
    """Saves twice, one way after the other, and writes down what each takes."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.found: list[dict[str, float]] = []

    def save_checkpoint(self, *args: Any, **kwargs: Any) -> Path | None:
        plain = self.context.work_dir / "plain.pt"
        began = time.perf_counter()
        state = {"model": self.vla.state_dict(), "optimizer": self.optimizer.state_dict()}
        torch.save(state, plain)
        middle = time.perf_counter()
        size = plain.stat().st_size
        plain.unlink()
        start = time.perf_counter()
        path = super().save_checkpoint(*args, **kwargs)
        end = time.perf_counter()
        self.found.append(
            {"plain_s": middle - began, "blocked_s": end - start, "gigabytes": size / 1e9}
        )
        return path

    def optimizer_step(self) -> Tensor | None:
        saver: Saver | None = self.saver
        began = time.perf_counter()
        if saver is not None:
            saver.wait_for_copies()
        if self.found:
            self.found[-1]["blocked_s"] += time.perf_counter() - began
        return super().optimizer_step()


def measure(layers: int, saves: int, steps: int, work_dir: Path) -> tuple[list[Any], list[Any]]:
    """What every save took, and every step: seconds, and whether a checkpoint was on its way."""
    config = {
        "model": {"type": "WideVLA", "layers": layers},
        "train_dataloader": {"per_device_batch_size": 1},
        "runner": {
            "type": "TimedRunner",
            "max_steps": saves * steps,
            "save_iter_interval": steps,
            "max_keep_ckpts": 1,
            "learning_rate": 1e-5,
            "max_grad_norm": None,
            "collator": {
                "type": "DictCollator",
                "keys": ["states"],
                "meta_keys": ["actions", "noise", "sample_ids"],
            },
        },
    }
    context = RunContext(config=config, section="runner", work_dir=work_dir)
    runner = build_runner_from_cfg(config["runner"], context)
    taken: list[tuple[float, bool]] = []
    began = [0.0, False]

    def before(**_: Any) -> None:
        began[:] = [time.perf_counter(), _writing()]

    step, call = runner.optimizer_step, runner.hooks.call

    def timed() -> Any:
        norm = step()
        taken.append((time.perf_counter() - began[0], began[1] and _writing()))
        return norm

    def noticed(name: str, **facts: Any) -> None:
        if name == "before_step":
            before()
        call(name, **facts)

    runner.optimizer_step, runner.hooks.call = timed, noticed
    dataset = TinyDataset()
    runner.run_setup(len(dataset))
    runner.run(dataset)
    return runner.found, taken


def _writing() -> bool:
    """Whether a checkpoint is being written: its thread has a name of its own."""
    return any(thread.name.startswith("checkpoint-") for thread in threading.enumerate())


def main() -> int:
    """Measure, print and write; 0 also when the goal is missed, for a benchmark is not a test."""
    parser = _results.options(__file__)
    parser.add_argument("--gigabytes", type=float, default=1.0)
    parser.add_argument("--saves", type=int, default=4)
    parser.add_argument("--steps", type=int, default=12)
    args = parser.parse_args()
    begun = _results.head("torch", "safetensors")
    layers = max(1, round(args.gigabytes * 1e9 / (WIDTH * WIDTH * 4)))
    with tempfile.TemporaryDirectory(dir=Path.cwd()) as folder:
        found, taken = measure(layers, args.saves, args.steps, Path(folder))
    first, later = found[0], found[1:] or found
    ratio = statistics.median(save["blocked_s"] / save["plain_s"] for save in later)
    alone = [seconds for seconds, writing in taken[1:] if not writing]
    during = [seconds for seconds, writing in taken[1:] if writing]
    slower = statistics.median(during) / statistics.median(alone) if during and alone else None
    result = {
        **begun,
        "what": "seconds the step loop stands still for a checkpoint over those of torch.save",
        "goal_ratio": MOST_RATIO,
        "ratio": round(ratio, 4),
        "goal_met": ratio < MOST_RATIO,
        "first_save_ratio": round(first["blocked_s"] / first["plain_s"], 4),
        "steps_beside_writing_over_steps_without": None if slower is None else round(slower, 3),
        "step_s": round(statistics.median(alone or during), 3),
        "saves": [{k: round(v, 4) for k, v in save.items()} for save in found],
        "threads": torch.get_num_threads(),
    }
    _results.keep(args.out, result, show=False)
    blocked = statistics.median(save["blocked_s"] for save in later)
    plain = statistics.median(save["plain_s"] for save in later)
    print(
        f"blocked {blocked:.3f} s, torch.save {plain:.3f} s ({first['gigabytes']:.2f} GB): "
        f"ratio {ratio:.3f}, goal below {MOST_RATIO}; first save {result['first_save_ratio']}"
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
