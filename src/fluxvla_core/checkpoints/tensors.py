"""Named tensors to and from safetensors files: full tensors, however they are sharded in memory.

The format (https://huggingface.co/docs/safetensors, 'Format'): eight bytes little-endian header
length, a JSON header ``{name: {dtype, shape, data_offsets}}``, then the raw little-endian bytes.
It is written here rather than by the library so that tensors can be gathered, hashed and written
one by one: no process ever holds a second copy of the model.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from fluxvla_core.checkpoints.shards import (
    Block,
    Stored,
    is_dtensor,
    is_sharded,
    open_tensors,
    reading,
    shard_metadata,
    to_local,
)
from fluxvla_core.checkpoints.writer import CheckpointWriter
from fluxvla_core.errors import CheckpointError
from fluxvla_core.untrusted import parse_json

_DTYPES: Mapping[torch.dtype, str] = {
    torch.float64: "F64",
    torch.float32: "F32",
    torch.float16: "F16",
    torch.bfloat16: "BF16",
    torch.int64: "I64",
    torch.int32: "I32",
    torch.int16: "I16",
    torch.int8: "I8",
    torch.uint8: "U8",
    torch.bool: "BOOL",
}
_ALIASES = "aliases"


def full_tensor(tensor: Tensor) -> Tensor:
    """The full tensor, gathered from all ranks if it is a DTensor; every rank must call this."""
    tensor = tensor.detach()
    return tensor.full_tensor() if is_dtensor(tensor) else tensor


def copy_full(target: Tensor, source: Tensor) -> None:
    """Copy the full ``source`` into ``target``, into this rank's shard of it if it is sharded."""
    with torch.no_grad():
        target.copy_(shard_like(target, source))


def shard_like(target: Tensor, source: Tensor | Stored) -> Tensor:
    """The full ``source``, sharded and placed like ``target``, without communication."""
    # Each rank cuts out its own shard: all have read the same verified files.
    shard = source[Block.of(target).slices].to(target.device)
    if not is_dtensor(target):
        return shard
    return type(target).from_local(
        shard.contiguous(),
        target.device_mesh,
        target.placements,
        run_check=False,
        shape=target.shape,
        stride=target.stride(),
    )


@dataclass(frozen=True)
class TensorFile:
    """A safetensors file that is to be written.

    Args:
        name: in the checkpoint's folder.
        header: what stands before the data.
        tensors: in the order of the header. Sharded ones are gathered when they are written or
            copied, in which all ranks take part.
        mine: whether this rank writes the file.
    """

    name: str
    header: bytes
    tensors: tuple[Tensor, ...]
    mine: bool

    @classmethod
    def full(cls, name: str, tensors: Mapping[str, Tensor], mine: bool) -> TensorFile:
        """One file with all of ``tensors``; all ranks make it, one of them writes it.

        Two names for one tensor (tied weights) are stored once, with the other name in the header.

        Raises:
            CheckpointError: a dtype that the format does not have.
        """
        owner: dict[int, str] = {}
        aliases: dict[str, str] = {}
        for key, tensor in tensors.items():
            first = owner.setdefault(id(tensor), key)
            if first != key:
                aliases[key] = first
        stored = {key: tensors[key] for key in _ordered(owner.values(), tensors)}
        header = _header(stored, {_ALIASES: json.dumps(aliases)})
        return cls(name, header, tuple(stored.values()), mine)

    @classmethod
    def shards(cls, name: str, tensors: Mapping[str, Tensor]) -> TensorFile:
        """A file of this rank with its shards of ``tensors``.

        Raises:
            CheckpointError: a dtype that the format does not have.
        """
        named = {key: tensors[key] for key in _ordered(tensors, tensors)}
        shards = {key: to_local(tensor) for key, tensor in named.items()}
        return cls(name, _header(shards, shard_metadata(named)), tuple(shards.values()), True)

    def gathered(self, keep: Callable[[int, Tensor], Tensor]) -> TensorFile:
        """This file with full tensors instead of shards; all ranks call it, writers get tensors.

        Args:
            keep: called with the index of each tensor that had to be gathered and the full tensor,
                before the next is gathered; what it returns is held instead.
        """
        held: list[Tensor] = []
        for index, tensor in enumerate(self.tensors):
            sharded = is_sharded(tensor)
            full = full_tensor(tensor) if self.mine or sharded else tensor
            if self.mine:
                held.append(keep(index, full) if sharded else full)
        return replace(self, tensors=tuple(held))

    def write(self, writer: CheckpointWriter) -> None:
        """Write it, one tensor at a time in memory."""
        if not self.mine:
            self.gathered(lambda index, tensor: tensor)
            return
        with writer.open(self.name) as file:
            file.write(struct.pack("<Q", len(self.header)) + self.header)
            for tensor in self.tensors:
                file.write(_bytes(full_tensor(tensor)))


