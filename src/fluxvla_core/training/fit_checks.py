"""Check that data, and a checkpoint to start from, fit a model before the model is built.

Nothing here builds a model or reads weights: ``input_sizes`` says what the config's model takes.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from fluxvla_core.build import RunContext, class_of
from fluxvla_core.checkpoints.checkpoint import Checkpoint
from fluxvla_core.config.resolve import SLOTS
from fluxvla_core.contracts.contract import implements
from fluxvla_core.contracts.training import VLA, Dataset
from fluxvla_core.data.sampler import SampleKey
from fluxvla_core.errors import CheckpointError, ConfigError, PluginError, Problem, located
from fluxvla_core.plugins.registry import BY_NAME, VLAS
from fluxvla_core.training.input_sizes import (
    Declared,
    Misfit,
    advice,
    declared_sizes,
    misfits,
    token_count,
)

_OBSERVATIONS = {"n_obs_steps": 1, "past_actions": 0}
"""Defaults for a model that does not declare them."""
_PARTS = ("vision_backbone", "projector", "llm_backbone", "vlm_backbone", "vla_head")
_BY_FILE = "of weights that have the same names all the same, name the file itself"
_DATA = {"train_dataloader": "the data", "val_dataloader": "the validation data"}


@dataclass(frozen=True)
class Samples:
    """What a training, or its validation, would show a model.

    Args:
        section: of the config: ``train_dataloader`` or ``val_dataloader``.
        dataset: None where it is not here.
        batches: first samples of it.
    """

    section: str
    dataset: Any
    batches: Iterable[Mapping[str, Any]]


def check_data(
    context: RunContext, dataset: Any, collator: Any, validation: Any | None = None
) -> None:
    """Compare the first samples of a training with the config's model, which is not built.

    Of a mixture, that of each of its datasets. One that keeps decoded frames in memory does not
    decode them for this.

    Args:
        dataset: of ``train_dataloader``.
        validation: the dataset of ``val_dataloader``; None without one.

    Raises:
        ConfigError: they do not fit; names the keys and both values of everything that does not.
        DataError: a sample cannot be made.
    """
    table = context.config.get("model")
    with located(context.where("model")):
        sizes = declared_sizes(table)
    if not isinstance(table, Mapping):
        return
    shown = [
        Samples(section, each, _first_batches(each, collator, context, section) if sizes else ())
        for section, each in (("train_dataloader", dataset), ("val_dataloader", validation))
        if each is not None
    ]
    error = unfit(context, sizes, shown)
    if error is not None:
        raise error


def unfit(
    context: RunContext, sizes: Mapping[str, Declared], shown: Iterable[Samples]
) -> ConfigError | None:
    """The error about all that does not fit the config's model, each with its line of the config.

    Args:
        sizes: the model's, see ``declared_sizes``.
    """
    table, problems, todo = context.config["model"], [], []
    takes = observations_in(table, sizes)
    for samples in shown:
        tokens = 0
        if samples.dataset is not None:
            tokens = _token_count(samples.dataset)
            found = _other_observations(takes, samples.dataset, context, samples.section)
            problems += [problem for problem, _ in found]
            todo += [change for _, change in found]
        for batch in samples.batches:
            wrong = misfits(table, batch, sizes, _DATA[samples.section], tokens)
            problems += [_problem(one, context) for one in wrong]
            todo += [advice([one]) for one in wrong]
    return _listed(problems, todo) if problems else None


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
    found = _other_observations(takes, dataset, context, section)
    if found:
        raise _listed([problem for problem, _ in found], [change for _, change in found])


def _other_observations(
    takes: Mapping[str, int | None], dataset: Any, context: RunContext, section: str
) -> list[tuple[Problem, str]]:
    """What samples show otherwise than ``takes`` says, each with the option that changes it."""
    found = []
    for each in Dataset.adapt(dataset).datasets or [dataset]:
        shown = Dataset.adapt(each)
        for name, wanted in takes.items():
            has = getattr(shown, name)
            if wanted is not None and wanted != has:
                table = f"{section}.dataset"
                key = f"{table}.{name}"
                place = context.origins.get(key) or context.origins.get(table, "")
                what = f"{name} of the model is {wanted}, that of the dataset {has}"
                found.append((Problem(place, key, what), f"--set {key}={wanted}"))
    return found


def _problem(one: Misfit, context: RunContext) -> Problem:
    key = f"model.{one.key}" if one.key else "model"
    return Problem(context.origins.get(key) or context.origins.get("model", ""), key, one.text)


def _listed(problems: Iterable[Problem], todo: Iterable[str]) -> ConfigError:
    """One error of ``problems``; several datasets may have the same ones."""
    unique = tuple(dict.fromkeys(problems))
    return ConfigError.from_problems(unique, next="; ".join(dict.fromkeys(todo)))


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
    """Refuse a checkpoint of another model than the config's, before either is built.

    Another class, or another class of a part, such as the two backbones of GR00T N1.5 and N1.7.
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
    model: Any
    if is_foreign(place):
        model, where = read_foreign(place).model, str(foreign_folder(place))
    else:
        checkpoint = Checkpoint.open(place)
        model, where = checkpoint.config().get("model", {}), str(checkpoint.path)
    if not isinstance(model, Mapping):
        return
    if not _related(model, table, "model"):
        there, here = _class_name(model), _class_name(table)
        raise CheckpointError(
            f"the checkpoint is of {there}, the config's model is {here}",
            where=where,
            next=f"name a checkpoint of {here}, or let the config's model be {there}; {_BY_FILE}",
        )
    for part in _PARTS:
        theirs, ours = model.get(part), table.get(part)
        if not _related(theirs, ours, part):
            there, here = _class_name(theirs), _class_name(ours)
            raise CheckpointError(
                f"the {part} of the checkpoint's {_class_name(model)} is {there}, that of the "
                f"config's model is {here}",
                where=where,
                next=f"name a checkpoint with {here}, or let model.{part}.type be {there}; "
                f"{_BY_FILE}",
            )


