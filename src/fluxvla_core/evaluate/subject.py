"""What is evaluated: a checkpoint that can be named for certain, and its untrained twin."""

from __future__ import annotations

from pathlib import Path
from typing import Any


def chosen_checkpoint(ckpt_path: str | None, work_dir: Path) -> dict[str, Any]:
    """The checkpoint that is meant, checked: ``path``, ``step`` and ``sha256`` of its manifest.

    Args:
        ckpt_path: checkpoint or work dir; the newest whole one of ``work_dir`` by default.

    Raises:
        CheckpointError: there is none, or the one that is named is damaged.
    """
    from fluxvla_core.checkpoints.checkpoint import Checkpoint
    from fluxvla_core.checkpoints.manifest import NAME, hash_file
    from fluxvla_core.infer.local_policy import find_checkpoint

    path = find_checkpoint(ckpt_path, work_dir)
    checkpoint = Checkpoint.open(path)
    checkpoint.verify()
    return {"path": str(path), "step": checkpoint.step, "sha256": hash_file(path / NAME)}


def untrained_model(ckpt_path: str, device: str) -> Any:
    """The checkpoint's model with fresh random weights (seed 0), in evaluation mode.

    Raises:
        CheckpointError: there is no such checkpoint.
        ConfigError, PluginError: its model cannot be built here.
    """
    import torch

    from fluxvla_core.build import build_vla_from_cfg
    from fluxvla_core.checkpoints.checkpoint import Checkpoint

    with torch.random.fork_rng():
        torch.manual_seed(0)
        return build_vla_from_cfg(Checkpoint.open(ckpt_path).config()["model"]).to(device).eval()
