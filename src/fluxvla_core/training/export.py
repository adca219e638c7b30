"""Export a checkpoint for inference, and convert checkpoints of other projects and back.

An exported one lacks what only training needs, for evaluation, servers and robots. It is a
checkpoint folder in every respect (manifest, hashes, ``load_policy``), with all weights in one
plain safetensors file: the averaged ones in their place if they were kept, adapters merged, frozen
parts that the model's constructor would load included. Optimizer, random states and the config's
``runner`` are left out, so that no training plugin is needed where it is used.

Other projects' checkpoints are converted by the formats that plugins have.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from fluxvla_core.atomic import prepare_folder, refuse_content
from fluxvla_core.build import build_vla_from_cfg
from fluxvla_core.checkpoints import checkpoint as ckpt
from fluxvla_core.checkpoints.checkpoint import Checkpoint
from fluxvla_core.checkpoints.foreign import formats, read_foreign, unknown_format
from fluxvla_core.checkpoints.shards import Stored
from fluxvla_core.checkpoints.tensors import TensorFile, check_names
from fluxvla_core.checkpoints.writer import PARTIAL, CheckpointWriter
from fluxvla_core.config.load import FORMAT, environment
from fluxvla_core.contracts.checkpoint_format import CheckpointFormat, ForeignCheckpoint
from fluxvla_core.contracts.contract import implements
from fluxvla_core.contracts.training import VLA, Transform
from fluxvla_core.data.inference_dataset import PrivateInferenceDataset, try_preparation
from fluxvla_core.data.lerobot import EMBODIMENT as DATASET_EMBODIMENT
from fluxvla_core.data.lerobot import camera_name
from fluxvla_core.data.mixture import first_dataset
from fluxvla_core.data.statistics import check_statistics
from fluxvla_core.data.transforms.pipeline import Pipeline, redirected
from fluxvla_core.errors import CheckpointError, ConfigError, SpecMismatch, UsageError, located
from fluxvla_core.spec import EmbodimentSpec
from fluxvla_core.training.lora import CONFIG as ADAPTER
from fluxvla_core.training.weights import (
    ExternalWeights,
    load_for_inference,
    model_of,
    weights_by_name,
)
from fluxvla_core.untrusted import read_bytes, read_json

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
    kept = "export again, or name a folder on another disk; the checkpoint is as it was"
    with _writer(target, checkpoint.step, checkpoint.epoch, "the export", kept) as writer:
        _write_weights(writer, weights_by_name(model))
        writer.write_json(ckpt.CONFIG, {**config, "config": tree, "origins": origins})
        for name in sorted(checkpoint.manifest.files):
            if name in _COPIED or name.startswith(f"{ckpt.PROCESSORS}/"):
                writer.write_bytes(name, _verified(checkpoint, name))
        return writer.commit()


def _writer(target: Path, step: int, epoch: int, what: str, go_on: str) -> CheckpointWriter:
    """Writes a checkpoint to ``target``, which is absent or an empty folder."""
    if target.exists():
        target.rmdir()
    return CheckpointWriter(target.parent, step, epoch, final=target, what=what, go_on=go_on)


def _write_weights(writer: CheckpointWriter, tensors: Mapping[str, Tensor]) -> None:
    """All weights in one file, those of frozen parts too."""
    TensorFile.full(ckpt.MODEL, tensors, True).write(writer)
    writer.write_json(ckpt.TRAINER, {"left_out": ExternalWeights().to_dict()})


def _verified(checkpoint: Checkpoint, name: str) -> bytes:
    """A file's content, hashed as it was read: the file may change while this runs."""
    content = read_bytes(checkpoint.path / name, CheckpointError)
    if hashlib.sha256(content).hexdigest() != checkpoint.manifest.files[name].sha256:
        raise CheckpointError(f"{name} was changed since it was saved", where=str(checkpoint.path))
    return content


_ORIGIN = "import-checkpoint"
_OTHER_VERSION = (
    "copy the checkpoint again if it is incomplete; another version of its project needs another "
    "version of the plugin"
)
_PRESENT_ONLY = {"n_obs_steps": 1, "past_actions": 0}


