"""Parts of sharded tensors: which one this rank holds, and reading any part of saved ones.

Each rank saves its own parts of the optimizer's state in a safetensors file, with the place of
each part in its header, in the layout that torch.distributed.checkpoint's
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
"""Header entry: JSON of ``{name: [...]}``, the shapes of the whole tensors."""


@dataclass(frozen=True)
class Region:
    """A block of a tensor: where it begins and how long it is in each dimension."""

    offsets: tuple[int, ...]
    sizes: tuple[int, ...]

    @classmethod
    def of(cls, tensor: Tensor) -> Region:
        """This rank's part of ``tensor``; all of it if it is not sharded.

        Raises:
            CheckpointError: it is split in a way that is not a block.
        """
        offsets, sizes = [0] * tensor.ndim, list(tensor.shape)
        if is_dtensor(tensor):
            for along, dim in splits(tensor).items():
                # As torch.chunk cuts: equal parts, the last ones shorter or empty.
                part = -(-sizes[dim] // tensor.device_mesh.size(along))
                begin = min(tensor.device_mesh.get_local_rank(along) * part, sizes[dim])
                offsets[dim] += begin
                sizes[dim] = min(part, sizes[dim] - begin)
            if tuple(sizes) != tuple(tensor.to_local().shape):
                raise CheckpointError(
                    f"a tensor that is split by {tensor.placements} cannot be saved or loaded",
                    cause="only splits into one block per process can",
                )
        return cls(tuple(offsets), tuple(sizes))

    @property
    def slices(self) -> tuple[slice, ...]:
        """Slices that select this region of the full tensor."""
        return tuple(slice(o, o + n) for o, n in zip(self.offsets, self.sizes, strict=True))

    def common(self, other: Region) -> Region | None:
        """The block that lies in both, in whole coordinates; None if there is none."""
        begins = [max(pair) for pair in zip(self.offsets, other.offsets, strict=True)]
        ends = [
            min(a + n, b + m)
            for a, n, b, m in zip(self.offsets, self.sizes, other.offsets, other.sizes, strict=True)
        ]
        sizes = [end - begin for begin, end in zip(begins, ends, strict=True)]
        return Region(tuple(begins), tuple(sizes)) if all(n > 0 for n in sizes) else None

    def inside(self, outer: Region) -> tuple[slice, ...]:
        """Slices that select this region of a tensor that holds just ``outer``."""
        moved = [o - p for o, p in zip(self.offsets, outer.offsets, strict=True)]
        return Region(tuple(moved), self.sizes).slices


def is_split(tensor: Tensor) -> bool:
    """Whether more than one rank is needed to put ``tensor`` together."""
    return is_dtensor(tensor) and any(
        tensor.device_mesh.size(along) > 1 for along in splits(tensor)
    )


def own_parts(tensors: Mapping[str, Tensor], first: bool) -> dict[str, Tensor]:
    """The local shards of ``tensors`` that this rank saves; each shard is saved by one rank.

    Args:
        first: whether this rank saves what is not split.
    """
    found = {}
    for name, tensor in tensors.items():
        if not is_dtensor(tensor):
            mine = first
        else:
            mesh, cut = tensor.device_mesh, splits(tensor)
            copies = [along for along in range(mesh.ndim) if along not in cut]
            mine = all(mesh.get_local_rank(dim) == 0 for dim in copies)
            region = Region.of(tensor)
            mine = mine and (prod(region.sizes) > 0 or not any(region.offsets))
        if mine:
            found[name] = tensor
    return found


def describe_parts(tensors: Mapping[str, Tensor]) -> dict[str, str]:
    """Description of this rank's parts of ``tensors``, for the header of their file."""
    places = {name: {"saved_offsets": Region.of(t).offsets} for name, t in tensors.items()}
    shapes = {name: list(t.shape) for name, t in tensors.items()}
    return {PLACES: json.dumps(places), "DCP_VERSION": "1.0", SHAPES: json.dumps(shapes)}


class Stored:
    """One tensor in the files of a checkpoint; indexing reads what is asked for, and no more."""

    def __init__(self, name: str, shape: Sequence[int]) -> None:
        self.name = name
        self.shape = torch.Size(shape)
        self._parts: list[tuple[Any, Region]] = []

    def add(self, file: Any, region: Region) -> None:
        """``file``, opened by safetensors, has ``region`` under this name."""
        self._parts.append((file, region))

    def __getitem__(self, where: tuple[slice, ...]) -> Tensor:
        """A block, on the CPU; it may be a view of the file.

        Raises:
            CheckpointError: parts of it are in no file.
        """
        ranges = [s.indices(length) for s, length in zip(where, self.shape, strict=True)]
        wanted = Region(
            tuple(begin for begin, _, _ in ranges), tuple(end - begin for begin, end, _ in ranges)
        )
        for file, region in self._parts:
            if region == wanted:
                whole: Tensor = file.get_tensor(self.name)
                return whole
        out: Tensor | None = None
        found = 0
        for file, region in self._parts:
            both = wanted.common(region)
            if both is None:
                continue
            piece: Tensor = file.get_slice(self.name)[both.inside(region)]
            if out is None:
                out = torch.empty(wanted.sizes, dtype=piece.dtype)
            out[both.inside(wanted)] = piece
            found += prod(both.sizes)
        if found != prod(wanted.sizes):
            raise CheckpointError(f"parts of {self.name} are in no file of the checkpoint")
        if out is None:  # nothing was asked for: this rank's part is empty
            file, region = self._parts[0]
            none = tuple(slice(0, 0) if n == 0 else slice(0, n) for n in wanted.sizes)
            out = torch.empty(wanted.sizes, dtype=file.get_slice(self.name)[none].dtype)
        return out


@dataclass(frozen=True)
class _Place:
    saved_offsets: tuple[Count, ...]


class StoredTensors(Mapping[str, Stored]):
    """The tensors of one or several safetensors files, by name; parts of one belong together.

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
            self._tensors.setdefault(name, Stored(name, shape)).add(file, Region(offsets, sizes))

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
    """Let whatever goes wrong with the file in the block be a CheckpointError."""
    from safetensors import SafetensorError

    try:
        yield
    except (OSError, KeyError, ValueError, TypeError, SafetensorError) as error:
        raise CheckpointError(f"{path.name} cannot be read: {error}", where=str(path)) from error


def _check_header(path: Path) -> None:
    """Refuse a header that would take minutes, before it is parsed."""
    if not os.path.isfile(path):
        raise ValueError("it is missing, or no regular file")
    with path.open("rb") as file:
        (length,) = struct.unpack("<Q", file.read(8).ljust(8, b"\0"))
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


def splits(tensor: DTensor) -> dict[int, int]:
    """Dimension of the mesh -> dimension of ``tensor`` that is cut along it."""
    from torch.distributed.tensor import Shard

    return {d: p.dim for d, p in enumerate(tensor.placements) if isinstance(p, Shard)}


def local(tensor: Tensor) -> Tensor:
    """This rank's part of ``tensor``, without its gradient: all of it if it is not a DTensor."""
    tensor = tensor.detach()
    return tensor.to_local() if is_dtensor(tensor) else tensor
