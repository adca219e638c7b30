"""bf16 compute over fp32 master weights, or fp32 throughout."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext

import torch

DTYPES = {"bf16": torch.bfloat16}


def compute_dtype(enabled: bool, name: str) -> torch.dtype | None:
    """The dtype that matrix products are computed in; None for that of the weights.

    Weights, gradients and optimizer state stay fp32: in bf16 a parameter of 1.0 does not move
    under steps of 5e-5. fp16 is not offered: it needs loss scaling, and where it is fast bf16 is.
    """
    return DTYPES[name] if enabled else None


def autocast(device: torch.device, dtype: torch.dtype | None) -> AbstractContextManager[object]:
    """Compute in ``dtype`` inside; inputs, targets and reductions stay fp32."""
    if dtype is None:
        return nullcontext()
    return torch.autocast(device.type, dtype)
