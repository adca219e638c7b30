"""What formats need that write a checkpoint as other projects have it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from fluxvla_core.errors import CheckpointError
from fluxvla_core.models import ForeignCheckpoint, Stored
from fluxvla_pi.names import Layout, published
from fluxvla_pi.published import FAMILIES


def family_of(checkpoint: ForeignCheckpoint) -> str:
    """``pi0`` or ``pi05``."""
    kind = str(checkpoint.model["type"]).rpartition(":")[2]
    return next(family for family, cls in FAMILIES.items() if cls.__name__ == kind)


def weights_to_write(checkpoint: ForeignCheckpoint, layout: Layout) -> dict[str, Tensor]:
    """The weights under the names of ``layout``, and what nothing uses as zeros."""
    names = published(list(checkpoint.tensors), layout)
    found = {theirs: _whole(checkpoint.tensors[ours]) for theirs, ours in names.items()}
    embedding = _whole(checkpoint.tensors["llm_backbone.embed_tokens.weight"])
    expert = checkpoint.tensors.get("action_in_proj.weight")
    for name in layout.unused if expert is not None else ():
        found[name] = torch.zeros(len(embedding), expert.shape[0], dtype=embedding.dtype)
    owners: set[int] = set()
    for name, tensor in found.items():  # the format has no two names of one memory
        found[name] = tensor.clone() if tensor.data_ptr() in owners else tensor.contiguous()
        owners.add(tensor.data_ptr())
    return found


def table_of(checkpoint: ForeignCheckpoint, kind: str) -> Mapping[str, Any]:
    """The table of the transform ``kind``.

    Raises:
        CheckpointError: there is none: observations are prepared in another way.
    """
    for table in checkpoint.transforms:
        if str(table.get("type")).rpartition(":")[2] == kind:
            return table
    raise CheckpointError(
        f"there is no {kind} among the transforms; observations are prepared in a way "
        "that the format does not know"
    )


def only(table: Mapping[str, Any], key: str, wanted: Any, default: Any) -> None:
    """Check that a setting is the one that the format implies.

    Raises:
        CheckpointError: it is another.
    """
    value = table.get(key, default)
    if value != wanted:
        raise CheckpointError(
            f"{table['type']}: {key} is {value!r}; the format implies {wanted!r}",
            next=f"train with {key}={wanted!r}",
        )


def action_names(checkpoint: ForeignCheckpoint) -> Sequence[str] | None:
    """The names of the robot's joints, where the checkpoint describes the robot."""
    robot = checkpoint.embodiment
    return None if robot is None else tuple(joint.name for joint in robot.joints)


def _whole(tensor: Tensor | Stored) -> Tensor:
    if isinstance(tensor, Stored):
        return tensor[tuple(slice(0, n) for n in tensor.shape)]
    return tensor
