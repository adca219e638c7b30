"""Robots of published GR00T checkpoints: cameras, statistics, embodiment ids.

A checkpoint may know several robots by their tags. N1.5 has ``experiment_cfg/metadata.json``:
``{tag: {"statistics": {"state" | "action": {group: {min, max, mean, std, q01, q99}}}, "modalities":
{"video": {camera: {"fps": …}}}}}``. N1.7 has ``statistics.json`` with the statistics alone and
``relative_action`` among them, ``processor_config.json`` with ``processor_kwargs.modality_configs``
(for each tag the order of cameras and groups, and which actions are relative) and
``embodiment_id.json``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from fluxvla_models.lerobot_files import check_both

from fluxvla_core.errors import CheckpointError
from fluxvla_core.models import chosen_robot, without_cameras
from fluxvla_core.results import read_json

N15_EMBODIMENTS = {
    "so100": 2,
    "unitree_g1": 3,
    "oxe_droid": 17,
    "gr1": 24,
    "agibot_genie1": 26,
    "new_embodiment": 31,
}
"""Tag -> number of the layers in N1.5, whose files do not say it."""
_OWN = "new_embodiment"
_NAMES = ("min", "max", "mean", "std", "q01", "q99")
Entry = dict[str, list[Any]]


@dataclass(frozen=True)
class Robot:
    """One robot of a checkpoint, or none (``tag`` None) where it has to be chosen.

    Args:
        tag: its name there.
        embodiment_id: which layers of the head are its own.
        img_keys: its cameras, in their order.
        statistics: ``{"proprio": {...}, "action": {...}}``.
        norm_type: what normalises by them.
        horizon: actions of a chunk that were trained; None: all.
        rate: actions a second, where it is said.
        notes: what somebody who uses it ought to know.
    """

    tag: str | None = None
    embodiment_id: int = 0
    img_keys: tuple[str, ...] = ()
    statistics: Mapping[str, Entry] = field(default_factory=dict)
    norm_type: str = "min_max"
    horizon: int | None = None
    rate: float | None = None
    notes: tuple[str, ...] = ()


def n15_robot(folder: Path, wanted: str | None = None) -> Robot:
    """The robot of a checkpoint of N1.5: the one with the tag ``wanted``, or the only one.

    Raises:
        CheckpointError: a file is damaged, or its robot has no number.
        UsageError: there is no robot ``wanted``.
    """
    file = folder / "experiment_cfg" / "metadata.json"
    if not file.is_file():
        chosen_robot((), wanted, str(file))
        return Robot(notes=(_NO_STATISTICS,))
    tags = read_json(file, dict[str, Any], CheckpointError)
    tag = _chosen(tags, wanted, str(file))
    if tag is None:
        return Robot(notes=(_several(tags),))
    where = str(file)
    facts = _table(tags, tag, where)
    statistics = _table(facts, "statistics", where)
    modalities = _table(facts, "modalities", where)
    cameras = _table(modalities, "video", where)
    rates = {float(_table(cameras, name, where).get("fps") or 0) for name in cameras}
    entries = {
        ours: _joined(
            [_group(_table(statistics, theirs, where), name, where) for name in order], where
        )
        for ours, theirs, order in (
            ("proprio", "state", list(_table(modalities, "state", where))),
            ("action", "action", list(_table(modalities, "action", where))),
        )
    }
    return Robot(
        tag=tag,
        embodiment_id=_number(N15_EMBODIMENTS, tag, where),
        img_keys=tuple(cameras),
        statistics={k: _widened(k, entry, ("min", "max"), where) for k, entry in entries.items()},
        rate=rates.pop() or None if len(rates) == 1 else None,
        notes=(
            "its groups of joints are in the order of metadata.json; a data config of NVIDIA's "
            "may have had another, or have cut images first",
        ),
    )


def n17_robot(folder: Path, settings: Mapping[str, Any], wanted: str | None = None) -> Robot:
    """The robot of a checkpoint of N1.7: the one with the tag ``wanted``, or the only one.

    Args:
        settings: its ``processor_kwargs``.

    Raises:
        CheckpointError: a file is damaged, or its robot has no number or no statistics.
        UsageError: there is no robot ``wanted``.
    """
    where = str(folder / "processor_config.json")
    configs = _table(settings, "modality_configs", where)
    file = folder / "statistics.json"
    if not file.is_file() or not configs:
        chosen_robot((), wanted, where)
        return Robot(notes=(_NO_STATISTICS,))
    known = read_json(file, dict[str, Any], CheckpointError)
    tag = _chosen(configs, wanted, where)
    if tag is None:
        return Robot(notes=(_several(configs),))
    ids = read_json(folder / "embodiment_id.json", dict[str, Any], CheckpointError)
    number = _number(ids, tag, str(folder / "embodiment_id.json"))
    config, statistics = _table(configs, tag, where), _table(known, tag, str(file))
    return grouped_robot(tag, number, config, statistics, settings, where)


def grouped_robot(
    tag: str,
    number: int,
    config: Mapping[str, Any],
    statistics: Mapping[str, Any],
    settings: Mapping[str, Any],
    where: str,
) -> Robot:
    """One robot of N1.7.

    Args:
        config: its table of ``modality_configs``.
        statistics: its table of ``statistics.json``.
        settings: ``processor_kwargs``.
        where: the file, for messages.

    Raises:
        CheckpointError: the tables are damaged.
    """
    video = _table(config, "video", where)
    action = _table(config, "action", where)
    robot = Robot(
        tag=tag,
        embodiment_id=number,
        img_keys=tuple(_names(video, where)),
        norm_type="mean_std"
        if settings.get("use_mean_std")
        else ("quantile" if settings.get("use_percentiles") else "min_max"),
        horizon=len(action.get("delta_indices") or []) or None,
    )
    state = _table(config, "state", where)
    refusal = _refusal(tag, video, state, action, settings)
    if refusal:
        return replace(robot, notes=(refusal,))
    states = _names(state, where)
    relative = _relative(action, settings)
    entries = {
        "proprio": _joined(
            [_group(_table(statistics, "state", where), n, where) for n in states],
            where,
        ),
        "action": _actions(statistics, _names(action, where), relative, where),
    }
    if relative:
        flags = _from_state(statistics, states, _names(action, where), relative, where)
        if flags is None:
            refusal = (
                "its relative actions are counted from states in another order: it can be trained "
                "on, and drives no robot"
            )
            return replace(robot, notes=(refusal,))
        entries["action"]["relative"] = flags
    used = {"quantile": ("q01", "q99"), "min_max": ("min", "max")}.get(robot.norm_type)
    needed = used or ("mean", "std")
    widened = {key: _widened(key, entry, needed, where) for key, entry in entries.items()}
    return replace(robot, statistics=widened)


def flat_robot(tag: str, number: int, values: Mapping[str, Any], where: str) -> Robot:
    """One robot whose statistics are not in groups.

    Args:
        values: ``observation.state.<statistic>`` and ``action.<statistic>`` -> numbers.

    Raises:
        CheckpointError: they are damaged.
    """
    tables: dict[str, dict[str, Any]] = {"observation.state": {}, "action": {}}
    for name, numbers in values.items():
        feature, _, statistic = name.rpartition(".")
        if feature in tables:
            tables[feature][statistic] = numbers
    robot = Robot(tag=tag, embodiment_id=number)
    if not any(tables.values()):
        return replace(robot, notes=(_NO_STATISTICS,))
    check_both(tables, where)
    entries = {
        "proprio": _joined([_group(tables, "observation.state", where)], where),
        "action": _joined([_group(tables, "action", where)], where),
    }
    widened = {k: _widened(k, entry, ("min", "max"), where) for k, entry in entries.items()}
    return replace(robot, statistics=widened)


def fewer_cameras(robot: Robot, absent: Sequence[str], where: str) -> Robot:
    """``robot`` without the cameras ``absent``.

    Raises:
        UsageError: there are no such cameras, or none is left.
    """
    return replace(
        robot, img_keys=without_cameras(robot.img_keys, absent, where) if absent else robot.img_keys
    )


GRIPPER = (
    "its gripper's actions are 0 to 1, and those of LIBERO's simulator 1 to -1, to which they are "
    "not converted here: it can be trained on, and drives no robot"
)
_NO_STATISTICS = "it has no statistics of a robot: it can be trained on, and drives none"


_SINES, _MEANS = "apply_sincos_state_encoding", "mean_std_embedding_keys"
"""Settings by which NVIDIA's processor encodes or normalises some groups by themselves."""


