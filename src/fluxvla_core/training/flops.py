"""Model FLOPs utilisation: the share of what a device could compute that training makes use of.

As defined in Chowdhery et al. 2022 (PaLM, arXiv 2204.02311, appendix B): the model's own forward
and backward pass count, recomputing activations does not. They are counted operation by operation
on a copy of the model without memory (torch's meta device), which costs a second once and changes
nothing in the run.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from fluxvla_core.training.model import loss_of
from fluxvla_core.training.rng import rng_state, set_rng_state

PEAK_TFLOPS: tuple[tuple[str, float], ...] = (
    ("B200", 2250.0),  # NVIDIA DGX B200 datasheet: 36 PFLOPS for eight, with sparsity
    ("H200 NVL", 835.5),  # NVIDIA H200 datasheet: 1671, with sparsity
    ("H200", 989.5),  # the same: 1979, with sparsity
    ("H100 NVL", 835.5),  # NVIDIA H100 datasheet: 1671, with sparsity
    ("H100 PCIe", 756.0),  # NVIDIA H100 datasheet of 2022: 1513, with sparsity
    ("H100", 989.5),  # NVIDIA H100 datasheet, SXM: 1979, with sparsity
    ("A100", 312.0),  # NVIDIA A100 datasheet
    ("L40S", 362.05),  # NVIDIA L40S datasheet
    ("L4", 121.0),  # NVIDIA L4 datasheet: 242, with sparsity
    ("RTX 4090", 165.2),  # NVIDIA Ada architecture whitepaper, table 2: with FP32 accumulation
)
"""Part of a device's name -> dense bf16 TFLOP/s by its maker; the first that fits counts.
Makers state twice as much for matrices with a fixed pattern of zeros, which training has not."""


def known_peak(name: str, dtype: torch.dtype | None) -> float | None:
    """TFLOP/s of the device called ``name`` computing in ``dtype``; None if nobody says."""
    if dtype is not torch.bfloat16:
        return None
    words = name.replace("-", " ").split()
    return next((peak for part, peak in PEAK_TFLOPS if _within(part.split(), words)), None)


def _within(part: list[str], words: list[str]) -> bool:
    return any(words[i : i + len(part)] == part for i in range(len(words)))


def on_meta(model: nn.Module) -> nn.Module:
    """A copy of ``model`` whose tensors have shapes and no memory."""
    known: dict[int, Any] = {}
    for parameter in model.parameters():
        bare = nn.Parameter(parameter.detach().to("meta"), parameter.requires_grad)
        known[id(parameter)] = bare
    for buffer in model.buffers():
        known[id(buffer)] = buffer.detach().to("meta")
    return copy.deepcopy(model, known)


def training_flops(skeleton: nn.Module, arguments: Mapping[str, Any]) -> int:
    """Operations of one forward and backward pass; ``arguments`` are a batch's, on any device."""
    from torch.utils.flop_counter import FlopCounterMode

    bare = {k: v.to("meta") if isinstance(v, Tensor) else v for k, v in arguments.items()}
    drawn = rng_state()
    try:
        with FlopCounterMode(display=False) as counter:
            torch.autograd.backward(loss_of(skeleton(**bare), type(skeleton).__name__))
    finally:
        set_rng_state(drawn)
    return int(counter.get_total_flops())


class Meter:
    """Computes the MFU of steps, once it has counted the operations of a batch.

    Args:
        skeleton: the model as :func:`on_meta` gives it.
        peak_tflops: what one device can do.
    """

    def __init__(self, skeleton: nn.Module, peak_tflops: float) -> None:
        self._skeleton: nn.Module | None = skeleton
        self.peak = peak_tflops * 1e12
        self.per_batch: int | None = None

    @classmethod
    def of(
        cls,
        model: nn.Module,
        device: torch.device,
        dtype: torch.dtype | None,
        peak_tflops: float | None,
    ) -> Meter | None:
        """A meter for ``model``; None on CPUs and on GPUs whose peak FLOP/s are not known."""
        if peak_tflops is None and device.type == "cuda":
            peak_tflops = known_peak(torch.cuda.get_device_name(device), dtype)
        return None if peak_tflops is None else cls(on_meta(model), peak_tflops)

    def count(self, arguments: Mapping[str, Any]) -> str | None:
        """Count with the arguments of one batch; why that cannot be done, None if it can.

        A model that decides by the values of its inputs cannot run without memory.
        """
        skeleton, self._skeleton = self._skeleton, None
        if skeleton is None:
            return None
        try:
            self.per_batch = training_flops(skeleton, arguments)
        except Exception as error:  # noqa: BLE001 - a number for people must not end the run
            return f"{type(error).__name__}: {error}".splitlines()[0]
        return None

    def mfu(self, batches: int, seconds: float) -> float | None:
        """Share of the peak in 0..1 that ``batches`` of one device in ``seconds`` make use of."""
        if self.per_batch is None or seconds <= 0:
            return None
        return self.per_batch * batches / seconds / self.peak
