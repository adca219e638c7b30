"""LIBERO's suites: which tasks there are, how long an episode may take, where it begins."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fluxvla_core.errors import ConfigError
from fluxvla_libero.require import quiet, require_libero

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

MAX_STEPS = {
    "libero_spatial": 220,
    "libero_object": 280,
    "libero_goal": 300,
    "libero_10": 520,
    "libero_90": 400,
}
"""Control steps after the waiting ones, as OpenVLA and openpi count them: a little more than the
longest human demonstration. LeRobot allows 280 for libero_spatial; such scores do not compare."""

PRO = ("lan", "object", "swap", "task")
"""LIBERO-PRO's perturbations of the 10-task suites, each a suite ``<suite>_<perturbation>``."""

SUITES = (
    *MAX_STEPS,
    *(f"{base}_{kind}" for base in list(MAX_STEPS)[:4] for kind in PRO),
)

NUM_STEPS_WAIT = 10
"""Steps in which the arm holds still and objects come to rest, before an episode's first."""


@dataclass(frozen=True)
class SuiteTask:
    """One task of a suite.

    Args:
        suite: its suite.
        index: its place in it.
        name: unique in the suite; the name of its files.
        language: the instruction.
        bddl: the file that describes scene and goal.
    """

    suite: str
    index: int
    name: str
    language: str
    bddl: Path


def max_steps(suite: str) -> int:
    """The most control steps that an episode of ``suite`` may take.

    Raises:
        ConfigError: an unknown suite.
    """
    check_suite(suite)
    return MAX_STEPS[suite] if suite in MAX_STEPS else MAX_STEPS[suite.rpartition("_")[0]]


def check_suite(suite: str) -> None:
    """Refuse a name that is not a suite's.

    Raises:
        ConfigError: the message lists the suites.
    """
    if suite not in SUITES:
        raise ConfigError(f"there is no suite {suite!r}; there are {', '.join(SUITES)}")


@lru_cache
def suite_tasks(suite: str) -> tuple[SuiteTask, ...]:
    """The tasks of ``suite`` in LIBERO's order (its task order 0).

    Raises:
        ConfigError: an unknown suite, or one that the installed LIBERO does not have.
        MissingPlugin, RunFailed: see ``require_libero``.
    """
    check_suite(suite)
    libero = require_libero()
    benchmarks = libero.benchmark.get_benchmark_dict()
    if suite not in benchmarks:
        raise ConfigError(f"the installed LIBERO has no suite {suite!r}")
    with quiet():
        found = benchmarks[suite]()
    tasks = []
    for index in range(found.get_num_tasks()):
        task = found.get_task(index)
        bddl = Path(libero.get_libero_path("bddl_files")) / task.problem_folder / task.bddl_file
        tasks.append(SuiteTask(suite, index, task.name, instruction(suite, task, bddl), bddl))
    return tuple(tasks)


def instruction(suite: str, task: object, bddl: Path) -> str:
    """The language instruction: the task's file name in words, as in all published evaluations.

    LIBERO-PRO's ``_lan`` suites keep the file names and reword the sentence in the file.
    """
    if not suite.endswith("_lan"):
        return str(task.language)  # type: ignore[attr-defined]
    from libero.libero.envs.bddl_utils import get_problem_info

    words = get_problem_info(str(bddl))["language_instruction"]
    return " ".join(words) if isinstance(words, list) else str(words)


def choose_tasks(suite: str, wanted: Sequence[int | str] | None) -> tuple[SuiteTask, ...]:
    """Tasks by index or name, in the order given; all of the suite for None.

    Raises:
        ConfigError: there is no such task, or one is named twice.
    """
    tasks = suite_tasks(suite)
    if wanted is None:
        return tasks
    by_name = {task.name: task for task in tasks}
    chosen = []
    for each in wanted:
        if isinstance(each, int) and 0 <= each < len(tasks):
            chosen.append(tasks[each])
        elif each in by_name:
            chosen.append(by_name[str(each)])
        else:
            known = ", ".join(f"{task.index} ({task.name})" for task in tasks)
            raise ConfigError(f"{suite} has no task {each!r}; it has {known}")
    if not chosen or len(set(chosen)) != len(chosen):
        raise ConfigError(f"tasks must name each task once, got {list(wanted)}")
    return tuple(chosen)


def can_be_done_in(task: SuiteTask, scene: SuiteTask) -> bool:
    """Whether everything that ``task``'s goal speaks of is in the scene of ``scene``."""
    there = _things(scene)
    names = [name for state in goal(task) for name in state[1:]]
    return all(any(n == t or n.startswith(f"{t}_") for t in there) for n in names)


@lru_cache(maxsize=256)
def goal(task: SuiteTask) -> tuple[tuple[str, ...], ...]:
    """The conditions of ``task``, which must all hold: a predicate and its arguments."""
    return tuple(tuple(state) for state in _parsed(task)["goal_state"])


@lru_cache(maxsize=256)
def _things(task: SuiteTask) -> frozenset[str]:
    parsed = _parsed(task)
    kinds = (*parsed["objects"].values(), *parsed["fixtures"].values())
    return frozenset(name for names in kinds for name in names)


def _parsed(task: SuiteTask) -> dict[str, Any]:
    require_libero()
    from libero.libero.envs.bddl_utils import robosuite_parse_problem

    parsed: dict[str, Any] = robosuite_parse_problem(str(task.bddl))
    return parsed


@lru_cache(maxsize=4)
def init_states(suite: str, index: int) -> npt.NDArray[np.float64]:
    """``(50, 1 + nq + nv)``: the fixed states in which a task's episodes begin."""
    import numpy as np

    libero = require_libero()
    with quiet():
        found = libero.benchmark.get_benchmark_dict()[suite]().get_task_init_states(index)
    return np.asarray(found, dtype=np.float64)