def import_checkpoint(
    source: str | Path,
    target: str | Path,
    format: str | None = None,
    tokenizer: str | None = None,
    embodiment: EmbodimentSpec | None = None,
    action_rate_hz: float | None = None,
    cameras: Mapping[str, str | None] | None = None,
    robot: str | None = None,
) -> tuple[Path, ForeignCheckpoint]:
    """Make a checkpoint of this project from another project's; weights keep their dtype.

    Args:
        source: its folder, or ``hf:<id>``.
        target: the folder to make; does not exist yet, or is empty.
        format: the project that it is of; by default that is found out.
        tokenizer: ``model_path`` of the tokenizer, for formats without one.
        embodiment: the robot, where the checkpoint describes none; without one the result can be
            trained on, and drives nothing.
        action_rate_hz: actions a second, where the checkpoint does not say it.
        cameras: the checkpoint's camera -> the robot's; None: the robot does not have it.
        robot: which one, where the checkpoint knows several, by its name there.

    Raises:
        CheckpointError: no installed format reads it; or it is damaged, or not as its format says.
        SpecMismatch: the robot is not the one that it was trained for.
        UsageError: there is something at ``target``, or an option does not fit.
    """
    target = Path(target)
    refuse_content(target)
    named = {theirs: ours for theirs, ours in (cameras or {}).items() if ours is not None}
    absent = tuple(theirs for theirs in cameras or {} if theirs not in named)
    found = read_foreign(source, format, tokenizer, robot, absent)
    found = replace(
        found,
        img_keys=_renamed_cameras(found.img_keys, named),
        action_rate_hz=action_rate_hz or found.action_rate_hz,
        embodiment=embodiment or found.embodiment,
    )
    _check_robot(found, str(source))
    check_statistics(found.statistics, str(source))
    pipeline = _prepared(found, str(source), tokenizer)
    with torch.device("meta"):  # its weights may be larger than memory
        model = build_vla_from_cfg(found.model)
    tensors = _as_model_has_them(model, found, str(source))
    prepare_folder(target.parent, "folder to import to", "name another place for the import")
    kept = "import again, or name a folder on another disk; the source is as it was"
    with _writer(target, 0, 0, "the import", kept) as writer:
        _write_weights(writer, tensors)
        writer.write_json(ckpt.CONFIG, _config(found, VLA.adapt(model)))
        writer.write_json(ckpt.ENVIRONMENT, environment())
        writer.write_json(ckpt.STATISTICS, dict(found.statistics))
        rate = found.action_rate_hz
        writer.write_json(ckpt.POLICY, {"action_rate_hz": rate, "horizon": found.horizon})
        if found.embodiment is not None:
            writer.write_json(ckpt.EMBODIMENT, found.embodiment.to_dict())
        writer.write_folder(ckpt.PROCESSORS, pipeline.save_pretrained)
        writer.add_folder(ckpt.PROCESSORS)
        return writer.commit(), found


def export_foreign(source: str | Path, target: str | Path, format: str) -> Path:
    """Write the checkpoint ``source`` into the new folder ``target`` as another project saves one.

    Raises:
        CheckpointError: ``source`` is missing or damaged, or that format cannot hold it.
        UsageError: no installed format of that name writes its model, or ``target`` is there.
    """
    target = Path(target)
    refuse_content(target)
    checkpoint = Checkpoint.open(source)
    checkpoint.verify()
    found = _as_foreign(checkpoint)
    kind = str(found.model.get("type")).rpartition(":")[2]
    known, failed = formats()
    able = [f for f in known if f.name == format and implements(f, CheckpointFormat, "write")]
    writers = [f for f in able if kind in f.model_types]
    if not able:
        raise UsageError(unknown_format(format, known, failed))
    if not writers:
        types = ", ".join(sorted({t for f in able for t in f.model_types}))
        raise UsageError(f"format {format!r} holds no {kind}; it holds {types}")
    prepare_folder(target.parent, "folder to export to", "name another place for the export")
    aside = target.with_name(target.name + PARTIAL)
    shutil.rmtree(aside, ignore_errors=True)
    aside.mkdir()
    try:
        writers[0].write(found, aside)
        if target.exists():
            target.rmdir()
        os.replace(aside, target)
    finally:
        shutil.rmtree(aside, ignore_errors=True)
    return target


def _as_model_has_them(model: nn.Module, found: ForeignCheckpoint, where: str) -> dict[str, Tensor]:
    """Every tensor of the model, of the sizes that it has; tied ones are one object."""
    wanted = weights_by_name(model)
    check_names(found.tensors, wanted, "the weights", where, _OTHER_VERSION)
    owner: dict[int, Tensor] = {}
    tensors: dict[str, Tensor] = {}
    for name, own in wanted.items():
        if id(own) not in owner:
            stored = found.tensors[name]
            whole = tuple(slice(0, length) for length in stored.shape)
            owner[id(own)] = stored[whole] if isinstance(stored, Stored) else stored
        tensors[name] = owner[id(own)]
    return tensors


def _as_foreign(checkpoint: Checkpoint) -> ForeignCheckpoint:
    """One of this project's checkpoints, with the weights that act: averaged, adapters merged."""
    config = checkpoint.config()
    if "model" not in config:
        raise CheckpointError(
            "the checkpoint's config has no section 'model'", where=str(checkpoint.path)
        )
    dataset = first_dataset(config.get("train_dataloader", {}).get("dataset", {}))
    facts = checkpoint.policy()
    if checkpoint.has(ckpt.EMA) or checkpoint.has(ADAPTER):
        model = model_of(checkpoint)
        load_for_inference(model, checkpoint)
        tensors: dict[str, Tensor] = {n: t.detach() for n, t in weights_by_name(model).items()}
    else:  # as they were saved, in the dtype that they have there
        tensors = checkpoint.tensors(ckpt.MODEL)
    return ForeignCheckpoint(
        model=redirected([config["model"]], checkpoint.processors)[0],
        tensors=tensors,
        img_keys=tuple(camera_name(key) for key in dataset.get("img_keys", ())),
        transforms=redirected(dataset.get("transforms", ()), checkpoint.processors),
        statistics=checkpoint.statistics(),
        horizon=int(facts.get("horizon") or 0),
        action_rate_hz=facts.get("action_rate_hz"),
        embodiment=checkpoint.embodiment(),
    )


