"""Model weights: by name, of checkpoints and exports, and which of them checkpoints lack."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from fluxvla_core.build import build_vla_from_cfg
from fluxvla_core.checkpoints.checkpoint import EMA, MODEL, TRAINER, Checkpoint
from fluxvla_core.checkpoints.foreign import (
    explain_other_family,
    foreign_folder,
    is_foreign,
    read_foreign,
)
from fluxvla_core.checkpoints.shards import Stored
from fluxvla_core.checkpoints.tensors import check_names, read_tensors, shard_like
from fluxvla_core.data.transforms.pipeline import redirected
from fluxvla_core.errors import CheckpointError
from fluxvla_core.training import lora
from fluxvla_core.training.distributed import World, run_on_rank0
from fluxvla_core.training.model import before_its_weights, frozen_sources, set_frozen_source


@dataclass(frozen=True)
class ExternalWeights:
    """Frozen weights that checkpoints do not contain: the model's constructor loads them.

    A module says so by ``frozen_source``: where its frozen weights come from when it is built
    (a package, a file). ``sha256`` proves on loading that they are still the same.
    """

    sources: Mapping[str, str] = field(default_factory=dict)
    names: frozenset[str] = frozenset()
    sha256: str = ""

    def to_dict(self) -> dict[str, Any]:
        """JSON values."""
        return {"sources": dict(self.sources), "sha256": self.sha256}


@dataclass(frozen=True)
class SavedExternalWeights:
    """:class:`ExternalWeights` in ``trainer.json``."""

    sources: dict[str, str] = field(default_factory=dict)
    sha256: str = ""


@dataclass(frozen=True)
class SavedWeights:
    """The fields of ``trainer.json`` that every checkpoint has, exported ones too."""

    left_out: SavedExternalWeights


def external_weights(model: nn.Module) -> ExternalWeights:
    """The :class:`ExternalWeights` of ``model``; reads them once to hash them."""
    sources = frozen_sources(model)
    state = model.state_dict(keep_vars=True)
    # What stands in no part by itself but in the whole model may be a buffer that training changes.
    names = frozenset(
        name
        for name, tensor in state.items()
        if not tensor.requires_grad
        and any(_inside(name, p) and (p or isinstance(tensor, nn.Parameter)) for p in sources)
    )
    digest = hashlib.sha256()
    for name in sorted(names):
        flat = state[name].detach().cpu().contiguous().reshape(-1)
        digest.update(name.encode() + str(tuple(state[name].shape)).encode())
        digest.update(memoryview(flat.view(torch.uint8).numpy()) if flat.numel() else b"")
    return ExternalWeights(sources, names, digest.hexdigest() if names else "")


def weights_by_name(model: nn.Module, without: Iterable[str] = ()) -> dict[str, Tensor]:
    """Parameters and persistent buffers by name, but for those in ``without``.

    Raises:
        CheckpointError: the model keeps extra state that is not a tensor.
    """
    skipped = set(without)
    state = model.state_dict(keep_vars=True)
    other = sorted(name for name, value in state.items() if not isinstance(value, Tensor))
    if other:
        raise CheckpointError(
            f"the model's state_dict holds other than tensors: {', '.join(other)}",
            next="keep such state in buffers, or in the config",
        )
    return {name: tensor for name, tensor in state.items() if name not in skipped}


def load_full_tensors(model: nn.Module, tensors: Mapping[str, Tensor | Stored]) -> None:
    """Load full ``tensors`` of the right names and sizes into ``model``, which may be sharded."""
    state = weights_by_name(model)
    # strict=False only for weights that are left out of checkpoints: the others were checked.
    model.load_state_dict(
        {name: shard_like(state[name].detach(), tensor) for name, tensor in tensors.items()},
        strict=False,
    )


def check_model_tensors(
    model: nn.Module,
    tensors: Mapping[str, Tensor],
    external: ExternalWeights,
    saved: Mapping[str, Any],
    where: str,
    resuming: bool = False,
) -> None:
    """Refuse weights that are not all of this model's, or were trained with other frozen ones.

    Args:
        tensors: the checkpoint's weights.
        external: the weights that the model's constructor loaded.
        saved: ``left_out`` of ``trainer.json``.
        resuming: a training resumes from them, whose ``init_from`` names an adapter's base.

    Raises:
        CheckpointError: lists what differs.
    """
    external = external if saved.get("sha256") else ExternalWeights()
    if external.sha256 != saved.get("sha256", ""):
        raise _other_frozen(external, saved, bool(lora.adapter_names(model)), where, resuming)
    check_names(tensors, weights_by_name(model, external.names), "the weights", where)


def _other_frozen(
    ours: ExternalWeights, saved: Mapping[str, Any], adapter: bool, where: str, resuming: bool
) -> CheckpointError:
    """Frozen weights, or an adapter's base, are not those that the checkpoint was trained with."""
    what = "frozen weights differ from those that the checkpoint was trained with"
    now, before = ours.sources.get(""), saved.get("sources", {}).get("")
    if adapter and now and before and now != before:
        return CheckpointError(
            f"{what} (the model from {now}; then from {before})",
            where=where,
            cause="init_from was changed, or that place has other weights by now",
            next=f"--set <section>.init_from=DIR, where the weights of {before} are; or resume "
            "without it"
            if resuming
            else f"put the weights that the adapter was trained on back to {before}",
        )
    places = {**saved.get("sources", {}), **ours.sources}
    listed = "; ".join(f"{name or 'the model'} from {place}" for name, place in places.items())
    return CheckpointError(
        f"{what} ({listed})",
        where=where,
        cause="another version of the package or file that they come from is installed",
        next="environment.json in the checkpoint's folder has the versions that made it",
    )


