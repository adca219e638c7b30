"""Check that data, and a checkpoint to start from, fit a model before the model is built.

A model's class says which arguments of its constructor decide about the sizes of its batches
(``VLA.input_sizes``); the config has their values. Nothing here builds a model or reads weights.
"""

from __future__ import annotations

import inspect
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from fluxvla_core.build import RunContext, class_of
from fluxvla_core.checkpoints.checkpoint import Checkpoint
from fluxvla_core.config.resolve import SLOTS
from fluxvla_core.contracts.contract import implements
from fluxvla_core.contracts.training import VLA, Dataset, InputSizes, Size
from fluxvla_core.data.sampler import SampleKey
from fluxvla_core.errors import (
    CheckpointError,
    ConfigError,
    FluxError,
    PluginError,
    Problem,
    located,
)
from fluxvla_core.plugins.registry import BY_NAME, VLAS

_OBSERVATIONS = {"n_obs_steps": 1, "past_actions": 0}
"""Defaults for a model that does not declare them."""
_WORDS = {
    "cameras": "the number of cameras",
    "image_size": "the size of images",
    "states": "the width of states",
    "actions": "the width of actions",
    "horizon": "the number of actions in a chunk",
}
_PADDED = "states and actions have the robot's widths, or those that a transform pads them to"
_ADVICE = {
    "cameras": "the cameras are img_keys of the dataset",
    "image_size": "let a transform resize images",
    "states": _PADDED,
    "actions": _PADDED,
    "horizon": "the chunk is as long as action_window_size of the dataset",
    "embodiments": "embodiment_id of the dataset is the robot's number",
    "float_images": "let a transform normalise images",
}


@dataclass(frozen=True)
class Declared:
    """A size that a model takes; ``key`` is the argument that says so, empty where none does."""

    key: str
    value: Any


@dataclass(frozen=True)
class Misfit:
    """A size of a batch that a model does not take: the key below ``model``, and both values."""

    size: str
    key: str
    text: str


def declared_sizes(table: Any) -> dict[str, Declared]:
    """The input sizes of the model that ``table`` describes, by the fields of ``InputSizes``.

    Raises:
        ConfigError, PluginError: the class, or that of a part, cannot be loaded.
    """
    if not isinstance(table, Mapping):
        return {}  # a model that is built already
    cls = class_of(table.get("type"), VLAS)
    stated = getattr(cls, "input_sizes", None)
    found: dict[str, Declared] = {}
    if not isinstance(stated, InputSizes):
        return found
    for field in fields(InputSizes):
        one = _read(cls, table, getattr(stated, field.name))
        if one is not None:
            found[field.name] = one
    return found


def chunk_of(sizes: Mapping[str, Declared]) -> tuple[int, int] | None:
    """``(T, D)`` of the chunks, where both are declared."""
    both = [sizes[name].value for name in ("horizon", "actions") if name in sizes]
    return (both[0], both[1]) if len(both) == 2 else None


def misfits(
    table: Any, batch: Mapping[str, Any], sizes: Mapping[str, Declared] | None = None
) -> list[Misfit]:
    """Where ``batch`` has other sizes than the model of ``table`` takes.

    Args:
        batch: as a collator or a policy's preparation makes it: tensors ``(B, …)``, or a list with
            an entry for each sample. What it does not have is not compared.
        sizes: those of ``table``, if they are known.
    """
    sizes = declared_sizes(table) if sizes is None else sizes
    if not sizes:
        return []
    who = getattr(class_of(table["type"], VLAS), "__name__", str(table["type"]))
    found = []
    for size, have in _sizes_of(batch).items():
        one = sizes.get(size)
        if one is None or _fits(size, one.value, have):
            continue
        if size == "embodiments":
            text = f"embodiment_ids are below {one.value}, in the data one is {have}"
        elif size == "float_images":
            text = f"images are normalised floats, in the data they are {have}"
        else:
            takes, has = (_shown(size, value) for value in (one.value, have))
            text = f"{_WORDS[size]} is {takes}, in the data it is {has}"
        found.append(Misfit(size, one.key, f"{who}: {text}"))
    return found


def refusal(found: Sequence[Misfit], context: RunContext) -> ConfigError:
    """The error about all of ``found``, each with the line of the config that says the size."""
    problems = []
    for one in found:
        key = f"model.{one.key}" if one.key else "model"
        place = context.origins.get(key) or context.origins.get("model", "")
        problems.append(Problem(place, key, one.text))
    return ConfigError.from_problems(tuple(problems), next=advice(found))


