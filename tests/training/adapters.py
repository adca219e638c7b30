"""Which adapters of a shipped config a training reaches."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from fluxvla_core.config.load import load_config
from fluxvla_core.training.lora import LoraOptions, attach

CONFIGS = Path(__file__).parents[2] / "configs"


def shipped(config: str) -> LoraOptions:
    """The table ``lora`` of a file in ``configs/``, with a rank that suits a tiny model."""
    table = dict(load_config(CONFIGS / config).tree["runner"]["lora"])
    return LoraOptions.read({**table, "rank": 2}, None)


OWN = LoraOptions.read({"rank": 2}, None, declared=True)
"""With the layers that the model names."""


def idle_parameters(model: nn.Module, options: LoraOptions, batch: dict[str, Tensor]) -> list[str]:
    """Parameters that should train and get no gradient in the second of two steps.

    In the first step only one factor of an adapter gets one, as the other is zero.
    """
    attach(model.train(), options)
    trained = {n: p for n, p in model.named_parameters() if p.requires_grad}
    optimizer = torch.optim.SGD(trained.values(), lr=1e-2)
    loss: Any = None
    for _ in range(2):
        optimizer.zero_grad()
        loss = model(**batch)["loss"]
        loss.backward()
        optimizer.step()
    return [n for n, p in trained.items() if p.grad is None or not p.grad.any()]


def adapted(model: nn.Module, options: LoraOptions) -> set[str]:
    """Names of what an adapter of ``options`` trains."""
    attach(model, options)
    return {name for name, p in model.named_parameters() if p.requires_grad}
