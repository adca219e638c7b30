"""A checkpoint without what only training needs: for evaluation, servers and robots.

The result is a checkpoint folder in every respect (manifest, hashes, ``load_policy``), with all
weights in one plain safetensors file: the averaged ones in their place if they were kept, adapters
merged, frozen parts that the model would bring itself included. Optimizer, random states and the
config's ``runner`` are left out, so that no training plugin is needed where it is used.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

from fluxvla_core.atomic import prepare_folder, refuse_content
from fluxvla_core.checkpoints import checkpoint as ckpt
from fluxvla_core.checkpoints.checkpoint import Checkpoint
from fluxvla_core.checkpoints.tensors import TensorFile
from fluxvla_core.checkpoints.writer import CheckpointWriter
from fluxvla_core.errors import CheckpointError
from fluxvla_core.training.weights import (
    LeftOut,
    load_for_inference,
    model_of,
    weights_by_name,
)
from fluxvla_core.untrusted import read_bytes

TRAINING_ONLY = ("runner", "val_dataloader")
"""Sections of the config that are not exported."""
_COPIED = (ckpt.POLICY, ckpt.EMBODIMENT, ckpt.STATISTICS, ckpt.ENVIRONMENT)


def export(source: str | Path, target: str | Path) -> Path:
    """Export the checkpoint ``source`` for inference into the new folder ``target``.

    Args:
        source: a checkpoint's folder, or a work dir, whose newest one is taken.
        target: does not exist yet, or is empty.

    Raises:
        CheckpointError: ``source`` is missing, damaged, or of another model.
        ConfigError, PluginError: the model cannot be built here.
        RunFailed: it could not be written; nothing is left then.
        UsageError: there is something at ``target``, or nothing can be written there.
    """
    target = Path(target)
    refuse_content(target)
    checkpoint = Checkpoint.open(source)
    prepare_folder(target.parent, "folder to export to", "name another place for the export")
    checkpoint.verify()
    checkpoint.config()  # of the right types
    config = checkpoint.json(ckpt.CONFIG)
    tree = {k: v for k, v in config["config"].items() if k not in TRAINING_ONLY}
    origins = {
        key: place
        for key, place in config.get("origins", {}).items()
        if key.partition(".")[0] not in TRAINING_ONLY
    }
    model = model_of(checkpoint)
    load_for_inference(model, checkpoint)
    if target.exists():
        target.rmdir()
    with CheckpointWriter(
        target.parent,
        checkpoint.step,
        checkpoint.epoch,
        final=target,
        what="the export",
        go_on="export again, or name a folder on another disk; the checkpoint is as it was",
    ) as writer:
        TensorFile.full(ckpt.MODEL, weights_by_name(model), True).write(writer)
        writer.write_json(ckpt.TRAINER, {"left_out": LeftOut().to_dict()})
        writer.write_json(ckpt.CONFIG, {**config, "config": tree, "origins": origins})
        for name in sorted(checkpoint.manifest.files):
            if name in _COPIED or name.startswith(f"{ckpt.PROCESSORS}/"):
                writer.write_bytes(name, _verified(checkpoint, name))
        return writer.commit()


def _verified(checkpoint: Checkpoint, name: str) -> bytes:
    """What is copied is what its hash says, even if the file changes while this runs.

    Raises:
        CheckpointError: it is not.
    """
    content = read_bytes(checkpoint.path / name, CheckpointError)
    if hashlib.sha256(content).hexdigest() != checkpoint.manifest.files[name].sha256:
        raise CheckpointError(f"{name} was changed since it was saved", where=str(checkpoint.path))
    return content
