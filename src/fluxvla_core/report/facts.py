"""What a report is made of, whatever files it came from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Training:
    """The rows of ``metrics.jsonl``: one for each optimizer step.

    Args:
        steps: global step of each row.
        columns: name -> one value for each row, NaN where a row lacks it (``loss``, ``lr``,
            ``grad_norm``, ``samples_per_s``, ``step_time`` s, ``data_wait`` share in 0..1).
    """

    steps: Sequence[float]
    columns: Mapping[str, Sequence[float]]


@dataclass(frozen=True)
class Video:
    """An mp4 of one episode and what to say of it; ``success`` None: nobody judged it."""

    path: Path
    caption: str
    success: bool | None = None


@dataclass(frozen=True)
class Score:
    """How many episodes succeeded; ``low``, ``high``: bounds of the 95 % interval, in 0..1.

    ``errors`` episodes gave no result and are not among ``episodes`` (> 0).
    """

    task: str
    successes: int
    episodes: int
    low: float
    high: float
    errors: int = 0

    @property
    def rate(self) -> float:
        return self.successes / self.episodes


@dataclass(frozen=True)
class Group:
    """Who acted and what it was told: ``name`` as results have it, ``label`` for people."""

    name: str
    label: str
    total: Score
    tasks: Sequence[Score]


@dataclass(frozen=True)
class Behaviour:
    """What a group did after one instruction: how many of its episodes did which task."""

    group: str
    instruction: str
    episodes: int
    counts: Mapping[str, int]


@dataclass(frozen=True)
class Evaluation:
    """One evaluation: its groups, and videos in the order in which to show them.

    ``details`` are plain values that the results state beside the rates.
    """

    name: str
    groups: Sequence[Group]
    behaviours: Sequence[Behaviour] = ()
    videos: Sequence[Video] = ()
    details: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class JointTrace:
    """One joint over an episode: what was commanded, what was measured, where a limit acted.

    ``times`` s from the episode's start; ``clamped`` holds the times and the commands given.
    """

    name: str
    unit: str
    times: Sequence[float]
    commands: Sequence[float]
    states: Sequence[float]
    clamped: Sequence[tuple[float, float]] = ()


@dataclass(frozen=True)
class Episode:
    """One inference episode: how it went, its joints, how long each stage of its loop took.

    Args:
        name: its folder's.
        task: the instruction.
        outcome: how it ended; ``success`` is None when nobody judged it.
        joints: in the robot's order; empty when no command was sent.
        timings: stage -> ``count``, ``p50_ms``, ``p95_ms``, ``p99_ms``, ``max_ms``.
        notes: rows for its table.
    """

    name: str
    task: str
    outcome: str
    success: bool | None
    joints: Sequence[JointTrace]
    timings: Mapping[str, Mapping[str, Any]]
    videos: Sequence[Video] = ()
    notes: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Stage:
    """A named part of the whole job and how long it took (s)."""

    name: str
    seconds: float
    command: str = ""


@dataclass(frozen=True)
class Facts:
    """Everything that was found of a run; what was not is empty, and ``problems`` says why."""

    work_dir: Path
    training: Training | None = None
    evaluations: Sequence[Evaluation] = ()
    episodes: Sequence[Episode] = ()
    stages: Sequence[Stage] = ()
    dataset: Mapping[str, Any] = field(default_factory=dict)
    config: Mapping[str, Any] = field(default_factory=dict)
    environment: Mapping[str, Any] = field(default_factory=dict)
    problems: Sequence[str] = ()
