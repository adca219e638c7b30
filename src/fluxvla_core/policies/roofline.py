"""Lower bound of inference time by operations and bytes (Williams et al. 2009, "Roofline").

Matrix products, convolutions and attentions are counted as they are run, on any device, the meta
device included. A kernel takes as long as its operations at the device's peak, or as its inputs and
output at the memory's bandwidth, whichever is longer; nothing stays in a cache from one kernel to
the next, and everything else takes no time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import flop_registry, sdpa_flop_count

BANDWIDTHS_GB_S: tuple[tuple[str, float], ...] = (
    ("B200", 8000.0),  # NVIDIA DGX B200 datasheet: 64 TB/s for eight
    ("H200", 4800.0),  # NVIDIA H200 datasheet
    ("H100 NVL", 3900.0),  # NVIDIA H100 datasheet
    ("H100 PCIe", 2000.0),  # NVIDIA H100 datasheet of 2022
    ("H100", 3350.0),  # the same, SXM
    ("A100", 2039.0),  # NVIDIA A100 datasheet: 80 GB, SXM
    ("L40S", 864.0),  # NVIDIA L40S datasheet
    ("L4", 300.0),  # NVIDIA L4 datasheet
    ("RTX 5090", 1792.0),  # NVIDIA Blackwell RTX whitepaper
    ("RTX 4090", 1008.0),  # NVIDIA Ada architecture whitepaper, table 2
)
"""Part of a device's name -> GB/s of its memory by its maker; the first that fits counts."""
_CPU_ATTENTION = torch.ops.aten._scaled_dot_product_flash_attention_for_cpu


@dataclass(frozen=True)
class Work:
    """Operations and bytes of some kernels.

    Args:
        kernels: ``(flops, bytes)`` of each.
    """

    kernels: tuple[tuple[int, int], ...]

    @property
    def flops(self) -> int:
        """Floating-point operations of all kernels; a multiply-add counts as two."""
        return sum(flops for flops, _ in self.kernels)

    @property
    def bytes(self) -> int:
        """Read and written by all."""
        return sum(moved for _, moved in self.kernels)

    def seconds(self, peak_flops: float, bytes_per_s: float) -> float:
        """The least time, one kernel after the other."""
        return sum(max(f / peak_flops, b / bytes_per_s) for f, b in self.kernels)


def work_of(function: Callable[[], Any]) -> tuple[Any, Work]:
    """The result of ``function``, and the work of running it."""
    counter = _Counter()
    with counter:
        found = function()
    return found, Work(tuple(counter.kernels))


def known_bandwidth(name: str) -> float | None:
    """GB/s of the memory of the device called ``name``; None if nobody says."""
    words = name.replace("-", " ")
    return next((rate for part, rate in BANDWIDTHS_GB_S if part in words), None)


class _Counter(TorchDispatchMode):  # type: ignore[no-untyped-call]
    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.kernels: list[tuple[int, int]] = []

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        named = dict(kwargs or {})
        packet = func.overloadpacket
        if packet not in flop_registry and packet is not _CPU_ATTENTION:
            with self:
                parts = func.decompose(*args, **named)
            return func(*args, **named) if parts is NotImplemented else parts
        found = func(*args, **named)
        if packet is _CPU_ATTENTION:
            shapes = (tensor.shape for tensor in args[:3])
            flops = sdpa_flop_count(*shapes)  # type: ignore[no-untyped-call]
        else:
            flops = flop_registry[packet](*args, **named, out_val=found)
        tensors = [t for t in tree_leaves((args, named, found)) if isinstance(t, Tensor)]
        self.kernels.append((int(flops), sum(_bytes(tensor) for tensor in tensors)))
        return found


def _bytes(tensor: Tensor) -> int:
    """Bytes of the tensor's distinct elements: expanded ones are read once."""
    sizes = zip(tensor.shape, tensor.stride(), strict=True)
    count = 1
    for size, stride in sizes:
        count *= size if stride else 1
    return count * tensor.element_size()
