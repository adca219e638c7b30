"""A saved checkpoint as one object, and the checkpoints of a work dir as a list.

Nothing here imports torch before weights are read: commands that list checkpoints and robots that
read an embodiment use these functions too.

    <work_dir>/checkpoints/step-000000100/
        manifest.json            sizes and SHA-256 of everything below
        model.safetensors        weights and buffers, but for frozen ones that the model loads
        ema.safetensors          averaged weights, when they are kept
        adapter/                 what LoRA trains, as peft has it, instead of in the model's file
        optimizer.safetensors    optimizer state by parameter name; where ranks hold parts of it,
        optimizer/rank-00000.safetensors    instead, in the layout that torch's DCP reads
        optimizer.json           its groups and scalars
        trainer.json             step, epoch, cursor, scheduler, last loss
        rng/rank-00000.safetensors
        policy.json embodiment.json dataset_statistics.json
        config.resolved.json environment.json processors/
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from annotated_types import Ge

from fluxvla_core.bounds import Count, Positive
from fluxvla_core.checkpoints.manifest import (
    FOLDER,
    FileEntry,
    Manifest,
    hash_file,
    read_manifest,
    step_name,
    step_of,
)
from fluxvla_core.checkpoints.manifest import NAME as MANIFEST
from fluxvla_core.checkpoints.writer import PARTIAL, Disk, free_name
from fluxvla_core.config.load import FORMAT
from fluxvla_core.errors import CheckpointError, UsageError
from fluxvla_core.untrusted import parse_json, read_bytes

if TYPE_CHECKING:
    import torch

    from fluxvla_core.checkpoints.shards import Stored
    from fluxvla_core.spec import EmbodimentSpec


MODEL = "model.safetensors"
EMA = "ema.safetensors"
OPTIMIZER = "optimizer.safetensors"
OPTIMIZER_SHARDS = "optimizer"
RANDOM = "rng"
OPTIMIZER_META = "optimizer.json"
TRAINER = "trainer.json"
POLICY = "policy.json"
EMBODIMENT = "embodiment.json"
STATISTICS = "dataset_statistics.json"
CONFIG = "config.resolved.json"
ENVIRONMENT = "environment.json"
PROCESSORS = "processors"

_CHANGED = "it was changed, or the disk lost a part of it, after it was saved"
_UNREADABLE = "its permissions, or a disk or mount that fails"


@dataclass(frozen=True)
class _ResolvedConfig:
    config: dict[str, Any]
    origins: dict[str, str] = field(default_factory=dict)
    format: str = FORMAT


@dataclass(frozen=True)
class _Policy:
    action_rate_hz: Positive | None = None
    horizon: Annotated[Count, Ge(1)] | None = None


@dataclass(frozen=True)
class Checkpoint:
    """A complete checkpoint folder; made by ``Checkpoint.open``."""

    path: Path
    manifest: Manifest

    @classmethod
    def open(cls, path: str | Path) -> Checkpoint:
        """Read the manifest in ``path``; a work dir or its checkpoints folder gives its newest.

        Sizes and hashes are checked by :meth:`verify`, not here.

        Raises:
            CheckpointError: there is nothing, no folder, no manifest, or a damaged one.
        """
        path = Path(path)
        if not path.exists():
            raise CheckpointError(
                f"there is no checkpoint at {path}",
                next=_offer(path.parent),
            )
        if not path.is_dir():
            raise CheckpointError(
                f"{path} is a file; a checkpoint is a folder like {FOLDER}/{step_name(100)}"
            )
        if not _has_manifest(path) and (found := latest(path)) is not None:
            return found
        try:
            return cls(path, read_manifest(path))
        except CheckpointError as error:
            error.next = error.next or _offer_previous(path)
            raise

    @property
    def step(self) -> int:
        """Optimizer steps done when it was saved."""
        return self.manifest.step

    @property
    def epoch(self) -> int:
        """Whole epochs done when it was saved."""
        return self.manifest.epoch

    def verify(self) -> None:
        """Compare every file with the manifest, reading all of them.

        Raises:
            CheckpointError: names the first file that is missing, cut short, changed or cannot be
                read, and offers the newest earlier checkpoint that is undamaged.
        """
        damage = self._damage()
        if damage is not None:
            damage.next = _offer_previous(self.path)
            raise damage

    def _damage(self) -> CheckpointError | None:
        """The first damaged file, and its likely cause."""
        for name, entry in sorted(self.manifest.files.items()):
            try:
                problem, cause = _difference(self.path / name, entry), _CHANGED
            except OSError as error:
                problem, cause = f"cannot be read: {error.strerror or error}", _UNREADABLE
            if problem:
                return CheckpointError(f"{name} {problem}", where=str(self.path), cause=cause)
        return None

    def has(self, name: str) -> bool:
        """Whether the checkpoint has the file ``name``."""
        return name in self.manifest.files

    def json(self, name: str, kind: type = dict) -> dict[str, Any]:
        """The JSON object in file ``name``.

        Args:
            kind: what it is checked to be; what the kind does not name is left as it is.

        Raises:
            CheckpointError: the file is not there, or holds something else.
        """
        if not self.has(name):
            raise CheckpointError(f"the checkpoint has no {name}", where=str(self.path))
        try:
            content = read_bytes(self.path / name, CheckpointError)
            value = parse_json(content, dict[str, Any], CheckpointError, name)
            parse_json(content, kind, CheckpointError, name)
        except CheckpointError as error:
            raise CheckpointError(f"{name}: {error.what}", where=str(self.path)) from error
        return value

    def config(self) -> dict[str, Any]:
        """The resolved config tree of the run that saved it: data, never executed.

        Raises:
            CheckpointError: it is missing, damaged, or of another format.
        """
        content = self.json(CONFIG, _ResolvedConfig)
        if content.get("format", FORMAT) != FORMAT:
            raise CheckpointError(
                f"the config has format {content['format']!r}; this version reads {FORMAT!r}",
                where=str(self.path / CONFIG),
                cause="it was written by another version of FluxVLA",
                next="pip install --upgrade fluxvla-core",
            )
        tree: dict[str, Any] = content["config"]
        return tree

    def statistics(self) -> dict[str, Any]:
        """Dataset statistics: ``{"private": {"proprio": {...}, "action": {...}}}``."""
        return self.json(STATISTICS, dict[str, dict[str, Any]])

    def policy(self) -> dict[str, Any]:
        """``action_rate_hz`` (Hz) and ``horizon`` (actions per chunk), null where unknown."""
        return self.json(POLICY, _Policy)

    def embodiment(self) -> EmbodimentSpec | None:
        """The robot that it was trained for; None when the dataset named none."""
        from fluxvla_core.spec import EmbodimentSpec

        return EmbodimentSpec.from_dict(self.json(EMBODIMENT)) if self.has(EMBODIMENT) else None

    @property
    def processors(self) -> Path:
        """Folder of the tokenizer and other processors; may not exist."""
        return self.path / PROCESSORS

    def tensors(self, name: str) -> dict[str, torch.Tensor]:
        """All tensors of a safetensors file by name, on the CPU.

        Raises:
            CheckpointError: the file is not there or cannot be read.
        """
        from fluxvla_core.checkpoints.tensors import read_tensors

        if not self.has(name):
            raise CheckpointError(f"the checkpoint has no {name}", where=str(self.path))
        return read_tensors(self.path / name)

    def optimizer_tensors(self) -> Mapping[str, Stored]:
        """The optimizer's state by ``<parameter>/<key>``, read when and as far as it is indexed.

        Raises:
            CheckpointError: there is none, or it cannot be read.
        """
        from fluxvla_core.checkpoints.shards import StoredTensors

        names = sorted(n for n in self.manifest.files if n.startswith(OPTIMIZER_SHARDS + "/"))
        if not names and not self.has(OPTIMIZER):
            raise CheckpointError(f"the checkpoint has no {OPTIMIZER}", where=str(self.path))
        return StoredTensors([self.path / name for name in names or [OPTIMIZER]])


def _difference(path: Path, entry: FileEntry) -> str | None:
    """How the file at ``path`` differs from its entry in the manifest."""
    if not path.is_file():
        return "is missing from the checkpoint"
    size = path.stat().st_size
    if size != entry.size:
        return f"is damaged: {size} bytes instead of {entry.size}"
    found = hash_file(path)
    if found != entry.sha256:
        return f"is damaged: SHA-256 {found[:12]}… instead of {entry.sha256[:12]}…"
    return None


def _has_manifest(folder: Path) -> bool:
    """Whether there is one; also if that cannot be seen, so that its reader says why."""
    try:
        return (folder / MANIFEST).is_file()
    except OSError:
        return True


def folders(place: str | Path) -> list[Path]:
    """Checkpoint folders of a work dir (or of its checkpoints folder), oldest step first.

    Half-written ones have other names and are never listed.
    """
    root = Path(place)
    root = root / FOLDER if (root / FOLDER).is_dir() else root
    if not root.is_dir():
        return []
    found = sorted((step, path) for path in root.iterdir() if (step := step_of(path)) is not None)
    return [path for _, path in found if _has_manifest(path)]


def refuse_existing(work_dir: Path) -> None:
    """Raise an error if the work dir has checkpoints that this training does not continue.

    Raises:
        UsageError: there are checkpoints in the work dir, with both ways on.
    """
    found = folders(work_dir)
    if found:
        raise UsageError(
            f"the work dir already holds checkpoints, up to step {step_of(found[-1])}",
            where=str(work_dir),
            next="resume from there: --resume auto; or use another folder: --work-dir DIR",
        )


def latest(place: str | Path) -> Checkpoint | None:
    """The newest checkpoint of a work dir, None when there is none yet.

    Only its manifest is read. Loading a policy and ``--resume auto`` use :func:`newest_undamaged`,
    which verifies every file and passes over a damaged checkpoint.

    Raises:
        CheckpointError: the newest one's manifest is damaged; the one before it is offered.
    """
    found = folders(place)
    return Checkpoint.open(found[-1]) if found else None


def newest_undamaged(place: str | Path) -> tuple[Checkpoint | None, list[CheckpointError]]:
    """The newest checkpoint that passes :meth:`Checkpoint.verify`, and why newer ones do not."""
    refused: list[CheckpointError] = []
    for folder in reversed(folders(place)):
        try:
            return _verified(folder), refused
        except CheckpointError as error:
            refused.append(error)
    return None, refused


def _verified(folder: Path) -> Checkpoint:
    """The verified checkpoint in ``folder``; if it is damaged, no other one is looked for."""
    checkpoint = Checkpoint(folder, read_manifest(folder))
    damage = checkpoint._damage()
    if damage is not None:
        raise damage
    return checkpoint


def _offer_previous(path: Path) -> str | None:
    """Text that names the newest undamaged checkpoint before ``path``."""
    step = step_of(path)
    for folder in reversed(folders(path.parent)):
        if step is not None and (step_of(folder) or 0) < step:
            with suppress(CheckpointError):
                return f"the one before it is undamaged: {_verified(folder).path}"
    return None


def _offer(place: Path) -> str | None:
    found = folders(place)
    return f"the newest one there is {found[-1]}" if found else None


REMOVING = ".removing"
BEST = "best"


def rotate(
    work_dir: Path, keep: int, disk: Disk | None = None, spare: int | None = None
) -> list[Path]:
    """Remove all but the ``keep`` newest checkpoints by step (0 keeps all); return the removed.

    The one of step ``spare`` stays too.

    A folder loses its name before its files: a kill in between leaves no torn checkpoint.
    """
    disk = disk or Disk()
    removed = [f for f in folders(work_dir)[:-keep] if step_of(f) != spare] if keep else []
    for folder in removed:
        doomed = folder.with_name(folder.name + REMOVING)
        disk.rename(folder, doomed)
        disk.remove_folder(doomed)
    return removed


def name_best(work_dir: Path, step: int) -> bool:
    """Link ``checkpoints/best`` to the checkpoint of ``step``; returns whether that exists.

    Without it there is no ``best``: an old link would name whatever takes its target's name next.
    """
    link = work_dir / FOLDER / BEST
    if not (link.parent / step_name(step)).is_dir():
        link.unlink(missing_ok=True)
        return False
    aside = link.with_name(f".{BEST}.{os.getpid()}")
    aside.unlink(missing_ok=True)
    aside.symlink_to(step_name(step))
    os.replace(aside, link)
    return True


def set_aside_later(work_dir: Path, step: int) -> list[Path]:
    """Rename checkpoints of steps after ``step``, which a run resumed there no longer continues.

    Left in place they would be taken for the newest and be kept instead of the resumed run's.
    """
    moved = []
    for folder in folders(work_dir):
        if (step_of(folder) or 0) > step:
            target = free_name(folder)
            os.rename(folder, target)
            moved.append(target)
    return moved


def clear_leftovers(work_dir: Path) -> None:
    """Remove what killed saves and rotations left: half-written and half-removed folders."""
    for path in sorted((work_dir / FOLDER).glob("step-*")):
        if path.name.endswith((PARTIAL, REMOVING)) and path.is_dir():
            shutil.rmtree(path)
