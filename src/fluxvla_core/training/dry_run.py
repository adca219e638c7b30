"""Dry run of a training (``--dry-run``): built without data, weights, memory or hardware.

From the dataset to the robot: shapes, cameras, statistics, limits, and the memory of each process.
What cannot be known is noted; nothing here ends the dry run.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from fluxvla_core.build import (
    RunContext,
    build_runner_from_cfg,
    build_vla_from_cfg,
    robot_of,
)
from fluxvla_core.contracts.training import VLA
from fluxvla_core.data.example import Example, Refused, example, is_here
from fluxvla_core.errors import CheckpointError, ConfigError, FluxError
from fluxvla_core.spec import EmbodimentSpec
from fluxvla_core.training import lora
from fluxvla_core.training.base_runner import BaseTrainRunner
from fluxvla_core.training.cost import (
    NO_ACTIVATIONS,
    Footprint,
    SavedActivations,
    fake,
    fake_activations,
    footprint,
    optimizer_bytes,
)
from fluxvla_core.training.fit_checks import Samples, check_observations, check_start, unfit
from fluxvla_core.training.input_sizes import Declared, chunk_of, declared_sizes
from fluxvla_core.training.lora import LoraOptions
from fluxvla_core.training.model import ForwardArguments, Layout, observations_of, trainable
from fluxvla_core.training.strategy import Strategy

T = TypeVar("T")
PROCESSES = (1, 2, 4, 8)
"""Numbers of processes to estimate memory for, without ``--nproc``."""


@dataclass
class DryRun:
    """Results of a dry run.

    Args:
        robot: that the policy acts on; see ``robot_of``.
        data: a sample.
        batch: the collator's: name -> shape and dtype.
        model: name of its class.
        parameters, trained: their numbers.
        action_shape: ``(T, D)`` of the model's chunks.
        memory: number of processes -> what each of them needs.
        precision: dtype that is computed in.
        notes: missing knowledge, and parts that do not fit together.
        skeleton: the model on the meta device, with its adapters.
        inputs: the batch itself.
        refused: the error that would end the training before its first step.
        unfit: the data, or the weights to start from, are not for this model: it was not built.
    """

    robot: EmbodimentSpec | None = None
    data: Example | None = None
    batch: dict[str, tuple[tuple[int, ...], str]] = field(default_factory=dict)
    model: str = ""
    parameters: int = 0
    trained: int = 0
    action_shape: tuple[int, int] | None = None
    memory: dict[int, Footprint] = field(default_factory=dict)
    precision: str = "float32"
    activations_known: bool = False
    notes: list[str] = field(default_factory=list)
    skeleton: nn.Module | None = None
    inputs: Mapping[str, Any] | None = None
    refused: FluxError | None = None
    unfit: bool = False


def dry_run(context: RunContext, processes: Sequence[int] = PROCESSES) -> DryRun:
    """Build the training of ``context.section`` as far as possible.

    Args:
        context: with the config's tree.
        processes: for which numbers of them to count the memory.
    """
    result = DryRun()
    notes = result.notes
    result.robot = _tried(notes, "the robot is not known", lambda: robot_of(context.config))
    runner = _runner(context, notes)
    sizes = _declared(context)
    result.action_shape = chunk_of(sizes)
    # Before the data only where nothing else says how long a chunk is.
    model = None if sizes else _model(context, result, runner)
    batch = _batch(context, result, runner)
    shown = _validation(context, result, runner)
    if batch is not None:
        dataset = None if result.data is None else result.data.dataset
        shown.insert(0, Samples("train_dataloader", dataset, [_real(batch, result.data)]))
    result.refused = result.refused or _unfit(context, result, runner, sizes, shown)
    if sizes and not result.unfit:
        model = _model(context, result, runner)
    result.skeleton, result.inputs = model, batch
    _compare(result)
    if result.refused is not None:
        batch = None
    elif model is not None and batch is not None:
        try:
            if result.data is not None and result.data.dataset is not None:
                check_observations(observations_of(model), result.data.dataset, context)
            ForwardArguments(model, context.where(f"{context.section}.collator"))(batch)
        except ConfigError as error:
            result.refused, batch = error, None
    if model is None or runner is None or not processes:
        return result
    if not result.trained:
        result.notes.append("the model has no trainable parameter: all of its parts are frozen")
        return result
    _count(result, model, runner, batch, processes)
    return result


def _declared(context: RunContext) -> Mapping[str, Declared]:
    """The sizes of batches that the model's class declares; empty if it cannot be loaded."""
    try:
        return declared_sizes(context.config["model"])
    except FluxError:
        return {}  # noted where the model is built


