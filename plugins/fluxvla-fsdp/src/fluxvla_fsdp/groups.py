"""The groups that a model's weights are gathered in."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch
    from torch import nn


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
    from fluxvla_fsdp.norms import kept_fp32

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
