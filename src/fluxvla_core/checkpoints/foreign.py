"""Files of other projects' checkpoints: where they are, and their tensors under other names."""

from __future__ import annotations

import inspect
import os
import pickle
import zipfile
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePath
from typing import Any

import torch
from torch import Tensor

from fluxvla_core.checkpoints.checkpoint import folders
from fluxvla_core.checkpoints.manifest import NAME as MANIFEST
from fluxvla_core.checkpoints.shards import Stored, StoredTensors
from fluxvla_core.contracts.checkpoint_format import CheckpointFormat, ForeignCheckpoint
from fluxvla_core.data.lerobot import camera_name
from fluxvla_core.errors import CheckpointError, PluginError, UsageError, located, nearest
from fluxvla_core.plugins.registry import CHECKPOINT_FORMATS
from fluxvla_core.registries import PREFIX
from fluxvla_core.untrusted import read_json

HUB = "hf:"
"""Before the id of a model on the Hugging Face hub."""
_INDEX = ".safetensors.index.json"
_SHOWN = 6


def safetensors_in(folder: str | Path, stem: str = "model") -> Mapping[str, Stored]:
    """The tensors of ``<stem>.safetensors``, or of the parts that its index lists.

    Nothing but the headers is read until a tensor is indexed.

    Raises:
        CheckpointError: there is neither, or a file that is listed is missing or damaged.
    """
    folder = Path(folder)
    single, index = folder / f"{stem}.safetensors", folder / f"{stem}{_INDEX}"
    if not os.path.lexists(index):
        return StoredTensors([single])
    content = read_json(index, dict[str, Any], CheckpointError)
    listed = content.get("weight_map")
    if not isinstance(listed, dict) or not all(isinstance(n, str) for n in listed.values()):
        raise CheckpointError("weight_map: no table of file names", where=str(index))
    names = sorted(set(listed.values()))
    outside = [name for name in names if PurePath(name).name != name]
    if outside:
        raise CheckpointError(f"{outside[0]!r} is not a file next to it", where=str(index))
    tensors = StoredTensors([folder / name for name in names])
    missing = sorted(set(listed) - set(tensors))
    if missing:
        raise CheckpointError(f"no file has {missing[0]!r}, which is listed", where=str(index))
    return tensors


def torch_table(file: Path) -> dict[str, Any]:
    """The content of a file of ``torch.save``: a table of tensors, or of tables of them.

    Published weights are pickles in places. They are read as data alone: no object is built.

    Raises:
        CheckpointError: it cannot be read so, or holds no table.
    """
    try:
        content: Any = torch.load(
            file, map_location="cpu", weights_only=True, mmap=zipfile.is_zipfile(file)
        )
    except (OSError, RuntimeError, ValueError, EOFError, pickle.UnpicklingError) as error:
        line = next(iter(str(error).splitlines()), type(error).__name__)
        raise CheckpointError(f"it cannot be read as tensors: {line}", where=str(file)) from error
    if not isinstance(content, dict):
        raise CheckpointError("it holds no table of tensors", where=str(file))
    return content


def check_settings(settings: Mapping[str, Any], known: Collection[str], where: str) -> None:
    """Refuse settings of another project's config that nobody here has heard of.

    A newer version, or a fork, may compute something else by them from the same weights. One that
    is off (null, false, 0, empty) is as if it were not there; names with ``_`` first are private.

    Args:
        known: every name that is read, or known to change no number.
        where: the file, for messages.

    Raises:
        CheckpointError: names the first such setting and its value.
    """
    unknown = [
        name
        for name, value in settings.items()
        if value and name not in known and not name.startswith("_")
    ]
    if unknown:
        name = unknown[0]
        close = nearest(name, known)
        raise CheckpointError(
            f"{name} is {str(settings[name])[:80]!r}, and no setting of that name is known here"
            + (f"; the nearest is {close!r}" if close else ""),
            where=where,
            cause="the checkpoint is of a newer version of its project, or of a fork, and may "
            "compute something else from the same weights",
            next="upgrade the plugin; or take the setting out of the file, if it changes nothing "
            "of what the model computes",
        )


class Renamed(Mapping[str, "Tensor | Stored"]):
    """``tensors`` under the names of ``names``: this project's -> the other's.

    Several names may be of one tensor (tied weights).
    """

    def __init__(self, tensors: Mapping[str, Tensor | Stored], names: Mapping[str, str]) -> None:
        self._tensors = tensors
        self._names = names

    def __getitem__(self, name: str) -> Tensor | Stored:
        return self._tensors[self._names[name]]

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