def advice(found: Iterable[Misfit]) -> str:
    """What to change for ``found``."""
    return "; ".join(dict.fromkeys(_ADVICE[one.size] for one in found))


def check_data(context: RunContext, dataset: Any, collator: Any) -> None:
    """Compare the first sample of ``dataset`` with the config's model, which is not built.

    Of a mixture, that of each of its datasets. One that keeps decoded frames in memory does not
    decode them for this.

    Raises:
        ConfigError: they do not fit; names the keys and both values.
        DataError: the sample cannot be made.
    """
    table, where = context.config.get("model"), context.where("model")
    with located(where):
        sizes = declared_sizes(table)
    if not isinstance(table, Mapping):
        return
    check_observations(observations_in(table, sizes), dataset, context)
    if not sizes:
        return
    for part in _parts(dataset):
        with located(context.where("train_dataloader.dataset")):
            batch = collator(part.get_samples([SampleKey(0, 0)]))
        found = misfits(table, batch, sizes)
        if found:
            raise refusal(found, context)


def observations_in(
    table: Mapping[str, Any], sizes: Mapping[str, Declared]
) -> dict[str, int | None]:
    """``n_obs_steps`` and ``past_actions`` of a model; None where only the built one says."""
    cls = class_of(table.get("type"), VLAS)
    return {
        name: sizes[name].value
        if name in sizes
        else (None if implements(cls, VLA, name) else usual)
        for name, usual in _OBSERVATIONS.items()
    }


def check_observations(
    takes: Mapping[str, int | None],
    dataset: Any,
    context: RunContext,
    section: str = "train_dataloader",
) -> None:
    """Check that samples show as many observations and past actions as a model takes.

    Args:
        takes: ``n_obs_steps`` and ``past_actions`` of the model; None for any.
        dataset: of ``section``; one that is made of others, each of them.

    Raises:
        ConfigError: they show others: a chunk of the wrong times is learnt without any error.
    """
    for each in Dataset.adapt(dataset).datasets or [dataset]:
        shown = Dataset.adapt(each)
        for name, wanted in takes.items():
            has = getattr(shown, name)
            if wanted is not None and wanted != has:
                raise ConfigError(
                    f"{name} of the model is {wanted}, that of the dataset {has}",
                    where=context.where(f"{section}.dataset.{name}"),
                    cause="a model's samples have its observations, and the actions that belong "
                    "to them",
                    next=f"--set {section}.dataset.{name}={wanted}",
                )


def check_start(
    context: RunContext,
    init_from: str | None,
    before: Checkpoint | None = None,
    only_here: bool = False,
) -> None:
    """Refuse to start a training from a checkpoint of another family, before the model is built.

    Args:
        init_from: of the section that runs; without it what the model's table names.
        before: what the run resumes from: the model's own weights are in it.
        only_here: say nothing of a checkpoint that is not on this machine.

    Raises:
        CheckpointError: it is of another family, missing or damaged.
    """
    table = context.config.get("model")
    if not isinstance(table, Mapping):
        return
    if before is not None:
        check_family(str(before.path), table)
        return
    key, place = f"{context.section}.init_from", init_from
    if place is None and "name_mapping" not in table:  # with it, these are weights of parts
        key, place = "model.pretrained_name_or_path", table.get("pretrained_name_or_path")
    if isinstance(place, str) and (not only_here or os.path.exists(place)):
        with located(context.where(key)):
            check_family(place, table)


def check_family(place: str, table: Any) -> None:
    """Refuse a checkpoint of another class of models than the config's, before either is built.

    A file of weights alone does not say of what it is, and a class may inherit another's weights.

    Args:
        place: a folder of a checkpoint, a work dir, or another project's checkpoint.
        table: the config's ``model``.

    Raises:
        CheckpointError: the checkpoint is of another family, or damaged.
    """
    from fluxvla_core.checkpoints.foreign import HUB, foreign_folder, is_foreign, read_foreign

    if place.endswith(".safetensors") or place.startswith(HUB) or not isinstance(table, Mapping):
        return  # what the hub has is fetched by one process, when weights are read
    if is_foreign(place):
        theirs, where = read_foreign(place).model.get("type"), str(foreign_folder(place))
    else:
        checkpoint = Checkpoint.open(place)
        model, where = checkpoint.config().get("model"), str(checkpoint.path)
        theirs = model.get("type") if isinstance(model, Mapping) else None
    ours = table.get("type")
    if not isinstance(theirs, str) or not isinstance(ours, str) or _related(theirs, ours):
        return
    there, here = (name.rpartition(":")[2] for name in (theirs, ours))
    raise CheckpointError(
        f"the checkpoint is of {there}, the config's model is {here}",
        where=where,
        next=f"name a checkpoint of {here}, or let the config's model be {there}; of weights that "
        "have the same names all the same, name the file itself",
    )


