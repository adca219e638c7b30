"""Formats of other projects' checkpoints that are installed, and reading by the one that fits."""

from __future__ import annotations

import inspect
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from fluxvla_core.checkpoints.checkpoint import folders
from fluxvla_core.checkpoints.foreign import HUB, foreign_folder
from fluxvla_core.checkpoints.manifest import NAME as MANIFEST
from fluxvla_core.contracts.checkpoint_format import CheckpointFormat, ForeignCheckpoint
from fluxvla_core.errors import CheckpointError, PluginError, UsageError, located, nearest
from fluxvla_core.plugins.registry import CHECKPOINT_FORMATS
from fluxvla_core.registries import PREFIX
from fluxvla_core.untrusted import read_json


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
def telling_families(table: Any, model: object) -> Iterator[None]:
    """Let errors about weights say in what the checkpoint's ``model`` table is another than
    ``model``: its class, or numbers by which it was made."""
    try:
        yield
    except CheckpointError as error:
        kind = table.get("type") if isinstance(table, Mapping) else None
        theirs, ours = str(kind).rpartition(":")[2], type(model).__name__
        if kind is not None and theirs != ours:
            error.cause = f"the checkpoint is of {theirs}, the config's model is {ours}"
            error.next = f"name a checkpoint of {ours}, or let the config's model be {theirs}"
        elif differ := _other_numbers(table, model):
            listed = (
                f"{key} {there}, the config's {here}" for key, (there, here) in differ.items()
            )
            error.cause = f"the checkpoint's model has {'; '.join(listed)}"
            words = (f"--set model.{key}={there}" for key, (there, _) in differ.items())
            error.next = f"{' '.join(words)}, and data and transforms that fit; or other weights"
        raise


def _other_numbers(table: Any, model: object) -> dict[str, tuple[int, int]]:
    """Whole numbers of a ``model`` table that ``model`` has under the same names, with others."""
    if not isinstance(table, Mapping):
        return {}
    pairs = ((key, there, getattr(model, key, None)) for key, there in table.items())
    return {
        key: (there, here)
        for key, there, here in pairs
        if type(there) is int and type(here) is int and there != here
    }


def unknown_format(
    name: str, known: Sequence[CheckpointFormat], failed: Sequence[PluginError] = ()
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
