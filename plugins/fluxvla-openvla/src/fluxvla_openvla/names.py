"""Published tensor names to the names of this package's models.

Four layouts are known:

* Hugging Face's (``openvla/openvla-7b``): this package's models have the same names.
* the native one of a training with Prismatic's code: ``latest-checkpoint.pt``.
* what OpenVLA-OFT saves next to the former: ``action_head--{step}_checkpoint.pt``,
  ``proprio_projector--…`` and ``noisy_action_projector--…``.
* its ``vision_backbone--…`` of a training with FiLM, whose LoRA matrices are not merged.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

import torch
from torch import Tensor

from fluxvla_core.errors import CheckpointError

PARTS = ("action_head", "proprio_projector", "noisy_action_projector")
"""OpenVLA-OFT's own files; also the names of the parts here."""
_NATIVE = (
    ("vision_backbone.dino_featurizer.", "vision_backbone.featurizer."),
    ("vision_backbone.siglip_featurizer.", "vision_backbone.fused_featurizer."),
    ("projector.projector.0.", "projector.fc1."),
    ("projector.projector.2.", "projector.fc2."),
    ("projector.projector.4.", "projector.fc3."),
    ("llm_backbone.llm.", "language_model."),
)
_LORA = re.compile(r"\.lora_[AB]\.default\.weight$")
_LORA_ALPHA = 16
_LORA_RANK = 32


def native_name(name: str) -> str:
    """The Hugging Face layout's name of a native one (``part.name``); others stay."""
    for theirs, ours in _NATIVE:
        if name.startswith(theirs):
            name = ours + name.removeprefix(theirs)
            break
    return re.sub(r"\.ls([12])\.gamma$", r".ls\1.scale_factor", name)


def part_name(part: str, name: str) -> str:
    """A name in a file of OpenVLA-OFT -> here. ``module.`` is what DDP puts in front."""
    return f"{part}.{name.removeprefix('module.')}"


def film_name(name: str) -> str:
    """A name in ``vision_backbone--…`` of a training with FiLM -> here.

    Its towers are inside a wrapper, and its blocks inside another.
    """
    plain = name.removeprefix("module.")
    return re.sub(r"\.blocks\.(\d+)\.block\.", r".blocks.\1.", plain)


def published_film_name(name: str) -> str:
    """The inverse of ``film_name``."""
    return re.sub(r"\.blocks\.(\d+)\.(?!scale\.|shift\.)", r".blocks.\1.block.", name)


def is_buffer(name: str) -> bool:
    """Whether a published tensor follows from the sizes: old files hold rotary frequencies."""
    return name.endswith(".rotary_emb.inv_freq")


def merge_lora(tensors: Mapping[str, Tensor], where: str) -> dict[str, Tensor]:
    """Add unmerged LoRA matrices to their layers: ``W + B A * alpha / rank``.

    OpenVLA-OFT takes ``alpha = min(rank, 16)``. Names without LoRA stay as they are.

    Args:
        tensors: as peft names them: ``x.base_layer.weight``, ``x.lora_A.default.weight``, …
        where: the file, for errors.

    Raises:
        CheckpointError: a matrix lacks its counterpart.
    """
    merged = {
        name.replace(".base_layer.", "."): tensor
        for name, tensor in tensors.items()
        if not _LORA.search(name)
    }
    stems = {_LORA.sub("", name) for name in tensors if _LORA.search(name)}
    for stem in sorted(stems):
        weight = f"{stem}.weight"
        down, up = (tensors.get(f"{stem}.lora_{side}.default.weight") for side in "AB")
        if down is None or up is None or weight not in merged:
            raise CheckpointError(f"the LoRA matrices of {stem!r} are not complete", where=where)
        base, rank = merged[weight], len(down)
        # A convolution's are 4-dimensional: (rank, in, h, w) and (out, rank, 1, 1).
        added = (up.float().flatten(1) @ down.float().flatten(1)).reshape(base.shape)
        merged[weight] = (base.float() + added * (min(rank, _LORA_ALPHA) / rank)).to(base.dtype)
    return merged


def with_lora(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The inverse of ``merge_lora``: matrices of rank 32 that add nothing, where the authors' code
    has some: on every layer of the towers but FiLM's own."""
    found: dict[str, Tensor] = {}
    for name, tensor in tensors.items():
        stem, _, kind = name.rpartition(".")
        weight = tensors.get(f"{stem}.weight")
        plain = weight is None or weight.ndim < 2 or stem.endswith((".scale", ".shift"))
        if plain or kind not in ("weight", "bias"):
            found[name] = tensor
            continue
        found[f"{stem}.base_layer.{kind}"] = tensor
        if kind == "weight":
            ones = (1,) * (tensor.ndim - 2)
            found[f"{stem}.lora_A.default.weight"] = tensor.new_zeros(_LORA_RANK, *tensor.shape[1:])
            found[f"{stem}.lora_B.default.weight"] = tensor.new_zeros(
                len(tensor), _LORA_RANK, *ones
            )
    return found


def flatten_native(parts: Mapping[str, object], where: str) -> dict[str, Tensor]:
    """``checkpoint["model"]`` of the native layout -> names of the Hugging Face layout.

    Raises:
        CheckpointError: it is not a table of tables of tensors.
    """
    found: dict[str, Tensor] = {}
    for part, tensors in parts.items():
        if not isinstance(tensors, Mapping):
            raise CheckpointError(f"{part!r} is not a table of tensors", where=where)
        for name, tensor in tensors.items():
            if not isinstance(tensor, torch.Tensor):
                raise CheckpointError(f"{part}.{name} is not a tensor", where=where)
            found[native_name(f"{part}.{name}")] = tensor
    return found
