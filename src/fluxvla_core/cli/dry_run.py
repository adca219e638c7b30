"""The output of ``fluxvla run --dry-run``: the config, and shapes and memory of a training."""

from __future__ import annotations

import json
import textwrap
from typing import TYPE_CHECKING, Any

from fluxvla_core.cli.config_commands import listing, used
from fluxvla_core.cli.plan import Plan

if TYPE_CHECKING:
    from fluxvla_core.errors import FluxError
    from fluxvla_core.spec import EmbodimentSpec
    from fluxvla_core.training.dry_run import DryRun

_GB = 1e9
_COLUMNS = 80
_ROWS = {
    "parameters": "weights",
    "gradients": "gradients",
    "optimizer": "optimizer",
    "averages": "averaged weights",
    "gathered": "gathered, exchanged",
    "weight_copies": "weights to compute",
    "activations": "activations",
    "recomputed": "recomputed block",
    "batch": "batch",
    "total": "one process",
}


def outline(plan: Plan, log_format: str, nproc: int | None) -> tuple[str, FluxError | None]:
    """The text that ``--dry-run`` prints, and the error that the run would end with.

    Args:
        log_format: ``text`` or ``json``.
        nproc: processes of the training; None for a few numbers of them.
    """
    result = _dry_run(plan, nproc) if plan.trains and "model" in plan.config.tree else None
    refused = None if result is None or isinstance(result, str) else result.refused
    if log_format == "json":
        return json.dumps(_as_json(plan, result)), refused
    lines = [
        f"section: {plan.section} ({'trains' if plan.trains else 'does not train'})",
        f"work dir: {plan.work_dir}",
        "plugins:",
        *used(plan.uses),
        "config:",
        *(f"  {line}" for line in listing(plan.config, origin=True)),
    ]
    if isinstance(result, str):
        lines += ["pipeline:", f"  {result}"]
    elif result is not None:
        lines += ["pipeline:", *(f"  {line}" for line in _pipeline(result)), *_memory(result)]
    return "\n".join(lines), refused


def _dry_run(plan: Plan, nproc: int | None) -> DryRun | str:
    """The training, built on the meta device; or a line that says why it cannot be."""
    from fluxvla_core.build import RunContext
    from fluxvla_core.cli.reporters import heartbeat
    from fluxvla_core.config.tree import freeze

    try:
        from fluxvla_core.training.dry_run import PROCESSES, dry_run
    except ImportError as error:
        return f"shapes and memory are not known: {error}"
    context = RunContext(
        config=freeze(plan.config.tree),
        section=plan.section,
        work_dir=plan.work_dir,
        origins=plan.config.origins,
        config_file=plan.config.file,
        nproc=nproc or 1,
    )
    with heartbeat("building the training on the meta device"):
        return dry_run(context, PROCESSES if nproc is None else (nproc,))


def _as_json(plan: Plan, result: DryRun | str | None) -> dict[str, Any]:
    record: dict[str, Any] = {
        "section": plan.section,
        "trains": plan.trains,
        "work_dir": str(plan.work_dir),
        "plugins": [
            {"key": u.key, "type": u.found.title, "provided_by": u.found.origin} for u in plan.uses
        ],
        "config": plan.config.tree,
        "origins": dict(plan.config.origins),
    }
    if isinstance(result, str):
        return {**record, "notes": [result]}
    if result is None:
        return record
    from fluxvla_core.training.cost import LEFT_OUT

    data, robot, shape = result.data, result.robot, result.action_shape
    dataset = data and {
        "samples": None if data.dataset is None else len(data.dataset),
        "states": data.states,
        "actions": data.actions,
        "cameras": {name: list(size or ()) or None for name, size in data.cameras.items()},
    }
    pipeline = {
        "dataset": dataset,
        "batch": {k: {"shape": list(s), "dtype": d} for k, (s, d) in result.batch.items()},
        "model": {
            "type": result.model,
            "parameters": result.parameters,
            "trained": result.trained,
            "action_shape": None if shape is None else list(shape),
        },
        "robot": None if robot is None else robot.to_dict(),
    }
    memory = {
        "precision": result.precision,
        "activations_known": result.activations_known,
        "left_out": list(LEFT_OUT),
        "bytes": {str(count): one.to_dict() for count, one in result.memory.items()},
    }
    return {**record, "pipeline": pipeline, "memory": memory, "notes": result.notes}