def model_of(checkpoint: Checkpoint, untrained: bool = False) -> nn.Module:
    """The model that a checkpoint's config describes, without the checkpoint's weights.

    A tokenizer of the model's own is that of the checkpoint's processors.

    Args:
        untrained: with the weights that its training began with; else those of the checkpoint are
            loaded next, and none is read here.

    Raises:
        CheckpointError: the config has no section ``model``.
        ConfigError, PluginError: the model cannot be built here.
    """
    config = checkpoint.config()
    if "model" not in config:
        raise CheckpointError(
            "the checkpoint's config has no section 'model'", where=str(checkpoint.path)
        )
    (table,) = redirected([config["model"]], checkpoint.processors)
    with nullcontext() if untrained else before_its_weights():
        built: nn.Module = build_vla_from_cfg(table)
    return built


def load_for_inference(model: nn.Module, checkpoint: Checkpoint) -> None:
    """Put a checkpoint's weights (the averaged ones if kept) into a freshly built ``model``.

    Adapters are merged: the model keeps its names, and which of its parts are trainable.

    Raises:
        CheckpointError: they are not this model's, or frozen parts have changed.
    """
    saved = checkpoint.json(TRAINER, SavedWeights)["left_out"]
    options = lora.LoraOptions.of_checkpoint(checkpoint)
    trained = {name: p.requires_grad for name, p in model.named_parameters()}
    if options is not None:
        base = adapter_base_place(checkpoint)
        if base is not None:
            load_initial_weights(model, base)
            set_frozen_source(model, base)
        lora.attach(model, options, trained=True)
    tensors = checkpoint.tensors(MODEL) | lora.adapter_tensors(model, checkpoint)
    if checkpoint.has(EMA):
        tensors |= _by_all_names(model, checkpoint.tensors(EMA))
    check_model_tensors(
        model, tensors, external_weights(model), saved, str(checkpoint.path / MODEL)
    )
    load_full_tensors(model, tensors)
    if options is not None:
        lora.merge_(model)
        set_frozen_source(model, None)
        for name, parameter in model.named_parameters():
            parameter.requires_grad_(trained[name])


