"""Exponential moving average (EMA) of the weights."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import torch
from torch import Tensor, nn

from fluxvla_core.checkpoints.shards import to_local
from fluxvla_core.checkpoints.tensors import check_names, copy_full


class Ema:
    """Exponential moving average of the trainable weights, sharded as they are.

    The decay of the ``n``-th update is ``min(decay, (1 + n) / (10 + n))``: early averages then
    forget the random start (as tf.train.ExponentialMovingAverage does with ``num_updates``).
    """

    def __init__(self, parameters: Mapping[str, nn.Parameter], decay: float) -> None:
        self.decay = decay
        self._parameters = parameters
        self.shadow = {name: p.detach().clone() for name, p in parameters.items()}

    def update(self, step: int) -> None:
        """Move towards the weights after optimizer step ``step`` (from 1)."""
        decay = min(self.decay, (1 + step) / (10 + step))
        with torch.no_grad():
            torch._foreach_lerp_(
                [to_local(t) for t in self.shadow.values()],
                [to_local(p) for p in self._parameters.values()],
                1.0 - decay,
            )

    @contextmanager
    def in_place(self) -> Iterator[None]:
        """The model has the averages as its weights inside, and its own again afterwards."""
        self._swap()
        try:
            yield
        finally:
            self._swap()

    def _swap(self) -> None:
        with torch.no_grad():
            for name, parameter in self._parameters.items():
                average, weight = to_local(self.shadow[name]), to_local(parameter)
                saved = weight.clone()
                weight.copy_(average)
                average.copy_(saved)

    def load(self, tensors: Mapping[str, Tensor], where: str) -> None:
        """Take the full averages in ``tensors``.

        Raises:
            CheckpointError: names or sizes are not those of this model.
        """
        check_names(tensors, self.shadow, "the averaged weights", where)
        for name, average in self.shadow.items():
            copy_full(average, tensors[name])
