"""The W&B run of a work dir: the one that a training's tracker ``wandb`` has written to, if any."""

from __future__ import annotations

import os
import secrets
from pathlib import Path
from typing import Any

from fluxvla_core.errors import ConfigError

MODES = ("online", "offline")
ID_FILE = "wandb_run_id"
"""In a work dir; the core's tracker has its run's id there, so that both are one run."""


def check_mode(mode: str | None, where: str) -> None:
    """Raises ConfigError for anything but ``online``, ``offline`` and None."""
    if mode is not None and mode not in MODES:
        raise ConfigError(f"{where}: mode is {' or '.join(map(repr, MODES))}, got {mode!r}")


def run_id(work_dir: Path) -> str:
    """The id of the work dir's run; a new one is kept there."""
    path = work_dir / ID_FILE
    if path.is_file():
        return path.read_text(encoding="utf-8").strip()
    made = secrets.token_hex(4)
    work_dir.mkdir(parents=True, exist_ok=True)
    path.write_text(made + "\n", encoding="utf-8")
    return made


def open_run(work_dir: Path, project: str | None, mode: str | None) -> Any:
    """The work dir's run, which goes on where it was; ``finish`` ends it.

    Nothing is printed, and neither standard output nor this process's signals are touched. Offline
    what is logged lies in ``<work_dir>/wandb``, and ``wandb sync`` sends it.

    Args:
        project: ``WANDB_PROJECT`` by default, and ``fluxvla`` without one.
        mode: ``online`` or ``offline``; ``WANDB_MODE`` by default, and online without one.
    """
    import wandb

    return wandb.init(
        project=project or os.environ.get("WANDB_PROJECT") or "fluxvla",
        id=run_id(work_dir),
        name=work_dir.resolve().name,
        resume="allow",
        dir=str(work_dir),
        mode=mode,
        settings=wandb.Settings(silent=True, console="off", x_disable_stats=True),
    )


def video(path: Path, caption: str) -> Any:
    """An mp4 file as it is, for ``run.log``; nothing is decoded."""
    import wandb

    return wandb.Video(str(path), caption=caption, format="mp4")


def place(run: Any) -> str:
    """Where the logged run is found: a URL, or the folder of an offline run."""
    return run.url or f"{Path(run.dir).parent}; 'wandb sync' sends it"