def _unfit(
    context: RunContext,
    found: DryRun,
    runner: BaseTrainRunner | None,
    sizes: Mapping[str, Declared],
    shown: Sequence[Samples],
) -> FluxError | None:
    """Why data, or the weights to start from, do not fit the model, which is not built then."""
    try:
        if runner is not None:
            check_start(context, runner.options.init_from, only_here=True)
        error: FluxError | None = unfit(context, sizes, shown) if sizes else None
    except (ConfigError, CheckpointError) as refused:
        error = refused
    found.unfit = error is not None
    return error


def _model(context: RunContext, found: DryRun, runner: BaseTrainRunner | None) -> nn.Module | None:
    """The model on the meta device, with its adapters; what is known of it goes into ``found``."""
    notes = found.notes
    what = "the model cannot be built on the meta device"
    model = _tried(notes, what, lambda: on_meta(context))
    if model is None:
        return None
    found.model = type(model).__name__
    found.parameters = sum(p.numel() for p in model.parameters())
    found.action_shape = VLA.adapt(model).action_shape
    if runner is not None and runner.lora is not None:
        attach = partial(_with_adapters, model, runner.lora, context)
        model = _tried(notes, "adapters cannot be put into the model", attach)
    if model is not None:
        found.trained = sum(p.numel() for p in trainable(model).values())
    return model


def on_meta(context: RunContext) -> nn.Module:
    """The config's ``model`` on the meta device.

    Raises:
        Exception: what its class raises.
    """
    with torch.device("meta"):
        model: nn.Module = build_vla_from_cfg(context.config["model"], context)
    return model


def memory_of(
    model: nn.Module,
    runner: Strategy,
    batch: Mapping[str, Any] | None,
    processes: Sequence[int],
    device_type: str,
) -> dict[int, Footprint]:
    """Number of processes -> what each of them needs on its device.

    Args:
        model: on the meta device, with its adapters.
        runner: the strategy, with its settings.
        batch: what the collator gives; None leaves activations out.

    Raises:
        Exception: what a model raises that decides by the values of its inputs.
    """
    options = runner.options
    by_dtypes: dict[tuple[tuple[str, torch.dtype], ...], SavedActivations] = {}
    by_shapes: dict[Any, int] = {}  # many processes hold the same as one
    footprints = {}
    for count in processes:
        layout = runner.memory_layout(model, count, device_type)
        lowered = tuple(layout.gathered_as.items())
        if lowered not in by_dtypes:
            by_dtypes[lowered] = (
                NO_ACTIVATIONS if batch is None else activations_of(model, layout, runner, batch)
            )
        shapes = tuple(tuple((t.shape, t.dtype) for t in group) for group in layout.optimized)
        if shapes not in by_shapes:
            build = runner.optimizer_settings.build
            by_shapes[shapes] = optimizer_bytes(build, layout.optimized)
        footprints[count] = footprint(
            layout,
            by_dtypes[lowered],
            by_shapes[shapes],
            averaged=options.ema_decay is not None,
            recompute=options.enable_gradient_checkpointing,
        )
    return footprints


def activations_of(
    model: nn.Module, layout: Layout, runner: Strategy, batch: Mapping[str, Any]
) -> SavedActivations:
    """Memory that a batch's forward pass saves for the backward pass; see :func:`memory_of`."""
    arguments = ForwardArguments(model)(batch)
    return fake_activations(fake(model, layout.gathered_as), arguments, runner.compute_dtype)


def _count(
    found: DryRun,
    model: nn.Module,
    runner: Strategy,
    batch: Mapping[str, Any] | None,
    processes: Sequence[int],
) -> None:
    if type(runner)._wrap_model is Strategy._wrap_model:
        processes = (1,)
    elif type(runner).memory_layout is Strategy.memory_layout:
        found.notes.append(
            f"{type(runner).__name__} does not say how it divides a model (memory_layout): the "
            "memory is that of whole copies"
        )
    if runner.compute_dtype is not None:
        found.precision = str(runner.compute_dtype).removeprefix("torch.")
    device = runner.options.device
    device_type = "cpu" if device == "cpu" else "cuda"
    for inputs in (batch, None):
        try:
            found.memory = memory_of(model, runner, inputs, processes, device_type)
        except Exception as error:  # noqa: BLE001 - another's model; an estimate must not end the run
            if isinstance(error, ConfigError) and inputs is not None:
                error.where = error.where or runner.context.where("model")
                found.refused = error
                continue
            what = "activations are" if inputs is not None else "memory is"
            found.notes.append(f"{what} not known: {_one_line(error)}")
            continue
        found.activations_known = inputs is not None
        return


def _tried(notes: list[str], what: str, make: Callable[[], T]) -> T | None:
    """``make()``, or None and a note if that fails: the other results are still of use."""
    try:
        return make()
    except Exception as error:  # noqa: BLE001 - classes of plugins, and peft's
        notes.append(f"{what}: {_one_line(error)}")
        return None


