"""Copies between host and device that nobody waits for, through pinned memory that is kept."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor


class Transfer:
    """Brings batches to a device, and answers back.

    A copy from pageable memory makes the host wait, and allocating pinned memory takes longer than
    the copy, so that it is kept, by name, shape and dtype. ``fetch`` waits for the device; until
    then the pinned memory of a batch may still be read. On a CPU nothing is copied.

    Args:
        device: where batches go.
        pinned: whether host memory is pinned; by default on CUDA devices.
    """

    def __init__(self, device: str, pinned: bool | None = None) -> None:
        self.device = torch.device(device)
        self._pinned = self.device.type == "cuda" if pinned is None else pinned
        self._kept: dict[str, Tensor] = {}

    def to_device(self, batch: Mapping[str, Any]) -> dict[str, Any]:
        """The tensors of ``batch`` on the device; what is no tensor stays as it is."""
        return {
            key: self._sent(key, value) if isinstance(value, Tensor) else value
            for key, value in batch.items()
        }

    def fetch(self, answer: Tensor) -> npt.NDArray[np.float32]:
        """``answer`` as an array of its own, once the device is done."""
        wide = answer.detach().float()
        if self.device.type == "cpu":
            return np.array(wide.numpy())
        host = self._buffer("answer", wide)
        host.copy_(wide, non_blocking=self._pinned)
        if self.device.type == "cuda":
            torch.cuda.current_stream(self.device).synchronize()
        return np.array(host.numpy())

    def _sent(self, key: str, value: Tensor) -> Tensor:
        if value.device == self.device or self.device.type == "cpu":
            return value
        if not self._pinned:
            return value.to(self.device)
        buffer = self._buffer(f"batch.{key}", value)
        buffer.copy_(value)
        return buffer.to(self.device, non_blocking=True)

    def _buffer(self, key: str, like: Tensor) -> Tensor:
        """Host memory for ``like``; that of the last call where it fits."""
        buffer = self._kept.get(key)
        if buffer is None or buffer.shape != like.shape or buffer.dtype != like.dtype:
            # In inference mode it would be a tensor that no other mode may write to.
            with torch.inference_mode(False):
                buffer = torch.empty(like.shape, dtype=like.dtype, pin_memory=self._pinned)
            self._kept[key] = buffer
        return buffer
