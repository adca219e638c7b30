"""Data classes of a report's content: training, evaluations, recorded episodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

WRONG_INSTRUCTION = "swapped"
"""The group of an evaluation whose policy gets another task's instruction."""


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
    """An mp4 of one episode with its caption; ``success`` is None if unknown.

    ``group`` and ``task`` are those of an evaluation's results.
    """

    path: Path
    caption: str
    success: bool | None = None
    group: str = ""
    task: str = ""


@dataclass(frozen=True)
class Score:
    """Number of successful episodes; ``low``, ``high``: bounds of the 95 % interval, in 0..1.

    ``errors`` episodes gave no result and are not among ``episodes`` (> 0). ``mean_return``: None
    where the environment gives no rewards.
    """

    task: str
    successes: int
    episodes: int
    low: float
    high: float
    errors: int = 0
    mean_return: float | None = None

    @property
    def rate(self) -> float:
        return self.successes / self.episodes


@dataclass(frozen=True)
class Group:
    """A policy with its instructions: ``name`` as results have it, ``label`` as displayed."""

    name: str
    label: str
    total: Score
    tasks: Sequence[Score]


@dataclass(frozen=True)
class Behaviour:
    """In how many episodes of a group, with one instruction, which task was done."""

    group: str
    instruction: str
    episodes: int
    counts: Mapping[str, int]


@dataclass(frozen=True)
class Evaluation:
    """One evaluation: its groups, and videos in the order in which to show them.

    ``problems`` say in how many episodes what went wrong, the most frequent first. ``details`` are
    plain values that the results state with the rates. ``obeyed`` is how often a group did the
    task of its instruction, whatever the scene's own task is. ``live``: the simulation ran on the
    wall clock and did not wait for the policy. ``unseen``: the seeds of the training are known and
    none of them was evaluated. ``made``: when it ran, its commit and versions.
    """

    name: str
    groups: Sequence[Group]
    problems: Sequence[str] = ()
    behaviours: Sequence[Behaviour] = ()
    videos: Sequence[Video] = ()
    details: Mapping[str, Any] = field(default_factory=dict)
    made: str = ""
    live: bool = False
    unseen: bool = False
    obeyed: Mapping[str, Score] = field(default_factory=dict)

    @property
    def has_returns(self) -> bool:
        """Whether its episodes have a return, the sum of their rewards."""
        return any(group.total.mean_return is not None for group in self.groups)

    def scored_by_instruction(self, group: Group) -> bool:
        """Whether the group's score is how often it follows its instruction, which is not that of
        the scene's own task."""
        return group.name == WRONG_INSTRUCTION and group.name in self.obeyed


@dataclass(frozen=True)
class JointTrace:
    """One joint over an episode: what was commanded, what was measured, where a limit acted.

    ``times`` s from the first command; ``wanted`` is the target before the limits, ``clamped``
    holds the times and the commands given, ``limits`` the lowest and the highest position.
    """

    name: str
    unit: str
    times: Sequence[float]
    commands: Sequence[float]
    states: Sequence[float]
    clamped: Sequence[tuple[float, float]] = ()
    wanted: Sequence[float] = ()
    limits: tuple[float, float] | None = None
    gripper: bool = False


@dataclass(frozen=True)
class Span:
    """A named stretch of an episode, s from its first command."""

    name: str
    start: float
    end: float


@dataclass(frozen=True)
class Moment:
    """An event, s from the first command, with its description."""

    at: float
    name: str
    text: str = ""


@dataclass(frozen=True)
class Episode:
    """One inference episode: how it went, its joints, how long each stage of its loop took.

    Args:
        name: its folder's.
        task: the instruction.
        outcome: how it ended; ``success`` is None if unknown.
        joints: in the robot's order; empty when no command was sent.
        timings: stage -> ``count``, ``p50_ms``, ``p95_ms``, ``p99_ms``, ``max_ms``.
        problem: why it ended before its time; empty if it did not.
        phases: what the commands were for: ``ramp``, ``run``, ``hold``, ``stop``.
        chunks: when the policy's answers arrived, s from the first command.
        stops: the safe stops and trips.
        simulated: whether time stood still while the policy thought: its latencies say nothing.
        notes: rows for its table.
    """

    name: str
    task: str
    outcome: str
    success: bool | None
    joints: Sequence[JointTrace]
    timings: Mapping[str, Mapping[str, Any]]
    videos: Sequence[Video] = ()
    problem: str = ""
    phases: Sequence[Span] = ()
    chunks: Sequence[float] = ()
    stops: Sequence[Moment] = ()
    simulated: bool = False
    notes: Mapping[str, Any] = field(default_factory=dict)

    @property
    def seconds(self) -> float:
        """From the first command to the last."""
        return max((joint.times[-1] for joint in self.joints if joint.times), default=0.0)

    @property
    def clamped(self) -> int:
        """The number of commands that a limit changed."""
        return len({time for joint in self.joints for time, _ in joint.clamped})


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