def _several(tags: Mapping[str, Any]) -> str:
    return (
        f"it knows several robots ({', '.join(sorted(tags))}): choose one by --robot NAME; as it "
        "is, it can be trained on, and drives none"
    )


def _chosen(tags: Mapping[str, Any], wanted: str | None, where: str) -> str | None:
    """The robot ``wanted``, the only one, or the one that somebody has fine-tuned for."""
    chosen = chosen_robot(tags, wanted, where)
    return _OWN if chosen is None and _OWN in tags else chosen


def _refusal(
    tag: str,
    video: Mapping[str, Any],
    state: Mapping[str, Any],
    action: Mapping[str, Any],
    settings: Mapping[str, Any],
) -> str | None:
    """Why the robot cannot be driven, if so."""
    if tag == "libero_sim":
        return GRIPPER
    if len(video.get("delta_indices") or [0]) != 1:
        return "it looks at several frames at once: it can be trained on, and drives no robot"
    if len(state.get("delta_indices") or [0]) != 1:
        return "it is given several states at once: it can be trained on, and drives no robot"
    encoded = state.get("sin_cos_embedding_keys") if settings.get(_SINES) else None
    apart = [*(encoded or ()), *(k for t in (state, action) for k in t.get(_MEANS) or ())]
    if apart and not settings.get("use_mean_std"):
        return (
            f"its groups {', '.join(map(str, apart))} are normalised in another way than the "
            "others, which is not done here: it can be trained on, and drives no robot"
        )
    poses = [
        name
        for name, config in _relative(action, settings).items()
        if str(config.get("type")).lower() == "eef"
    ]
    if poses:
        return (
            f"its actions {', '.join(poses)} are poses relative to the hand's, which are not "
            "converted here: it can be trained on, and drives no robot"
        )
    return None


