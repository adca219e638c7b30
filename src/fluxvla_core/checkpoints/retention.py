"""Retention: which checkpoints of a run are kept, removed, set aside or named the best."""

from __future__ import annotations

import os
from pathlib import Path

from fluxvla_core.checkpoints.checkpoint import folders
from fluxvla_core.checkpoints.manifest import FOLDER, step_name, step_of
from fluxvla_core.checkpoints.writer import PARTIAL, Disk, free_name

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
    """Let ``checkpoints/best`` point to the checkpoint of ``step``; whether that is there.

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


def set_aside_later(work_dir: Path, step: int, disk: Disk | None = None) -> list[Path]:
    """Rename checkpoints of steps after ``step``, which a run resumed there no longer continues.

    Left in place they would be taken for the newest and be kept instead of the resumed run's.
    """
    disk = disk or Disk()
    moved = []
    for folder in folders(work_dir):
        if (step_of(folder) or 0) > step:
            target = free_name(folder)
            disk.rename(folder, target)
            moved.append(target)
    return moved


def clear_leftovers(work_dir: Path, disk: Disk | None = None) -> None:
    """Remove what killed saves and rotations left: half-written and half-removed folders."""
    disk = disk or Disk()
    for path in sorted((work_dir / FOLDER).glob("step-*")):
        if path.name.endswith((PARTIAL, REMOVING)) and path.is_dir():
            disk.remove_folder(path)
