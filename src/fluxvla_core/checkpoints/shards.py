"""Shards of tensors: which one this rank holds, and reading any block of saved tensors.

Each rank saves its own shards of the optimizer's state in a safetensors file, with the offsets
of each shard in its header, in the layout that torch.distributed.checkpoint's
``HuggingFaceStorageReader`` reads (torch/distributed/checkpoint/hf_storage.py). DCP's own writer
is not used: its default one pickles the metadata and its safetensors one forms each file in
memory as a whole, and neither can be hashed, flushed and failed one operation at a time.
"""

from __future__ import annotations

import json
import os
import struct
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeGuard, TypeVar

import torch
from torch import Tensor

from fluxvla_core.bounds import Count
from fluxvla_core.errors import CheckpointError
from fluxvla_core.untrusted import parse_json

if TYPE_CHECKING:
    from torch.distributed.tensor import DTensor


T = TypeVar("T")

PLACES = "DCP_SHARDING_INFO"
"""Header entry: JSON of ``{name: {"saved_offsets": [...]}}``."""
SHAPES = "shapes"
"""Header entry: JSON of ``{name: [...]}``, the shapes of the full tensors."""


@dataclass(frozen=True)
class Block:
    """A block of a tensor: where it begins and how long it is in each dimension."""

    offsets: tuple[int, ...]
    sizes: tuple[int, ...]

    @classmethod
    def of(cls, tensor: Tensor) -> Block:
        """This rank's shard of ``tensor``; all of it if it is not sharded.

        Raises:
            CheckpointError: it is sharded in a way that is not a block.
        """
        offsets, sizes = [0] * tensor.ndim, list(tensor.shape)
        if is_dtensor(tensor):
            for along, dim in shard_dims(tensor).items():
                # As torch.chunk cuts: equal parts, the last ones shorter or empty.
                length = -(-sizes[dim] // tensor.device_mesh.size(along))
                begin = min(tensor.device_mesh.get_local_rank(along) * length, sizes[dim])
                offsets[dim] += begin
                sizes[dim] = min(length, sizes[dim] - begin)
            if tuple(sizes) != tuple(tensor.to_local().shape):
                raise CheckpointError(
                    f"a tensor that is split by {tensor.placements} cannot be saved or loaded",
                    cause="only splits into one block per process can",
                )
        return cls(tuple(offsets), tuple(sizes))

    @property
    def slices(self) -> tuple[slice, ...]:
        """Slices that select this block of the full tensor."""
        return tuple(slice(o, o + n) for o, n in zip(self.offsets, self.sizes, strict=True))

    def intersection(self, other: Block) -> Block | None:
        """The block that both cover, in coordinates of the full tensor; None if there is none."""
        begins = [max(pair) for pair in zip(self.offsets, other.offsets, strict=True)]
        ends = [
            min(a + n, b + m)
            for a, n, b, m in zip(self.offsets, self.sizes, other.offsets, other.sizes, strict=True)
        ]
        sizes = [end - begin for begin, end in zip(begins, ends, strict=True)]
        return Block(tuple(begins), tuple(sizes)) if all(n > 0 for n in sizes) else None

    def relative_to(self, outer: Block) -> tuple[slice, ...]:
        """Slices that select this block of a tensor that holds just ``outer``."""
        moved = [o - p for o, p in zip(self.offsets, outer.offsets, strict=True)]
        return Block(tuple(moved), self.sizes).slices


def is_sharded(tensor: Tensor) -> bool:
    """Whether ``tensor`` is sharded over more than one rank."""
    return is_dtensor(tensor) and any(
        tensor.device_mesh.size(along) > 1 for along in shard_dims(tensor)
    )


def local_shards(tensors: Mapping[str, Tensor], is_rank0: bool) -> dict[str, Tensor]:
    """The local shards of ``tensors`` that this rank saves; each shard is saved by one rank.

    Args:
        is_rank0: whether this rank saves the unsharded tensors.
    """
    shards = {}
    for name, tensor in tensors.items():
        if not is_dtensor(tensor):
            mine = is_rank0
        else:
            mesh, cut = tensor.device_mesh, shard_dims(tensor)
            copies = [along for along in range(mesh.ndim) if along not in cut]
            mine = all(mesh.get_local_rank(dim) == 0 for dim in copies)
            block = Block.of(tensor)
            mine = mine and (prod(block.sizes) > 0 or not any(block.offsets))
        if mine:
            shards[name] = tensor
    return shards


def shard_metadata(tensors: Mapping[str, Tensor]) -> dict[str, str]:
    """Offsets and shapes of this rank's shards of ``tensors``, for the header of their file."""
    places = {name: {"saved_offsets": Block.of(t).offsets} for name, t in tensors.items()}
    shapes = {name: list(t.shape) for name, t in tensors.items()}
    return {PLACES: json.dumps(places), "DCP_VERSION": "1.0", SHAPES: json.dumps(shapes)}


class Stored:
    """One tensor in the files of a checkpoint; indexing reads only the selected part."""

    def __init__(self, name: str, shape: Sequence[int]) -> None:
        self.name = name
        self.shape = torch.Size(shape)
        self._shards: list[tuple[Any, Block]] = []

    def add(self, file: Any, block: Block) -> None:
        """``file``, opened by safetensors, has ``block`` under this name."""
        self._shards.append((file, block))

    def __getitem__(self, where: tuple[slice, ...]) -> Tensor:
        """A block, on the CPU; it may be a view of the file.

        Raises:
            CheckpointError: some of it is in no file.
        """
        ranges = [s.indices(length) for s, length in zip(where, self.shape, strict=True)]
        wanted = Block(
            tuple(begin for begin, _, _ in ranges), tuple(end - begin for begin, end, _ in ranges)
        )
        for file, block in self._shards:
            if block == wanted:
                whole: Tensor = file.get_tensor(self.name)
                return whole
        out: Tensor | None = None
        count = 0
        for file, block in self._shards:
            overlap = wanted.intersection(block)
            if overlap is None:
                continue
            piece: Tensor = file.get_slice(self.name)[overlap.relative_to(block)]
            if out is None:
                out = torch.empty(wanted.sizes, dtype=piece.dtype)
            out[overlap.relative_to(wanted)] = piece
            count += prod(overlap.sizes)
        if count != prod(wanted.sizes):
            raise CheckpointError(f"parts of {self.name} are in no file of the checkpoint")
        if out is None:  # nothing was asked for: this rank's part is empty
            file, block = self._shards[0]
            none = tuple(slice(0, 0) if n == 0 else slice(0, n) for n in wanted.sizes)
            out = torch.empty(wanted.sizes, dtype=file.get_slice(self.name)[none].dtype)
        return out


@dataclass(frozen=True)
class _Place:
    saved_offsets: tuple[Count, ...]


class StoredTensors(Mapping[str, Stored]):
    """The tensors of one or several safetensors files, by name; shards of one are joined.

    Raises:
        CheckpointError: a file cannot be read as that format.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        self._tensors: dict[str, Stored] = {}
        for path in paths:
            with reading(path):
                file = open_tensors(path)
                self._enter(path, file, file.metadata() or {})

    def _enter(self, path: Path, file: Any, header: Mapping[str, str]) -> None:
        def table(name: str, kind: type[T]) -> T:
            return parse_json(header.get(name, "{}"), kind, CheckpointError, f"{path}: {name}")

        places = table(PLACES, dict[str, _Place])
        shapes = table(SHAPES, dict[str, tuple[Count, ...]])
        for name in file.keys():  # noqa: SIM118 - it is not a mapping
            sizes = tuple(file.get_slice(name).get_shape())
            if places and name not in places:
                raise CheckpointError(f"{path.name} does not say where {name} belongs")
            offsets = places[name].saved_offsets if places else (0,) * len(sizes)
            shape = shapes.get(name, sizes)
            if not len(offsets) == len(sizes) == len(shape):
                raise CheckpointError(f"{path.name} contradicts itself about {name}")
            self._tensors.setdefault(name, Stored(name, shape)).add(file, Block(offsets, sizes))

    def __getitem__(self, name: str) -> Stored:
        return self._tensors[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._tensors)

    def __len__(self) -> int:
        return len(self._tensors)


# A model of 7 billion parameters has 300 to 3,000 tensors of some 150 bytes of header each, its
# optimizer's state twice as many; a mixture of 10,000 experts still fits.
_LARGEST_HEADER = 16 << 20
_MOST_TENSORS = 100_000
_LFS = b"version "
"""The first bytes of what Git leaves in the place of a large file."""


def open_tensors(path: Path) -> Any:
    """The file as safetensors opens it.

    Raises:
        ValueError, OSError, SafetensorError: as :func:`reading` expects them.
    """
    from safetensors import safe_open

    _check_header(path)
    return safe_open(path, framework="pt")


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Context manager: raise errors of reading the file as CheckpointError."""
    from safetensors import SafetensorError

    try:
        yield
    except (OSError, KeyError, ValueError, TypeError, SafetensorError) as error:
        raise CheckpointError(
            f"{path.name} cannot be read: {_shortfall(path) or error}",
            where=str(path),
            cause="it was copied or downloaded in part, or not as a safetensors file",
            next="copy or download it again",
        ) from error


def _shortfall(path: Path) -> str | None:
    """How a file's size differs from the one in its header; None if it does not, or without one."""
    try:
        _check_header(path)
        with path.open("rb") as file:
            (length,) = struct.unpack("<Q", file.read(8))
            header = json.loads(file.read(length))
        tensors = (entry for name, entry in header.items() if name != "__metadata__")
        stated = 8 + length + max((entry["data_offsets"][1] for entry in tensors), default=0)
        size = path.stat().st_size
    except (
        LookupError,
        OSError,
        ValueError,
        TypeError,
        AttributeError,
        RecursionError,
        struct.error,
    ):
        return None  # no header of that format
    return None if size == stated else f"it has {size} bytes instead of {stated}"


def _check_header(path: Path) -> None:
    """Refuse a header that would take minutes, before it is parsed."""
    if not os.path.isfile(path):
        raise ValueError("it is missing, or no regular file")
    with path.open("rb") as file:
        begin = file.read(8).ljust(8, b"\0")
        if begin == _LFS:
            raise ValueError("it is a pointer of Git LFS, not the file itself: git lfs pull")
        (length,) = struct.unpack("<Q", begin)
        if length > _LARGEST_HEADER:
            raise ValueError(
                f"its header of {length} bytes is larger than {_LARGEST_HEADER >> 20} MiB"
            )
        count = file.read(length).count(b'"data_offsets"')
    if count > _MOST_TENSORS:
        raise ValueError(f"it lists {count} tensors, {_MOST_TENSORS} are the most that are read")


def is_dtensor(tensor: object) -> TypeGuard[DTensor]:
    """Whether ``tensor`` is a DTensor; where nobody has imported their module there are none."""
    return isinstance(tensor, getattr(sys.modules.get("torch.distributed.tensor"), "DTensor", ()))


def shard_dims(tensor: DTensor) -> dict[int, int]:
    """Dimension of the mesh -> dimension of ``tensor`` that is sharded along it."""
    from torch.distributed.tensor import Shard

    return {d: p.dim for d, p in enumerate(tensor.placements) if isinstance(p, Shard)}


def to_local(tensor: Tensor) -> Tensor:
    """This rank's shard of ``tensor``, detached: all of it if it is not a DTensor."""
    tensor = tensor.detach()
    return tensor.to_local() if is_dtensor(tensor) else tensor