def _parts(dataset: Any) -> Iterator[Dataset]:
    """The datasets that a mixture is made of, or ``dataset`` itself, without frames in memory."""
    described = Dataset.adapt(dataset)
    for part in described.datasets:
        yield from _parts(part)
    if not described.datasets:
        uncached = getattr(dataset, "uncached", None)
        yield described if uncached is None else Dataset.adapt(uncached())


def _related(theirs: str, ours: str) -> bool:
    """Whether one class is the other, or inherits it."""
    if theirs.rpartition(":")[2] == ours.rpartition(":")[2]:
        return True
    try:
        one, other = VLAS.get(theirs), VLAS.get(ours)
    except PluginError:
        return True  # it says so where the model is built
    return issubclass(one, other) or issubclass(other, one)


def _read(cls: type, table: Mapping[str, Any], stated: Size) -> Declared | None:
    if stated is None or stated is False:
        return None
    names: Any = stated
    function: Any = None
    if isinstance(stated, tuple):
        names, function = stated
    if not isinstance(names, str):
        return Declared("", stated)
    for name in names.split(" | "):
        try:
            value = _argument(cls, table, name)
            value = value if function is None else function(value)
        except (FluxError, TypeError, ValueError, AttributeError, KeyError):
            continue  # an argument that makes no sense: the constructor explains it
        whole = [value] if isinstance(value, int) else value
        if isinstance(whole, list | tuple) and all(isinstance(n, int) for n in whole):
            return Declared(name, value)
    return None


def _argument(cls: type, table: Mapping[str, Any], name: str) -> Any:
    """The value of an argument, ``part.argument`` of a part's table, or its default."""
    first, _, rest = name.partition(".")
    value = table[first] if first in table else _default(cls, first)
    if not rest or value is None:
        return value
    if not isinstance(value, Mapping):
        return getattr(value, rest, None)  # a part that is built already
    inner = class_of(value.get("type"), BY_NAME[SLOTS[first]])
    return _argument(inner, value, rest)


def _default(cls: type, name: str) -> Any:
    """The default of a constructor's argument, following ``**kwargs`` into base classes."""
    for base in inspect.getmro(cls):
        init = base.__dict__.get("__init__")
        if init is None or base is object:
            continue
        found = inspect.signature(init).parameters
        if name in found:
            default = found[name].default
            return None if default is inspect.Parameter.empty else default
        if not any(p.kind is p.VAR_KEYWORD for p in found.values()):
            break
    return None


def _sizes_of(batch: Mapping[str, Any]) -> dict[str, Any]:
    """The sizes that a batch has, by the fields of ``InputSizes``."""
    found: dict[str, Any] = {}
    images, states, actions = (_shape(batch.get(key)) for key in ("images", "states", "actions"))
    if len(images) > 2:
        found["cameras"], found["image_size"] = images[-3] // 3, images[-2:]
        kind = str(getattr(batch["images"], "dtype", "")).removeprefix("torch.")
        found["float_images"] = kind
    if states:
        found["states"] = states[-1]
    if len(actions) > 1:
        found["horizon"], found["actions"] = actions[-2:]
    ids = batch.get("embodiment_ids")
    if ids is not None and np.size(ids):
        found["embodiments"] = int(np.max(np.asarray(ids)))
    return found


def _shape(value: Any) -> tuple[int, ...]:
    """The shape of a sample's entry: of a tensor ``(B, …)``, or of the first in a list."""
    if isinstance(value, list | tuple):
        return tuple(np.shape(value[0])) if value else ()
    return tuple(getattr(value, "shape", ()))[1:]


def _fits(size: str, takes: Any, has: Any) -> bool:
    if size == "embodiments":
        return 0 <= int(has) < int(takes)
    if size == "float_images":
        return "float" in has or not has
    if size == "image_size":
        return tuple(has) == ((takes, takes) if isinstance(takes, int) else tuple(takes))
    return bool(takes == has)


def _shown(size: str, value: Any) -> str:
    if size != "image_size":
        return str(value)
    height, width = (value, value) if isinstance(value, int) else value
    return f"{height} x {width}"