def _pipeline(result: DryRun) -> list[str]:
    """Shapes from the data to the robot, a line each."""
    rows: list[tuple[str, str]] = []
    data = result.data
    if data is not None:
        rows.append(("dataset", _dataset(result)))
        cameras = [f"{name} {_size(size)}" for name, size in data.cameras.items()]
        rows.append(("cameras", ", ".join(cameras) or "none"))
        rows.append(("sample", f"states {data.states}, actions {data.actions} wide"))
    for number, (key, (shape, dtype)) in enumerate(result.batch.items()):
        rows.append(("" if number else "batch", f"{key} {shape} {dtype}"))
    if result.model:
        share = result.trained / result.parameters if result.parameters else 0.0
        counts = f"{result.parameters:,} parameters, {result.trained:,} trained ({share:.1%})"
        rows.append(("model", f"{result.model}: {counts}"))
        if result.action_shape is not None:
            rows.append(("", "chunks of {} actions, {} wide".format(*result.action_shape)))
    if result.robot is not None:
        rows += _robot(result.robot)
    rows += [("" if number else "notes", note) for number, note in enumerate(result.notes)]
    width = max((len(name) for name, _ in rows), default=0)
    return [
        line
        for name, text in rows
        for line in textwrap.wrap(
            text,
            _COLUMNS - 2,
            initial_indent=f"{name:{width}}  ",
            subsequent_indent=" " * (width + 4),
            break_long_words=False,
            break_on_hyphens=False,
        )
    ]


def _dataset(found: DryRun) -> str:
    assert found.data is not None
    dataset = found.data.dataset
    if dataset is None:
        return "not here: shapes are assumed (see notes)"
    rate = "" if dataset.fps is None else f" at {dataset.fps:g} Hz"
    stats = ", ".join(f"{name!r}" for name in dataset.statistics)
    return f"{len(dataset):,} samples{rate}, {len(dataset.tasks)} tasks, statistics {stats}"


def _robot(robot: EmbodimentSpec) -> list[tuple[str, str]]:
    joints = robot.joints
    cameras = ", ".join(f"{c.name} {_size((c.height, c.width))}" for c in robot.cameras)
    speeds = sum(joint.by_speed for joint in joints)
    jerks = sum(joint.jerk is not None for joint in joints)
    limits = f"{len(joints) - speeds} positions, {len(joints)} speeds and accelerations"
    return [
        ("robot", f"{robot.name}: {robot.dim} joints at {robot.rate_hz:g} Hz"),
        ("", f"cameras {cameras or 'none'}"),
        ("", f"limits of {limits}, {jerks} jerks"),
    ]


def _size(size: tuple[int, int] | None) -> str:
    return "of unknown size" if size is None else f"{size[0]}x{size[1]}"


def _memory(found: DryRun) -> list[str]:
    """The table of memory: a column for each number of processes, at most 80 characters."""
    if not found.memory:
        return []
    from fluxvla_core.training.cost import LEFT_OUT

    counts = list(found.memory)
    lines = [
        f"memory of each process in GB (1e9 bytes), computing in {found.precision}:",
        f"  {'processes':20}" + "".join(f"{count:>11}" for count in counts),
    ]
    for name, title in _ROWS.items():
        values = [one.to_dict()[name] for one in found.memory.values()]
        unknown = name == "activations" and not found.activations_known
        if max(values) < _GB / 2e3 and not unknown and name != "total":
            continue
        cells = "".join(f"{'?' if unknown else gigabytes(value):>11}" for value in values)
        lines.append(f"  {title:20}{cells}")
    together = [count * one.total for count, one in found.memory.items()]
    lines.append(f"  {'all processes':20}" + "".join(f"{gigabytes(v):>11}" for v in together))
    note = f"Not counted: {', '.join(LEFT_OUT)}."
    return [*lines, *textwrap.wrap(note, _COLUMNS, initial_indent="  ", subsequent_indent="  ")]


def gigabytes(count: int) -> str:
    """Bytes as GB of two decimals; three where there are few."""
    return f"{count / _GB:.3f}" if count < _GB else f"{count / _GB:,.2f}"