def renamed(
    tensors: Mapping[str, Tensor | Stored], names: Mapping[str, str], where: str
) -> Mapping[str, Tensor | Stored]:
    """``tensors`` under this project's names; every one must be named, and every name be there.

    Args:
        tensors: by the names of the checkpoint.
        names: the name here -> the name there.
        where: the checkpoint, for messages.

    Raises:
        CheckpointError: lists missing and unexpected names.
    """
    missing = sorted(set(names.values()) - set(tensors))
    extra = sorted(set(tensors) - set(names.values()))
    lines = [
        f"    {len(items)} {kind}: {', '.join(items[:_SHOWN])}{' …' if len(items) > _SHOWN else ''}"
        for kind, items in (("missing", missing), ("unexpected", extra))
        if items
    ]
    if lines:
        raise CheckpointError(
            "the tensors of the checkpoint are not those of its model:\n" + "\n".join(lines),
            where=where,
            cause="it was saved by another version of that project, or is of another model",
        )
    return Renamed(tensors, names)


def chosen_robot(known: Iterable[str], robot: str | None, where: str) -> str | None:
    """The robot that is meant: ``robot``, or the only one that a checkpoint knows; else None.

    Raises:
        UsageError: it knows no ``robot``; lists those that it knows.
    """
    names = sorted(known)
    if robot is None:
        return names[0] if len(names) == 1 else None
    if robot not in names:
        close = nearest(robot, names)
        meant = f"; did you mean {close!r}?" if close else "."
        raise UsageError(
            f"--robot {robot}: the checkpoint knows no such robot{meant} It knows "
            f"{', '.join(names) or 'none by name'}",
            where=where,
        )
    return robot


def without_cameras(cameras: Sequence[str], absent: Sequence[str], where: str) -> tuple[str, ...]:
    """``cameras`` but for those that the robot lacks; names may have ``observation.images.``.

    Raises:
        UsageError: one of ``absent`` is none of them, or none is left.
    """
    gone = {camera_name(name) for name in absent}
    unknown = sorted(gone - {camera_name(name) for name in cameras})
    listed = ", ".join(camera_name(name) for name in cameras) or "none by name"
    if unknown:
        raise UsageError(
            f"--camera {unknown[0]}=none: the checkpoint has no such camera; it has {listed}",
            where=where,
        )
    left = tuple(name for name in cameras if camera_name(name) not in gone)
    if not left:
        raise UsageError(f"--camera …=none: no camera is left of {listed}", where=where)
    return left


def foreign_folder(place: str | Path) -> Path:
    """The folder of another project's checkpoint; ``hf:<id>[@<revision>]`` is one on the hub.

    What the hub has is fetched through ``huggingface_hub`` into its cache, or found there.

    Raises:
        CheckpointError: it is not there, cannot be fetched, or ``huggingface_hub`` is missing.
    """
    text = str(place)
    if not text.startswith(HUB):
        folder = Path(text).expanduser()
        if not folder.is_dir():
            kind = "is a file, not a folder" if folder.exists() else "does not exist"
            raise CheckpointError(
                f"{text} {kind}",
                next=f"name the checkpoint's folder, or {HUB}OWNER/NAME for one on the "
                "Hugging Face hub",
            )
        return folder
    try:
        from huggingface_hub import snapshot_download
    except ImportError as error:
        raise CheckpointError(
            f"{text} is on the Hugging Face hub, and huggingface_hub is not installed",
            next="pip install 'fluxvla-core[hub]', or name a folder",
        ) from error
    name, _, revision = text[len(HUB) :].partition("@")
    try:
        return Path(snapshot_download(name, revision=revision or None))
    except (OSError, ValueError) as error:  # the hub's errors are OSErrors, its checks ValueErrors
        lines = str(error).strip().splitlines() or [type(error).__name__]
        raise CheckpointError(
            f"{text} cannot be fetched: {lines[0]}",
            cause="there is no such model, it is not public, or the hub cannot be reached",
            next="download it elsewhere, and name its folder",
        ) from error


def read_foreign(
    source: str | Path,
    format: str | None = None,
    tokenizer: str | None = None,
    robot: str | None = None,
    absent: Sequence[str] = (),
) -> ForeignCheckpoint:
    """Another project's checkpoint, by the format that recognises it.

    Args:
        robot, absent: see ``CheckpointFormat.read``.

    Raises:
        CheckpointError: none does, or it is damaged.
        UsageError: there is no format of that name, or ``robot`` or ``absent`` does not fit.
    """
    folder = foreign_folder(source)
    known, failed = formats()
    if format is not None and format not in {f.name for f in known}:
        raise UsageError(unknown_format(format, known, failed))
    asked = [f for f in known if format in (None, f.name)]
    able = [f for f in asked if f.recognizes(folder)]
    if len(able) == 1:
        return _read(able[0], folder, tokenizer, robot, absent)
    if able:
        listed = ", ".join(sorted(f"{f.name} ({type(f).__name__})" for f in able))
        raise CheckpointError(
            f"several formats recognise the checkpoint: {listed}",
            where=str(folder),
            next="choose one: --format NAME",
        )
    raise _unrecognized(folder, asked, failed)


