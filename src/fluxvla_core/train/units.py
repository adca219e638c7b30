"""The blocks of a model that are sharded, recomputed and compiled one by one.

A model names them in ``fsdp_units() -> list[Module | tuple[Module, ...]]``. Each module's
``forward`` must be what the model calls, because that is where sharded weights are gathered and
let go. Modules that are used together, such as layer ``i`` of a vision-language model and layer
``i`` of the action expert that attends to it (a mixture of transformers), stand in a tuple: they
are gathered in one operation before the first of them runs and let go after the last.
"""

from __future__ import annotations

from collections.abc import Sequence

from torch import nn


def units_of(model: nn.Module) -> list[tuple[nn.Module, ...]]:
    """The model's units, each as the modules that belong together; none if it names none."""
    named: Sequence[nn.Module | tuple[nn.Module, ...]] = getattr(model, "fsdp_units", list)()
    return [unit if isinstance(unit, tuple) else (unit,) for unit in named]


def blocks_of(model: nn.Module) -> list[nn.Module]:
    """All modules of all units, in their order."""
    return [module for unit in units_of(model) for module in unit]