def _first_batches(
    dataset: Any, collator: Any, context: RunContext, section: str
) -> Iterator[Mapping[str, Any]]:
    """A batch of the first sample of each dataset that ``dataset`` is made of."""
    for part in _parts(dataset):
        with located(context.where(f"{section}.dataset")):
            batch = collator(part.get_samples([SampleKey(0, 0)]))
        yield batch


def _parts(dataset: Any) -> Iterator[Dataset]:
    """The datasets that a mixture is made of, or ``dataset`` itself, without frames in memory."""
    described = Dataset.adapt(dataset)
    for part in described.datasets:
        yield from _parts(part)
    if not described.datasets:
        uncached = getattr(dataset, "uncached", None)
        yield described if uncached is None else Dataset.adapt(uncached())


def _token_count(dataset: Any) -> int:
    """The largest number of ids of the tokenizers of a dataset, or of those it is made of."""
    described = Dataset.adapt(dataset)
    inner = max((_token_count(part) for part in described.datasets), default=0)
    return max(inner, token_count(described.pipeline))


def _related(theirs: Any, ours: Any, key: str) -> bool:
    """Whether the class of one table is that of the other, or inherits it; or one says none."""
    if not isinstance(theirs, Mapping) or not isinstance(ours, Mapping):
        return True
    names = [name for name in (theirs.get("type"), ours.get("type")) if isinstance(name, str)]
    if len(names) < 2:
        return True
    if _class_name(theirs) == _class_name(ours):
        return True
    registry = BY_NAME[SLOTS[key]]
    try:
        one, other = (registry.get(name) for name in names)
    except PluginError:
        return True  # it says so where the model is built
    return issubclass(one, other) or issubclass(other, one)


def _class_name(table: Any) -> str:
    return str(table.get("type")).rpartition(":")[2]