def _read(
    chosen: CheckpointFormat,
    folder: Path,
    tokenizer: str | None,
    robot: str | None,
    absent: Sequence[str],
) -> ForeignCheckpoint:
    # As of a model's ``predict_action``: what a parameter names is what it can do.
    able = inspect.signature(chosen.read).parameters
    kinds = ", ".join(chosen.model_types)
    if robot is not None and "robot" not in able:
        raise UsageError(
            f"--robot {robot}: a checkpoint of {kinds} ({chosen.name}) is of one robot, which has "
            "no name there",
            next="leave --robot out",
        )
    if absent and "absent" not in able:
        raise UsageError(
            f"--camera {absent[0]}=none: {kinds} ({chosen.name}) needs the images of all cameras "
            "that it was trained with",
            next="give it another camera's: --camera THEIRS=OURS",
        )
    choices: dict[str, Any] = {"robot": robot, "absent": absent}
    with located(str(folder)):
        return chosen.read(folder, tokenizer, **{k: v for k, v in choices.items() if k in able})


def is_foreign(place: str | Path) -> bool:
    """Whether ``place`` is another project's checkpoint rather than one of this project's."""
    text = str(place)
    if text.startswith(HUB):
        return True
    folder = Path(text)
    if not folder.is_dir() or (folder / MANIFEST).is_file() or folders(folder):
        return False
    return any(f.recognizes(folder) for f in formats()[0])


def formats() -> tuple[list[CheckpointFormat], list[PluginError]]:
    """The installed formats, and why others cannot be loaded."""
    found: list[CheckpointFormat] = []
    failed: list[PluginError] = []
    for name in CHECKPOINT_FORMATS:
        try:
            found.append(CheckpointFormat.adapt(CHECKPOINT_FORMATS.get(name)()))
        except PluginError as error:
            failed.append(error)
    return found, failed


@contextmanager
def explain_other_family(table: Any, model: object) -> Iterator[None]:
    """Add to errors about weights how the checkpoint's ``model`` table differs from ``model``.

    It may name another class, or other numbers for the same class.
    """
    try:
        yield
    except CheckpointError as error:
        kind = table.get("type") if isinstance(table, Mapping) else None
        theirs, ours = str(kind).rpartition(":")[2], type(model).__name__
        if kind is not None and theirs != ours:
            error.cause = f"the checkpoint is of {theirs}, the config's model is {ours}"
            error.next = f"name a checkpoint of {ours}, or let the config's model be {theirs}"
        elif differ := _other_numbers(table, model):
            listed = (f"{key} {there}, the config's {here}" for key, there, here in differ)
            error.cause = f"the checkpoint's model has {'; '.join(listed)}"
            words = (f"--set model.{key}={there}" for key, there, _ in differ)
            error.next = f"{' '.join(words)}, and data and transforms that fit; or other weights"
        raise


def _other_numbers(table: Any, model: object) -> list[tuple[str, int, int]]:
    """``(key, there, here)`` of whole numbers that ``model`` has otherwise than its table."""
    if not isinstance(table, Mapping):
        return []
    pairs = ((key, there, getattr(model, key, None)) for key, there in table.items())
    return [
        (key, there, here)
        for key, there, here in pairs
        if type(there) is int and type(here) is int and there != here
    ]


def unknown_format(
    name: str, known: Sequence[CheckpointFormat], failed: Sequence[PluginError]
) -> str:
    """Says that no format is called ``name``, what there is, and what cannot be loaded."""
    names = sorted({f.name for f in known})
    close = nearest(name, names)
    meant = f"; did you mean {close!r}?" if close else "."
    return (
        f"there is no checkpoint format {name!r}{meant} Installed: {', '.join(names) or 'none'}"
        f"{_broken(failed)}"
    )


def _unrecognized(
    folder: Path, asked: Sequence[CheckpointFormat], failed: Sequence[PluginError]
) -> CheckpointError:
    tried = sorted({f"{f.name} ({', '.join(f.model_types)})" for f in asked})
    return CheckpointError(
        f"no installed format recognises the checkpoint: {_stated(folder)}",
        where=str(folder),
        cause="it is of another family or of a newer version than the formats that were tried: "
        f"{', '.join(tried) or 'none'}{_broken(failed)}",
        next=next((error.next for error in failed if error.next), None)
        or "install the plugin of its model family; fluxvla plugins list has what is installed",
    )


def _broken(failed: Sequence[PluginError]) -> str:
    """Why formats cannot be loaded; those of one distribution mostly for one reason."""
    prefix = f"{PREFIX}{CHECKPOINT_FORMATS.name}:"
    reasons = (
        error.what.partition(": ")[2] if error.what.startswith(prefix) else error.what
        for error in failed
    )
    return "".join(f"; cannot be loaded: {reason}" for reason in dict.fromkeys(reasons))


def _stated(folder: Path) -> str:
    """What ``config.json`` in ``folder`` says that it is of."""
    file = folder / "config.json"
    if not os.path.lexists(file):
        return "it has no config.json"
    try:
        config = read_json(file, dict[str, Any], CheckpointError)
    except CheckpointError as error:
        return f"its config.json cannot be read: {error.what}"
    kinds = [f"{key} {config[key]!r}" for key in ("type", "model_type") if key in config]
    return f"its config.json says {' and '.join(kinds) or 'neither type nor model_type'}"
