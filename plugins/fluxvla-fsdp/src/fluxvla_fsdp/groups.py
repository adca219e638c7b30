"""The groups that a model's weights are gathered in, and which weights allow no such group."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from fluxvla_core.errors import ConfigError

if TYPE_CHECKING:
    import torch
    from torch import nn


REST = -1
"""In place of a unit's number: whatever is in none."""


@dataclass(frozen=True)
class Group:
    """Modules whose weights are gathered together, but for those in a group before.

    Args:
        modules: of one unit, or norms in it.
        lowered: whether they are gathered in the dtype that is computed in, where it is another.
        reshards: whether their weights are let go of after the forward pass.
    """

    modules: tuple[nn.Module, ...]
    lowered: bool
    reshards: bool

    def parameters(self) -> Iterator[nn.Parameter]:
        """Trained weights of the modules and of what is in them."""
        for module in self.modules:
            yield from (p for p in module.parameters() if p.requires_grad)


def groups_of(
    model: nn.Module, reshards: bool, compute_dtype: torch.dtype | None, device_type: str
) -> list[Group]:
    """The groups of ``model``, inner ones first; the last one has what is in no unit.

    Args:
        reshards: let go of a unit's weights after its forward pass.
        compute_dtype: what weights are gathered in; None for their own.
        device_type: ``cuda`` or ``cpu``.
    """
    from fluxvla_core.training import units_of

    norms = kept_fp32(model, device_type) if compute_dtype is not None else set()
    groups: list[Group] = []

    def split(modules: Sequence[nn.Module], reshards: bool) -> None:
        """As one group; those that need their weights in fp32 as another, inside."""
        apart = tuple(n for m in modules for n in m.modules() if n in norms)
        norms.difference_update(apart)
        rest = tuple(m for m in modules if m not in apart)
        groups.extend(
            Group(group, lowered, reshards)
            for group, lowered in ((apart, False), (rest, True))
            if group
        )

    for unit in units_of(model):
        split([m for m in unit if any(p.requires_grad for p in m.parameters())], reshards)
    # Whatever is in no unit is gathered first and used until the end: no use in letting go.
    split([model], False)
    return groups


def kept_fp32(model: nn.Module, device_type: str) -> set[nn.Module]:
    """The trained norms whose weights are gathered in fp32 where others are gathered in bf16.

    Batch and instance norms take weights of the dtype of their running statistics, or of an input
    in fp32. So do layer and group norms on a CPU, while autocast casts for them on a GPU.
    """
    from torch import nn
    from torch.nn.modules.batchnorm import _NormBase

    kinds: tuple[type[nn.Module], ...] = (_NormBase,)
    if device_type == "cpu":
        kinds = (*kinds, nn.LayerNorm, nn.GroupNorm)
    return {
        module
        for module in model.modules()
        if isinstance(module, kinds) and any(p.requires_grad for p in module.parameters())
    }


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
