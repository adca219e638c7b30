"""Weights that stand in two places of a model, which torch splits within one unit only."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fluxvla_core.errors import ConfigError

if TYPE_CHECKING:
    from torch import nn

REST = -1
"""In place of a unit's number: whatever is in none."""


def check_ties(model: nn.Module, where: str | None) -> None:
    """Refuse trainable weights that are in two of the model's units, or in one and in the rest.

    Raises:
        ConfigError: names one such weight by both its names.
    """
    from fluxvla_core.training import units_of

    numbers = {id(module): i for i, unit in enumerate(units_of(model)) for module in unit}
    modules = model.named_modules(remove_duplicate=False)
    units = {path: numbers[id(module)] for path, module in modules if id(module) in numbers}
    seen: dict[int, tuple[str, int]] = {}
    for name, parameter in model.named_parameters(remove_duplicate=False):
        # Frozen weights stay whole: they may be anywhere.
        if not parameter.requires_grad:
            continue
        unit = _unit_of(name, units)
        first, other = seen.setdefault(id(parameter), (name, unit))
        if unit != other:
            raise ConfigError(
                f"{first} and {name} are one weight ({_place(other)} and {_place(unit)} of "
                f"{type(model).__name__})",
                where=where,
                cause="FSDP gathers and lets go of each unit's weights on their own, so a weight "
                "cannot be in two of them",
                next="put the modules that share it into one tuple of fsdp_units(), or leave both "
                "out of it; or use DDPTrainRunner",
            )


def _unit_of(name: str, units: dict[str, int]) -> int:
    """The number of the innermost unit around the parameter ``name``."""
    path = name
    while path:
        path = path.rpartition(".")[0]
        if path in units:
            return units[path]
    return REST


def _place(unit: int) -> str:
    return "outside all units" if unit == REST else f"in unit {unit}"