def _ordered(keys: Iterable[str], tensors: Mapping[str, Tensor]) -> list[str]:
    # Widest first keeps every tensor aligned to its own width.
    return sorted(keys, key=lambda key: (-tensors[key].element_size(), key))


def _header(tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> bytes:
    table: dict[str, Any] = {"__metadata__": {"format": "pt", **metadata}}
    begin = 0
    for key, tensor in tensors.items():
        if tensor.dtype not in _DTYPES:
            raise CheckpointError(f"tensor {key} has dtype {tensor.dtype}, which cannot be saved")
        end = begin + tensor.numel() * tensor.element_size()
        table[key] = {
            "dtype": _DTYPES[tensor.dtype],
            "shape": list(tensor.shape),
            "data_offsets": [begin, end],
        }
        begin = end
    text = json.dumps(table).encode()
    return text + b" " * (-len(text) % 8)


def _bytes(tensor: Tensor) -> memoryview:
    flat = tensor.cpu().contiguous().reshape(-1)
    return memoryview(flat.view(torch.uint8).numpy().data if flat.numel() else b"")


def read_tensors(path: Path) -> dict[str, Tensor]:
    """All tensors of a safetensors file, on the CPU.

    Raises:
        CheckpointError: the file cannot be read as that format.
    """
    with reading(path), open_tensors(path) as file:
        header = file.metadata() or {}
        tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    place = f"{path}: {_ALIASES}"
    aliases = parse_json(header.get(_ALIASES, "{}"), dict[str, str], CheckpointError, place)
    lacking = sorted(set(aliases.values()) - set(tensors))
    if lacking:
        raise CheckpointError(f"{path.name} has no {lacking[0]!r}, which it names", where=str(path))
    return tensors | {key: tensors[first] for key, first in aliases.items()}


def check_names(
    found: Mapping[str, Tensor | Stored],
    wanted: Mapping[str, Tensor],
    what: str,
    where: str,
    next: str = "resume with the config that made it: config.resolved.json in its folder",
) -> None:
    """Refuse tensors that are not those of this model; ``next`` is what to do about it.

    Raises:
        CheckpointError: lists missing, unexpected and mis-sized names, a few of each.
    """
    missing = sorted(set(wanted) - set(found))
    unexpected = sorted(set(found) - set(wanted))
    sizes = [
        f"{name}: {tuple(found[name].shape)} in the checkpoint, {tuple(wanted[name].shape)} here"
        for name in sorted(set(found) & set(wanted))
        if found[name].shape != wanted[name].shape
    ]
    lines = [
        f"    {len(items)} {kind}: {'; '.join(items[:4])}{' …' if len(items) > 4 else ''}"
        for kind, items in (
            ("missing in the checkpoint", missing),
            ("unexpected in the checkpoint", unexpected),
            ("of another size", sizes),
        )
        if items
    ]
    if lines:
        raise CheckpointError(
            f"{what} of the checkpoint are not this model's:\n" + "\n".join(lines),
            where=where,
            cause="it was made by another model, or by another version of this one",
            next=next,
        )
