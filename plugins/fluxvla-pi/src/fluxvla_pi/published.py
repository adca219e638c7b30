"""Weights and settings of published files: reading them, and what writing them needs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from math import isqrt
from pathlib import Path
from typing import Any

import torch
from fluxvla_models.lerobot_files import full_tensor
from torch import Tensor, nn

from fluxvla_core.errors import CheckpointError
from fluxvla_core.models import ForeignCheckpoint, Stored, safetensors_in
from fluxvla_pi.flow_matching import PiFlowMatching
from fluxvla_pi.names import Layout, actual_names, layout_of, published, sources
from fluxvla_pi.pi0 import PI0FlowMatching
from fluxvla_pi.pi0_fast import PI0FAST
from fluxvla_pi.pi05 import PI05FlowMatching
from fluxvla_pi.sizes import GEMMA, SIGLIP, GemmaSize, SiglipSize

FAST = "pi0_fast"
FAMILIES: Mapping[str, type[PiFlowMatching]] = {"pi0": PI0FlowMatching, "pi05": PI05FlowMatching}
# Neither follows from shapes: all published towers have 16 heads, and all their code 1 key.
VISION_HEADS, KEY_HEADS = 16, 1
_EMBEDDING = "llm_backbone.embed_tokens.weight"


@dataclass(frozen=True)
class Weights:
    """The weights of a file.

    Args:
        family: ``pi0``, ``pi05`` or ``pi0_fast``.
        model: the config's table, without ``n_action_steps`` and, of PI0-FAST, ``action_dim`` and
            ``tokenizer``, which do not follow from shapes.
        tensors: by our names.
    """

    family: str
    model: dict[str, Any]
    tensors: Mapping[str, Stored]


def weights_in(folder: Path, besides: Iterable[str] = ()) -> Weights:
    """The weights in ``folder/model.safetensors``, and the model that follows from their shapes.

    Args:
        besides: tensors in the file that are none of the model's.

    Raises:
        CheckpointError: they are of another model, or there are more or fewer of them.
    """
    left_out = set(besides)
    tensors = {n: t for n, t in safetensors_in(folder).items() if n not in left_out}
    where = str(folder)
    layout = layout_of(tensors, where)
    shapes = {name: tuple(t.shape) for name, t in tensors.items()}
    found = _Shapes(shapes, layout, where)
    family = found.family()
    table = found.table(family)
    with torch.device("meta"):
        wanted = _built(family, table).state_dict()
    names = sources(wanted, tensors, where)
    wrong = [
        f"{theirs}: {shapes[theirs]}, expected {tuple(wanted[ours].shape)}"
        for ours, theirs in names.items()
        if shapes[theirs] != tuple(wanted[ours].shape)
    ]
    if wrong:
        raise CheckpointError(f"tensors of another size: {'; '.join(wrong[:5])}", where=where)
    kind = PI0FAST if family == FAST else FAMILIES[family]
    model = {"type": kind.__name__, **table}
    return Weights(family, model, {ours: tensors[theirs] for ours, theirs in names.items()})


class _Shapes:
    """Shapes of a file's tensors, by our names."""

    def __init__(self, shapes: Mapping[str, tuple[int, ...]], layout: Layout, where: str) -> None:
        self._shapes = {long: shapes[name] for long, name in actual_names(shapes, layout).items()}
        self._layout = layout
        self._where = where

    def has(self, ours: str) -> bool:
        return self._layout.theirs(ours) in self._shapes

    def family(self) -> str:
        """Which model it is: PI0-FAST has no expert, PI0 embeds times in another way."""
        if not self._depth("llm_expert.layers", "self_attn.q_proj.weight"):
            return FAST
        return "pi05" if self.has("time_mlp_in.weight") else "pi0"

    def table(self, family: str) -> dict[str, Any]:
        """The model's arguments that follow from shapes."""
        vocabulary, _ = self._two(self._embedding())
        table: dict[str, Any] = {
            "variant": _named(self._gemma("llm_backbone"), GEMMA),
            "vision_variant": _named(self._siglip(), SIGLIP),
            "vocab_size": vocabulary,
        }
        if family == FAST:
            both = self.has(_EMBEDDING) and self.has("lm_head.weight")
            return {**table, "tied_head": not both}
        action, _ = self._two("action_out_proj.weight")
        table["expert_variant"] = _named(self._gemma("llm_expert"), GEMMA)
        table["max_action_dim"] = action
        if family == "pi0":
            table["max_state_dim"] = self._two("state_proj.weight")[1]
        return table

    def _gemma(self, part: str) -> GemmaSize:
        queries, width = self._two(f"{part}.layers.0.self_attn.q_proj.weight")
        keys, _ = self._two(f"{part}.layers.0.self_attn.k_proj.weight")
        hidden, _ = self._two(f"{part}.layers.0.mlp.gate_proj.weight")
        head = keys // KEY_HEADS
        depth = self._depth(f"{part}.layers", "self_attn.q_proj.weight")
        return GemmaSize(width, depth, hidden, queries // head, KEY_HEADS, head)

    def _siglip(self) -> SiglipSize:
        tower = "vision_backbone"
        width, _, patch, _ = self._shape(f"{tower}.patch_embedding.weight", 4)
        patches, _ = self._two(f"{tower}.position_embedding.weight")
        hidden, _ = self._two(f"{tower}.layers.0.mlp.fc1.weight")
        depth = self._depth(f"{tower}.layers", "mlp.fc1.weight")
        return SiglipSize(width, depth, hidden, VISION_HEADS, isqrt(patches) * patch, patch)

    def _depth(self, layers: str, name: str) -> int:
        depth = 0
        while self.has(f"{layers}.{depth}.{name}"):
            depth += 1
        return depth

    def _embedding(self) -> str:
        head = self._layout.head
        known = self.has(_EMBEDDING) or not head
        return _EMBEDDING if known else head.removeprefix(self._layout.root)

    def _two(self, ours: str) -> tuple[int, int]:
        rows, columns = self._shape(ours, 2)
        return rows, columns

    def _shape(self, ours: str, dimensions: int) -> tuple[int, ...]:
        name = self._layout.theirs(ours)
        shape = self._shapes.get(name)
        if shape is None or len(shape) != dimensions or 0 in shape:
            what = "is missing" if shape is None else f"has shape {shape}"
            raise CheckpointError(
                f"{name} {what}, by which the size of the model is known",
                where=self._where,
                cause="the file is damaged, or of another model",
            )
        return shape


def _built(family: str, table: Mapping[str, Any]) -> nn.Module:
    """The model, where its weights take no memory."""
    if family != FAST:
        return FAMILIES[family](**table)
    return PI0FAST({}, words={"vocab_size": table["vocab_size"]}, **table)


def _named(size: Any, known: Mapping[str, Any]) -> Any:
    """The name of ``size`` where it has one, else its numbers."""
    return next((name for name, other in known.items() if other == size), asdict(size))


# -- writing ---------------------------------------------------------------------------------


def family_of(checkpoint: ForeignCheckpoint) -> str:
    """``pi0`` or ``pi05``."""
    kind = str(checkpoint.model["type"]).rpartition(":")[2]
    return next(family for family, cls in FAMILIES.items() if cls.__name__ == kind)


def weights_to_write(checkpoint: ForeignCheckpoint, layout: Layout) -> dict[str, Tensor]:
    """The weights under the names of ``layout``, and what nothing uses as zeros."""
    names = published(list(checkpoint.tensors), layout)
    found = {theirs: full_tensor(checkpoint.tensors[ours]) for theirs, ours in names.items()}
    embedding = full_tensor(checkpoint.tensors["llm_backbone.embed_tokens.weight"])
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
