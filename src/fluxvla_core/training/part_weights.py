"""Published weights of a part of a model: a vision tower or a language model of another project.

Such a part is published alone, under the names of its project; the rest of the model is initialised
randomly. ``PartWeights`` says which names correspond.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torch import Tensor, nn

from fluxvla_core.checkpoints.foreign import HUB, foreign_folder, safetensors_in, torch_table
from fluxvla_core.checkpoints.shards import Stored, StoredTensors
from fluxvla_core.contracts.training import PartWeights
from fluxvla_core.errors import CheckpointError
from fluxvla_core.training.weights import load_full_tensors, weights_by_name

_SHOWN = 6
_PICKLED = (".pt", ".pth", ".bin")
_INSIDE = ("model", "state_dict")
"""Keys under which a file may have its table of tensors."""


def load_part_weights(model: nn.Module, parts: Sequence[PartWeights]) -> None:
    """Load the published weights of ``parts`` into a freshly built ``model``.

    Raises:
        CheckpointError: a file is missing or damaged, or its tensors are not those of the part;
            lists missing and left-over ones, and those of another size.
    """
    for part in parts:
        load_full_tensors(model, matched(tensors_at(part.place), weights_by_name(model), part))


def matched(
    tensors: Mapping[str, Tensor | Stored], wanted: Mapping[str, Tensor], part: PartWeights
) -> dict[str, Tensor | Stored]:
    """``tensors`` under the names of ``wanted``, as far as ``part`` names them.

    Raises:
        CheckpointError: as ``load_part_weights``.
    """
    source_names = {name: other for name in wanted if (other := _other_name(name, part.names))}
    if not source_names:
        parts = ", ".join(dict.fromkeys(name.partition(".")[0] for name in wanted))
        raise CheckpointError(
            f"no weight of the model has {' or '.join(map(repr, part.names))} in its name",
            where=part.place,
            cause=f"the model's parts are {parts}",
        )
    available = {name for name, other in source_names.items() if other in tensors}
    tied = {id(wanted[name]) for name in available}  # two names here of what has one name there
    missing = [
        n
        for name, n in source_names.items()
        if name not in available and id(wanted[name]) not in tied
    ]
    used = set(source_names.values())
    extra = [n for n in tensors if n not in used and not any(text in n for text in part.unread)]
    sizes = [
        f"{source_names[name]}: {tuple(tensors[source_names[name]].shape)} there, "
        f"{tuple(wanted[name].shape)} here"
        for name in sorted(available)
        if tensors[source_names[name]].shape != wanted[name].shape
    ]
    kinds = (("missing", missing), ("left over", extra), ("of another size", sizes))
    lines = [
        f"    {len(items)} {kind}: {', '.join(sorted(items)[:_SHOWN])}"
        f"{' …' if len(items) > _SHOWN else ''}"
        for kind, items in kinds
        if items
    ]
    if lines:
        named = ", ".join(f"{own!r} is {other!r} there" for own, other in part.names.items())
        raise CheckpointError(
            "the tensors are not those of the part that they are for:\n" + "\n".join(lines),
            where=part.place,
            cause="they are of another model, or their names correspond in another way to those "
            f"here: {named}",
        )
    return {name: tensors[source_names[name]] for name in sorted(available)}


def tensors_at(place: str | Path) -> Mapping[str, Tensor | Stored]:
    """The tensors of a safetensors file, a folder of them (or ``hf:<id>``), or a file of torch's.

    A file of ``torch.save`` is read as data only: no object in it is built.

    Raises:
        CheckpointError: there is nothing there, or it holds no table of tensors.
    """
    path = Path(place).expanduser()
    if str(place).startswith(HUB) or path.is_dir():
        folder = foreign_folder(place)
        if any((folder / f"model.safetensors{end}").is_file() for end in ("", ".index.json")):
            return safetensors_in(folder)
        files = sorted(folder.glob("*.safetensors"))
        if not files:
            raise CheckpointError("there is no safetensors file", where=str(folder))
        return StoredTensors(files)
    if not path.is_file():
        raise CheckpointError(f"there are no weights at {path}")
    if path.suffix == ".safetensors":
        return StoredTensors([path])
    if path.suffix in _PICKLED:
        return _of_torch(path)
    raise CheckpointError(
        f"weights are read from files that end in .safetensors, {', '.join(_PICKLED)}, or a folder",
        where=str(path),
    )


def _other_name(name: str, names: Mapping[str, str]) -> str | None:
    """What the weight ``name`` is called there, by the longest of ``names`` that is in it."""
    own = max((text for text in names if text in name), key=len, default=None)
    return None if own is None else name.replace(own, names[own], 1)


def _of_torch(path: Path) -> dict[str, Tensor]:
    content = torch_table(path)
    tables = (content[key] for key in _INSIDE if isinstance(content.get(key), dict))
    found: dict[str, Any] = next(tables, content)
    if not all(isinstance(value, Tensor) for value in found.values()):
        raise CheckpointError("it holds no table of tensors", where=str(path))
    return {str(name): tensor for name, tensor in found.items()}
