"""Which tensors are spread over ranks, asked without importing what spreads them.

``torch.distributed.tensor`` takes a second to import, which a robot that loads a policy, or a run
in one process, has no use for.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, TypeGuard

from torch import Tensor

if TYPE_CHECKING:
    from torch.distributed.tensor import DTensor


def is_dtensor(tensor: object) -> TypeGuard[DTensor]:
    """Whether ``tensor`` is a DTensor; where nobody has imported their module there are none."""
    return isinstance(tensor, getattr(sys.modules.get("torch.distributed.tensor"), "DTensor", ()))


def splits(tensor: DTensor) -> dict[int, int]:
    """Dimension of the mesh -> dimension of ``tensor`` that is cut along it."""
    from torch.distributed.tensor import Shard

    return {d: p.dim for d, p in enumerate(tensor.placements) if isinstance(p, Shard)}


def local(tensor: Tensor) -> Tensor:
    """This rank's part of ``tensor``, without its gradient: all of it if it is not a DTensor."""
    tensor = tensor.detach()
    return tensor.to_local() if is_dtensor(tensor) else tensor