def _with_adapters(model: nn.Module, options: LoraOptions, context: RunContext) -> nn.Module:
    with torch.device("meta"):
        lora.attach(model, options, context.where(f"{context.section}.lora"))
    return model


def _runner(context: RunContext, notes: list[str]) -> BaseTrainRunner | None:
    """The section's runner without what it would open: trackers, observers, tokenizers."""
    table = {**context.config[context.section], "metric": None, "tokenizer": None}
    config = {k: v for k, v in context.config.items() if k != "hooks"}
    own = replace(context, config={**config, context.section: table})
    runner = _tried(notes, "the runner cannot be built", lambda: build_runner_from_cfg(table, own))
    if runner is None or isinstance(runner, BaseTrainRunner):
        return runner
    notes.append(f"{type(runner).__name__} is no BaseTrainRunner: its memory is not known")
    return None


def _batch(
    context: RunContext, result: DryRun, runner: BaseTrainRunner | None
) -> Mapping[str, Any] | None:
    try:
        table = context.config["train_dataloader"]["dataset"]
        widths = _widths(context.config.get("model", {}), result.action_shape)
        result.data = example(table, context, result.robot, widths)
        result.notes += result.data.assumed
        if runner is None:
            return None
        size = runner.loader_options.per_device_batch_size
        batch: Mapping[str, Any] = runner.collator([result.data.sample] * size)
    except Refused as refused:
        error = refused.error
        error.where = error.where or context.where("train_dataloader.dataset")
        result.refused = error
        return None
    except Exception as error:  # noqa: BLE001 - datasets and transforms of others
        result.notes.append(f"the batch is not known: {_one_line(error)}")
        return None
    result.batch = {
        key: (tuple(value.shape), str(value.dtype).removeprefix("torch."))
        for key, value in batch.items()
        if isinstance(value, Tensor)
    }
    return batch


def _validation(
    context: RunContext, result: DryRun, runner: BaseTrainRunner | None
) -> list[Samples]:
    """The first validation sample; nothing where the dataset is elsewhere: none is assumed."""
    if runner is None or runner.val_options is None:
        return []
    table = context.config["val_dataloader"]["dataset"]
    if not isinstance(table, Mapping) or not is_here(table):
        return []
    try:
        data = example(table, context, result.robot, (1, 1))
        batch: Mapping[str, Any] = runner.collator([data.sample])
    except Refused as refused:
        refused.error.where = refused.error.where or context.where("val_dataloader.dataset")
        result.refused = result.refused or refused.error
        return []
    except Exception as error:  # noqa: BLE001 - datasets and transforms of others
        result.notes.append(f"the validation data are not known: {_one_line(error)}")
        return []
    if data.dataset is None:
        return []
    return [Samples("val_dataloader", data.dataset, [_real(batch, data)])]


def _real(batch: Mapping[str, Any], data: Example | None) -> Mapping[str, Any]:
    """``batch`` without tokens of a tokenizer that is not the training's."""
    if data is None or not data.stand_in:
        return batch
    return {key: value for key, value in batch.items() if key != "lang_tokens"}


def _widths(model: Any, chunk: tuple[int, int] | None) -> tuple[int, int]:
    """Widths of states and actions that a model's table names; those of its chunks otherwise."""
    actions = _named(model, "ori_action_dim") or _named(model, "action_dim")
    actions = actions or (chunk[1] if chunk is not None else 1)
    return _named(model, "state_dim") or actions, actions


def _named(table: Any, key: str) -> int | None:
    """The first number under ``key`` in nested tables."""
    if not isinstance(table, Mapping):
        return None
    if isinstance(table.get(key), int):
        return int(table[key])
    inner = (_named(value, key) for value in table.values())
    return next((value for value in inner if value is not None), None)


def _compare(result: DryRun) -> None:
    """Note where data, model and robot do not fit together."""
    data, robot, chunk = result.data, result.robot, result.action_shape
    if data is not None and data.dataset is not None and robot is not None:
        for what, have, takes in (
            ("states", data.states, robot.state_dim),
            ("actions", data.actions, robot.dim),
        ):
            if have != takes:
                result.notes.append(
                    f"the dataset's {what} have {have} numbers, those of {robot.name} {takes}"
                )
    if robot is not None and data is not None:
        missing = sorted(set(data.cameras) - {camera.name for camera in robot.cameras})
        if missing:
            result.notes.append(f"{robot.name} has no camera {', '.join(missing)}")
    actions = result.batch.get("actions")
    if chunk is not None and actions is not None and actions[0][1:] != tuple(chunk):
        result.notes.append(
            f"the batch's actions are {actions[0][1:]} a sample, the model's chunks {tuple(chunk)}"
        )


def _one_line(error: Exception) -> str:
    text = error.what if isinstance(error, FluxError) else f"{type(error).__name__}: {error}"
    lines = text.strip().splitlines() or [type(error).__name__]
    return lines[0][:300]