def _config(found: ForeignCheckpoint, model: VLA) -> dict[str, Any]:
    history = {"n_obs_steps": model.n_obs_steps, "past_actions": model.past_actions}
    tree = {
        "model": dict(found.model),
        "train_dataloader": {
            "dataset": {
                "type": "ParquetDataset",
                "img_keys": list(found.img_keys),
                "action_window_size": found.horizon,
                **(history if history != _PRESENT_ONLY else {}),
                "transforms": [dict(table) for table in found.transforms],
            }
        },
    }
    return {"format": FORMAT, "config": tree, "origins": dict.fromkeys(tree, _ORIGIN)}


_UNKNOWN_SIZE = (480, 640)


def _prepared(found: ForeignCheckpoint, where: str, tokenizer: str | None) -> Pipeline:
    """Its transforms, which have been tried if the statistics of one robot are known.

    Raises:
        FluxError: a tokenizer is missing, or they and the statistics do not fit together.
    """
    try:
        pipeline = Pipeline(found.transforms)
    except ConfigError as error:
        if tokenizer is None and any("tokenizer" in table for table in found.transforms):
            error.next = "--tokenizer DIR, the folder of its tokenizer, which it does not contain"
        error.where = error.where or where
        raise
    entries = found.statistics.get("private", {})
    states, actions = (_width(entries.get(key, {})) for key in ("proprio", "action"))
    if not found.transforms or states is None or actions is None:
        return pipeline
    prepare = PrivateInferenceDataset(found.img_keys, pipeline.transforms, found.statistics)
    undo = next((t for t in pipeline.transforms if implements(t, Transform, "denormalizer")), None)
    if undo is None:
        return pipeline
    robot = found.embodiment
    known = {} if robot is None else {c.name: (c.height, c.width) for c in robot.cameras}
    cameras = {n: known.get(n, _UNKNOWN_SIZE) for n in map(camera_name, found.img_keys)}
    with located(where):
        denormalize = undo.denormalizer(found.statistics, "private")
    try_preparation(prepare, denormalize, cameras, states, (found.horizon, actions), where)
    return pipeline


def _renamed_cameras(keys: Sequence[str], cameras: Mapping[str, str]) -> tuple[str, ...]:
    have = [camera_name(key) for key in keys]
    unknown = [name for name in cameras if name not in have]
    if unknown:
        raise UsageError(
            f"--camera {unknown[0]}=…: the checkpoint has no such camera; it has {', '.join(have)}"
        )
    names = tuple(cameras.get(name, name) for name in have)
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        of = [theirs for theirs, ours in zip(have, names, strict=True) if ours == twice]
        raise UsageError(
            f"{' and '.join(of)} would both be the robot's camera {twice!r}",
            next="--camera THEIRS=OURS with a name of its own for each, or THEIRS=none",
        )
    return names


def _check_robot(found: ForeignCheckpoint, where: str) -> None:
    robot = found.embodiment
    if robot is None:
        return
    lacking = [key for key in found.img_keys if camera_name(key) not in robot.camera_names]
    if lacking:
        raise SpecMismatch(
            f"the checkpoint looks at {', '.join(found.img_keys)}; {robot.name} has "
            f"{', '.join(robot.camera_names)}",
            where=where,
            next=f"--camera {lacking[0]}=NAME, with the robot's name for it, or "
            f"{lacking[0]}=none if it has no such camera",
        )
    for key, joints in (("action", robot.dim), ("proprio", robot.state_dim)):
        width = _width(found.statistics.get("private", {}).get(key, {}))
        if width is not None and width != joints:
            raise SpecMismatch(
                f"the checkpoint's statistics of {key!r} have {width} dimensions, "
                f"{robot.name} has {joints}",
                where=where,
                cause="it was trained for another robot",
                next="--embodiment FILE with the robot that it was trained for, or none: it can be "
                "trained on for this one",
            )


def _width(statistics: Mapping[str, Any]) -> int | None:
    rows = [values for values in statistics.values() if isinstance(values, list | tuple)]
    return len(rows[0]) if rows else None


def embodiment_in(place: str | Path) -> EmbodimentSpec:
    """The robot that a file describes, or a checkpoint or dataset with such a file.

    Raises:
        UsageError: there is none, or it is not an embodiment.
    """
    path = Path(place)
    files = [path] if path.is_file() else [path / ckpt.EMBODIMENT, path / DATASET_EMBODIMENT]
    file = next((file for file in files if file.is_file()), None)
    if file is None:
        raise UsageError(
            f"there is no {ckpt.EMBODIMENT} at {path}",
            next="name the file, or a dataset or checkpoint that was made on the robot",
        )
    try:
        return EmbodimentSpec.from_dict(read_json(file, dict[str, Any], UsageError))
    except SpecMismatch as error:
        raise UsageError(error.what, where=str(file)) from error
