"""Losses, gradient norms and times of the last steps, kept on the device until they are logged.

Fetching a loss makes the host wait for the device. The numbers of every step are kept as tensors
and fetched together every few steps, then summed over the ranks in one operation.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice, pairwise
from statistics import fmean
from typing import Any

import torch
from torch import Tensor

from fluxvla_core.errors import RunFailed
from fluxvla_core.training.distributed import World, all_gather_text, all_reduce_sum


@dataclass(frozen=True)
class Step:
    """The numbers of one step on this rank; losses and ids are those of its micro-batches.

    Args:
        epoch: epochs done before it, with fraction.
        lr: the learning rate used.
        losses: scalars, still on the device.
        ids: sample ids ``(B,)``, a list of them, or None.
        norm: of the gradients, over all ranks; None if unknown.
        samples: used by all ranks together.
        wait: seconds that the host waited for data.
        sample_losses: ``(B,)`` of the samples, where the model returns them.
        ended: the host's clock when it was launched.
    """

    step: int
    epoch: float
    lr: float
    losses: Sequence[Tensor]
    ids: Sequence[Any]
    norm: Tensor | None
    samples: int
    wait: float
    sample_losses: Sequence[Tensor | None] = ()
    ended: float = field(default_factory=lambda: time.perf_counter())


@dataclass
class StepMetrics:
    """Collects steps until :meth:`fetch`. All ranks fetch at the same steps.

    ``parts`` maps the datasets of a mixture to how many sample ids each has, in their order.
    """

    world: World
    parts: Mapping[str, int] = field(default_factory=dict)
    began: float = field(default_factory=time.perf_counter)
    _pending: list[Step] = field(default_factory=list)

    def restart_clock(self) -> None:
        """Leave what happened since the last step (a save) out of the next step's time."""
        self.began = time.perf_counter()

    def add(self, step: Step) -> None:
        """Keep one step; nothing is fetched from the device."""
        self._pending.append(step)

    def fetch(self) -> list[dict[str, Any]]:
        """A record of each step since the last fetch, over all ranks; waits for the device.

        Records are what a metric's ``commit`` is given: ``loss`` is the mean over the ranks,
        ``grad_norm`` None if unknown, ``step_time`` in seconds, ``data_wait`` its share that the
        host waited for data, ``loss/<name>`` the mean of a dataset's samples. Off the CPU times are
        means over the steps fetched together.

        Raises:
            RunFailed: a loss or gradient norm is not finite; names step, rank and samples.
        """
        steps, self._pending = self._pending, []
        if not steps:
            return []
        # float64 sums of float32 losses are exact, whatever order they are added in.
        each = iter(torch.stack([loss for s in steps for loss in s.losses]).cpu().tolist())
        losses = [sum(islice(each, len(s.losses))) / len(s.losses) for s in steps]
        zero = torch.zeros((), device=self.world.device)
        norms = torch.stack([zero if s.norm is None else s.norm for s in steps]).cpu().tolist()
        # Only now has the device done the steps.
        times, waits = self._clocked(steps, time.perf_counter())
        mean = torch.tensor([losses, norms, times, waits], dtype=torch.float64)
        all_reduce_sum(self.world, mean)
        mean /= self.world.size
        if not bool(torch.isfinite(mean[:2]).all()):
            raise self._not_finite(steps, mean)
        return [
            {
                "global_step": s.step,
                "epoch": s.epoch,
                "loss": loss,
                "grad_norm": None if s.norm is None else norm,
                "lr": s.lr,
                "step_time": seconds,
                "samples_per_s": s.samples / seconds if seconds > 0 else 0.0,
                "data_wait": wait / seconds if seconds > 0 else 0.0,
                **{f"loss/{name}": mean for name, mean in by_dataset.items()},
            }
            for s, by_dataset, loss, norm, seconds, wait in zip(
                steps, self._by_dataset(steps), *mean.tolist(), strict=True
            )
        ]

    def _clocked(self, steps: list[Step], now: float) -> tuple[list[float], list[float]]:
        """Step times and data waits of ``steps``; the times add up to what went by until now."""
        ends = [self.began, *(s.ended for s in steps[:-1]), now]
        self.began = now
        times = [b - a for a, b in pairwise(ends)]
        waits = [s.wait for s in steps]
        if self.world.device.type == "cpu":
            return times, waits
        # The host runs ahead: its times are of launching steps, and only their sum is true.
        return [fmean(times)] * len(steps), [fmean(waits)] * len(steps)

    def _by_dataset(self, steps: list[Step]) -> list[dict[str, float]]:
        if len(self.parts) < 2:
            return [{} for _ in steps]
        # Sums and counts of every step and dataset: ranks without the one add zeros.
        sums = torch.zeros(2, len(steps), len(self.parts), dtype=torch.float64)
        ends = torch.tensor(list(self.parts.values())).cumsum(0)
        for row, step in enumerate(steps):
            for losses, ids in zip(step.sample_losses, step.ids, strict=False):
                if losses is None or not isinstance(ids, Tensor):
                    continue
                part = torch.bucketize(ids.cpu(), ends, right=True).clamp(max=len(ends) - 1)
                sums[0, row].index_add_(0, part, losses.double().cpu())
                sums[1, row].index_add_(0, part, torch.ones(len(part), dtype=torch.float64))
        summed, counts = all_reduce_sum(self.world, sums)
        means = summed / counts
        return [
            {name: m for name, m, n in zip(self.parts, row, count, strict=True) if n}
            for row, count in zip(means.tolist(), counts.tolist(), strict=True)
        ]

    def _not_finite(self, steps: list[Step], mean: Tensor) -> RunFailed:
        bad = int((~torch.isfinite(mean[:2])).any(dim=0).nonzero()[0])
        step, loss, norm = steps[bad], mean[0, bad].item(), mean[1, bad].item()
        if math.isfinite(loss):
            # The norm is of all batches of all ranks: any of them may be the one.
            what = f"the gradient norm is {norm} at step {step.step}, with loss {loss:.6g}"
            named = f"rank {self.world.rank}: {', '.join(map(_which, step.ids))}"
        else:
            what = f"the loss is {loss} at step {step.step}"
            named = next(
                (
                    f"rank {self.world.rank}: loss {value.item()} on {_which(ids)}"
                    for value, ids in zip(step.losses, step.ids, strict=True)
                    if not math.isfinite(value.item())
                ),
                "",
            )
        lines = [text for text in all_gather_text(self.world, named) if text]
        return RunFailed(
            "\n".join([what, *(f"    {line}" for line in lines)]),
            cause="a learning rate that is too high, or samples with wrong or huge values",
            next="look at those samples, or lower the learning rate, and resume from the last "
            "checkpoint, which was saved before this",
        )


def _which(ids: Any) -> str:
    if ids is None:
        return "a batch without sample_ids"
    return f"samples {ids.tolist() if isinstance(ids, Tensor) else ids}"