def _relative(action: Mapping[str, Any], settings: Mapping[str, Any]) -> dict[str, Any]:
    """Groups of relative actions -> their settings."""
    if not settings.get("use_relative_action"):
        return {}
    names, configs = action.get("modality_keys") or [], action.get("action_configs") or []
    pairs = zip(names, configs, strict=False)
    return {n: c for n, c in pairs if c and str(c.get("rep")).lower() == "relative"}


def _actions(
    statistics: Mapping[str, Any], names: Sequence[str], relative: Mapping[str, Any], where: str
) -> Entry:
    """The entry of actions; relative groups are normalised by min and max whatever the others."""
    groups = []
    for name in names:
        if name not in relative:
            groups.append(_group(_table(statistics, "action", where), name, where))
            continue
        group = _group(_table(statistics, "relative_action", where), name, where)
        groups.append({**group, "q01": group["min"], "q99": group["max"]})
    return _joined(groups, where)


def _from_state(
    statistics: Mapping[str, Any],
    states: Sequence[str],
    actions: Sequence[str],
    relative: Mapping[str, Any],
    where: str,
) -> list[float] | None:
    """1 where an action is counted from the state of the same place; None if one is elsewhere."""
    starts, place = {}, 0
    for name in states:
        starts[name] = place
        place += _width(_group(_table(statistics, "state", where), name, where))
    flags: list[float] = []
    for name in actions:
        width = _width(_group(_table(statistics, "action", where), name, where))
        if name in relative and starts.get(relative[name].get("state_key") or name) != len(flags):
            return None
        flags += [float(name in relative)] * width
    return flags


def _names(config: Mapping[str, Any], where: str) -> list[str]:
    names = config.get("modality_keys")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise CheckpointError("modality_keys: no list of names", where=where)
    return names


def _number(ids: Mapping[str, Any], tag: str, where: str) -> int:
    number = ids.get(tag)
    if not isinstance(number, int) or isinstance(number, bool):
        raise CheckpointError(
            f"robot {tag!r} has no number; {', '.join(sorted(ids))} have", where=where
        )
    return number


def _table(tables: Mapping[str, Any], name: str, where: str) -> dict[str, Any]:
    table = tables.get(name)
    if not isinstance(table, dict):
        raise CheckpointError(f"{name}: no table", where=where)
    return table


def _group(groups: Mapping[str, Any], name: str, where: str) -> dict[str, Any]:
    """One group's statistics as arrays ``(D,)`` or ``(T, D)``."""
    table = _table(groups, name, where)
    try:
        arrays = {n: np.asarray(table[n], np.float64) for n in _NAMES if n in table}
    except (TypeError, ValueError) as error:
        raise CheckpointError(f"{name}: not numbers", where=where) from error
    shapes = {array.shape for array in arrays.values()}
    if "mean" not in arrays or len(shapes) != 1 or not 1 <= arrays["mean"].ndim <= 2:
        raise CheckpointError(f"{name}: not statistics of one shape: {shapes}", where=where)
    return arrays


def _width(group: Mapping[str, Any]) -> int:
    return int(group["mean"].shape[-1])


def _joined(groups: Sequence[Mapping[str, Any]], where: str) -> Entry:
    """Groups side by side; those of one row are repeated where others have one a step."""
    if not groups:
        raise CheckpointError("there are no groups of states or actions", where=where)
    names = [name for name in _NAMES if all(name in group for group in groups)]
    steps = {len(group["mean"]) for group in groups if group["mean"].ndim == 2}
    if len(steps) > 1:
        raise CheckpointError(f"statistics of {sorted(steps)} steps side by side", where=where)
    joined: Entry = {}
    for name in names:
        arrays = [group[name] for group in groups]
        if steps:
            rows = next(iter(steps))
            arrays = [np.broadcast_to(a, (rows, a.shape[-1])) for a in arrays]
        joined[name] = np.concatenate(arrays, axis=-1).tolist()
    return joined


def _widened(key: str, entry: Entry, names: tuple[str, str], where: str) -> Entry:
    """A range of 0 becomes one of 2 around its value, so that it normalises to 0 and goes back.

    Raises:
        CheckpointError: one of the statistics ``names`` is not there.
    """
    missing = [name for name in names if name not in entry]
    if missing:
        raise CheckpointError(
            f"the statistics of {key!r} are needed for {' and '.join(names)}, and not all groups "
            f"have {missing[0]!r}; they have {', '.join(entry) or 'nothing'}",
            where=where,
            cause="they were computed by another version, or the file was changed",
        )
    if names == ("mean", "std"):
        return entry
    low, high = (np.asarray(entry[name]) for name in names)
    still = low == high
    return {
        **entry,
        names[0]: np.where(still, low - 1, low).tolist(),
        names[1]: np.where(still, high + 1, high).tolist(),
    }