def _by_all_names(model: nn.Module, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """``tensors``, and tied weights under their other names too: averages have the first alone."""
    state = weights_by_name(model)
    known = {id(state[name]): tensor for name, tensor in tensors.items() if name in state}
    others = {name: known[id(own)] for name, own in state.items() if id(own) in known}
    return {**tensors, **others}


def adapter_base_place(checkpoint: Checkpoint, init_from: str | None = None) -> str | None:
    """Where the base weights of a checkpoint's adapter are; None if it needs none.

    They are where they were found, or else, as folders are moved together, at the place that was
    asked for. A hash shows whether they have changed.

    Args:
        init_from: the place that is asked for now, which goes first when it is a new one.
    """
    noted = _recorded_adapter_base(checkpoint)
    if noted is None:
        return None
    asked, found = noted
    if init_from not in (None, asked):
        return init_from
    return next((place for place in (found, asked) if Path(place).exists()), found)


def adapter_base_to_record(before: Checkpoint | None, init_from: str | None) -> str | None:
    """Where the base of an adapter was asked for; None if its checkpoints need no others' weights.

    Args:
        before: what the run resumes from; where it is asked for no other base, it keeps that one.
    """
    if before is None:
        return init_from
    noted = _recorded_adapter_base(before)
    return None if noted is None else init_from or noted[0]


def _recorded_adapter_base(checkpoint: Checkpoint) -> tuple[str, str] | None:
    """Where a checkpoint's base was asked for, and found."""
    if not checkpoint.has(lora.CONFIG):
        return None
    asked = checkpoint.json(lora.CONFIG, lora.SavedAdapter)["base_model_name_or_path"]
    found = checkpoint.json(TRAINER, SavedWeights)["left_out"].get("sources", {}).get("")
    return None if asked is None or found is None else (asked, found)


def resolve_weights(place: str | Path) -> str:
    """The safetensors file or the checkpoint's own folder that ``place`` means at this moment.

    Which one is a work dir's newest, or its ``best``, changes while that run continues.

    Raises:
        CheckpointError: there is none.
    """
    if is_foreign(place):
        return str(foreign_folder(place).resolve())
    path = Path(os.path.realpath(place))
    return str(path if path.suffix == ".safetensors" else Checkpoint.open(path).path)


def load_initial_weights(model: nn.Module, place: str | Path) -> Path:
    """Load the weights of another training, or of an export, into a freshly built ``model``.

    Args:
        place: a checkpoint's folder, a work dir (its newest one), a safetensors file, or another
            project's checkpoint whose format a plugin reads.

    Returns:
        The file, or the folder of the checkpoint itself: which one is a work dir's newest, or its
        ``best``, changes while that run continues.

    Raises:
        CheckpointError: there is nothing there, it is damaged, or it is of another model.
    """
    if is_foreign(place):
        theirs = read_foreign(place)
        with explain_other_family(theirs.model, model):
            return _put_all(model, theirs.tensors, foreign_folder(place).resolve())
    path = Path(os.path.realpath(place))
    if path.suffix != ".safetensors":
        checkpoint = Checkpoint.open(path)
        checkpoint.verify()
        with explain_other_family(checkpoint.config().get("model"), model):
            load_for_inference(model, checkpoint)
        return checkpoint.path
    if not path.is_file():
        raise CheckpointError(f"there are no weights at {path}")
    return _put_all(model, read_tensors(path), path)


def _put_all(model: nn.Module, tensors: Mapping[str, Tensor | Stored], path: Path) -> Path:
    external = external_weights(model).names - set(tensors)
    check_names(tensors, weights_by_name(model, external), "the weights", str(path))
    load_full_tensors(model, tensors)
    return path


def start_training_with(
    model: nn.Module, init_from: str | None, before: Checkpoint | None, adapter: bool, world: World
) -> None:
    """Load the weights that ``init_from`` names, if any, into a freshly built ``model``.

    Args:
        before: what the run resumes from: all weights are in it, but for an adapter's base.
        adapter: the model is an adapter's base, whose weights are not saved.
    """
    place = adapter_base_place(before, init_from) if before is not None else init_from
    if place is None:
        return
    # Found once: ranks that looked one after the other could find different ones.
    found = load_initial_weights(model, run_on_rank0(world, lambda: resolve_weights(place)))
    if adapter:
        set_frozen_source(model, str(found))


def _inside(name: str, prefix: str) -> bool:
    return not prefix or name.startswith(prefix + ".")
