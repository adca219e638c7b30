"""Whether datasets that are used together mean the same, and which robot they mean."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from fluxvla_core.data.files import read_json
from fluxvla_core.data.recording import Recorded
from fluxvla_core.errors import DataError, SpecMismatch
from fluxvla_core.spec.embodiment import EmbodimentSpec, check_match


def check_alike(recordings: Sequence[Recorded]) -> None:
    """Refuse datasets of different robots, rates, widths, or orders of the joints.

    Raises:
        SpecMismatch, DataError: naming both datasets and what differs.
    """
    first = recordings[0]
    for other in recordings[1:]:
        one, two = first.meta, other.meta
        if one.embodiment is not None and two.embodiment is not None:
            check_match(one.embodiment, two.embodiment, str(one.root), str(two.root), ())
        for what, left, right in (
            ("fps", one.fps, two.fps),
            ("width of the state", first.states.shape[1], other.states.shape[1]),
            ("width of the action", first.actions.shape[1], other.actions.shape[1]),
        ):
            if left != right:
                raise DataError(
                    f"{one.root} and {two.root} do not go together: {what}: {left} / {right}"
                )
        for what, here, there in _names(first, other):
            if here != there and sorted(here) == sorted(there):
                raise DataError(
                    f"{one.root} and {two.root} do not go together: {what}: the same names in "
                    f"another order: {', '.join(here)} / {', '.join(there)}",
                    next="write one of them anew with its columns in the order of the other",
                )


def doubts(recordings: Sequence[Recorded]) -> list[str]:
    """What datasets that are used together call differently: it may be another robot."""
    first = recordings[0]
    return [
        f"{first.meta.root} and {other.meta.root} are used as one robot's, but {what} have other "
        f"names: {', '.join(here)} / {', '.join(there)}"
        for other in recordings[1:]
        for what, here, there in _names(first, other)
        if here != there
    ]


def _names(one: Recorded, two: Recorded) -> list[tuple[str, tuple[str, ...], tuple[str, ...]]]:
    """What states and actions are called in both, where both say."""
    pairs = (
        ("states", one.state_names, two.state_names),
        ("actions", one.action_names, two.action_names),
    )
    return [pair for pair in pairs if pair[1] and pair[2]]


def find_embodiment(
    recordings: Sequence[Recorded], given: Mapping[str, Any] | str | None
) -> EmbodimentSpec | None:
    """The robot that the datasets were recorded with: what they say, else what is ``given``.

    Raises:
        SpecMismatch: both say, and differ; or the robot has other joints than the data has columns.
        DataError: ``given`` is a path that cannot be read.
    """
    said = next((r.meta.embodiment for r in recordings if r.meta.embodiment is not None), None)
    root, first = recordings[0].meta.root, recordings[0]
    if given is not None:
        table = read_json(Path(given)) if isinstance(given, str) else given
        spec = EmbodimentSpec.from_dict(table)
        if said is not None:
            check_match(spec, said, "the config's embodiment", str(root), ())
        said = spec
    if said is None:
        return None
    for what, joints, columns in (
        ("states", said.state_dim, first.states.shape[1]),
        ("actions", said.dim, first.actions.shape[1]),
    ):
        if joints != columns:
            raise SpecMismatch(
                f"{root}: {what} have {columns} columns, the robot {said.name} has {joints} joints",
                next="name the features that belong to the robot: state_key and action_key",
            )
    return said
