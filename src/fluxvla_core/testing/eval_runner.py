"""Conformance tests for evaluation runners, which a plugin inherits.

    from fluxvla_core.testing import EvalRunnerConformance

    class TestMyEvalRunner(EvalRunnerConformance):
        entry_point = "MyEvalRunner"

pytest collects the inherited tests. They evaluate policies with known results: one that always
succeeds, one that never does, one that does by its seed, and one that raises an error.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import pytest

from fluxvla_core.build import RunContext, build_runner_from_cfg, parameters
from fluxvla_core.evaluation.episodes import DONE, POLICY
from fluxvla_core.plugins.registry import ENVIRONMENTS, load_plugin_files
from fluxvla_core.testing._conformance import Conformance, capability, is_json

Outcomes = Mapping[tuple[str, int], bool]
"""(task, seed) -> whether the episode was a success."""

SEED, EPISODES, SHIFT = 20, 6, 2
_PUSHING = Path(__file__).with_name("_pushing.py")
_TOLERANCE = 1e-9


class Evaluated(NamedTuple):
    """An evaluation: what ``run`` returned, where it left its files, and its episodes then."""

    result: Any
    work_dir: Path
    outcomes: Outcomes


class Done:
    """Evaluations by their policy, each done once; their folders are in ``root``."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.kept: dict[str, Evaluated] = {}


class EvalRunnerConformance(Conformance):
    """Inherit, set ``entry_point`` and ``arguments``, and run pytest.

    ``arguments`` are further keys of the section. A runner that calls its keys otherwise overrides
    ``section``, one that leaves its results in other files ``outcomes`` and ``rate``.
    """

    registry = "runners"
    environment: ClassVar[Mapping[str, Any] | None] = {"type": "KitPush"}
    """The kit's own; None for a runner that has one environment alone, which then names ``tasks``
    and policies of that."""
    tasks: ClassVar[tuple[str, ...]] = ("left", "right")
    """The tasks of the evaluation."""
    always: ClassVar[Any] = "expert"
    """A policy that succeeds in every episode."""
    never: ClassVar[Any] = "KitIdler"
    """A policy that succeeds in none."""
    sometimes: ClassVar[Any] = "KitGuesser"
    """A policy that succeeds in some, by its seed; None if there is none."""
    broken: ClassVar[Any] = "KitBroken"
    """A policy that raises an error when it is asked; None if there is none."""

    @pytest.fixture(autouse=True)
    def pushing(self) -> None:
        """The kit's environment and policies are registered, in worker processes too."""
        if "KitPush" not in ENVIRONMENTS:
            load_plugin_files([_PUSHING])

    @pytest.fixture(scope="class")
    @classmethod
    def done(cls, tmp_path_factory: pytest.TempPathFactory) -> Done:
        """Evaluations that several checks look at."""
        return Done(tmp_path_factory.mktemp("evaluations"))

    def section(self, policy: Any, seed: int = SEED, episodes: int = EPISODES) -> dict[str, Any]:
        """The config's section: ``episodes`` for each task, the first of them with ``seed``."""
        taken = parameters(self.component())
        usual = {"environment": self.environment, "record_videos": 0, "workers": 1}
        there = {key: value for key, value in usual.items() if key in taken and value is not None}
        return {
            "type": self.entry_point,
            "policy": policy,
            "seed": seed,
            "episodes": episodes,
            **there,
            **self.arguments,
        }

    def build(self, work_dir: Path, section: Mapping[str, Any]) -> Any:
        """A new runner, as the command line builds it."""
        context = RunContext(config={"eval": section}, section="eval", work_dir=work_dir)
        return build_runner_from_cfg(section, context)

    def evaluate(self, work_dir: Path, policy: Any, **settings: Any) -> Any:
        """The result of a whole evaluation."""
        runner = self.build(work_dir, self.section(policy, **settings))
        runner.run_setup()
        return runner.run()

    def first(self, done: Done, policy: Any) -> Evaluated:
        """The evaluation of ``policy``."""
        key = repr(policy)
        if key not in done.kept:
            work_dir = done.root / str(len(done.kept))
            work_dir.mkdir()
            result = self.evaluate(work_dir, policy)
            done.kept[key] = Evaluated(result, work_dir, dict(self.outcomes(result, work_dir)))
        return done.kept[key]

    def outcomes(self, result: Any, work_dir: Path) -> Outcomes:
        """The episodes that have ended, of ``episodes*.jsonl`` in the work dir."""
        found: dict[tuple[str, int], bool] = {}
        for path in sorted(work_dir.rglob("episodes*.jsonl")):
            for row in map(json.loads, path.read_text(encoding="utf-8").splitlines()):
                if row.get("group") == POLICY and row.get("status") == DONE:
                    found[row["task"], row["seed"]] = bool(row["success"])
        return found

    def rate(self, result: Any) -> float:
        """The share of successes that ``run`` returned."""
        return float(result["groups"][POLICY]["all"]["rate"])

    def test_building_it_runs_nothing(self, tmp_path: Path) -> None:
        self.build(tmp_path, self.section(self.always)).run_setup()
        found = self.outcomes(None, tmp_path) if any(tmp_path.iterdir()) else {}
        assert not found, (
            f"the constructor and run_setup() left {len(found)} episodes, expected none before "
            "run(): what does not fit is refused before anything is simulated"
        )

    def test_every_task_has_its_episodes(self, done: Done) -> None:
        found = sorted(self.first(done, self.always).outcomes)
        expected = sorted((t, s) for t in self.tasks for s in range(SEED, SEED + EPISODES))
        lacks = [key for key in expected if key not in found]
        more = [key for key in found if key not in expected]
        assert not lacks + more, (
            f"{EPISODES} episodes of each of {', '.join(self.tasks)} from seed {SEED} on: "
            f"{len(found)} were there, {len(lacks)} are missing ({_few(lacks)}) and {len(more)} "
            f"are others ({_few(more)}), expected each task with each seed once: rates of two "
            "evaluations are compared episode by episode"
        )

    def test_what_run_returns_is_json(self, done: Done) -> None:
        result = self.first(done, self.always).result
        assert is_json(result), (
            f"run() returned {result!r:.200}, expected JSON values alone: programs read it from "
            "fluxvla run --log-format json"
        )

    def test_the_rate_is_that_of_the_episodes(self, done: Done) -> None:
        result, _, found = self.first(done, self._usual)
        share = sum(found.values()) / max(len(found), 1)
        said = self.rate(result)
        assert abs(said - share) < _TOLERANCE, (
            f"the rate is {said:.4g}, and {sum(found.values())} of {len(found)} episodes were "
            f"successes, expected {share:.4g}: it is what people compare policies by"
        )

    def test_a_policy_that_always_succeeds_does(self, done: Done) -> None:
        found = self.first(done, self.always).outcomes
        failed = [key for key, success in found.items() if not success]
        tasks = sorted({task for task, _ in failed})
        assert not failed, (
            f"{self.always!r} failed in {len(failed)} of {len(found)} episodes, of "
            f"{', '.join(tasks)}, expected in none: has it the instruction of its task, and its "
            "whole time? Success at any step counts"
        )

    def test_a_policy_that_never_succeeds_does_not(self, done: Done) -> None:
        found = self.first(done, self.never).outcomes
        successes = [key for key, success in found.items() if success]
        assert not successes, (
            f"{self.never!r} was a success in {len(successes)} of {len(found)} episodes, expected "
            "in none: is it the end of an episode that is counted, and not the environment's "
            "success?"
        )

    def test_an_evaluation_can_be_repeated(self, done: Done, tmp_path: Path) -> None:
        self._varied()
        first = self.first(done, self.sometimes).outcomes
        again = self.outcomes(self.evaluate(tmp_path, self.sometimes), tmp_path)
        differ = sorted(key for key in first if again.get(key) != first[key])
        assert not differ, (
            f"the same evaluation in two work dirs has other outcomes in {len(differ)} of "
            f"{len(first)} episodes ({_few(differ)}), expected the same: they follow from the "
            "policy, the task and the seed"
        )

    def test_an_episode_follows_from_its_own_seed(self, done: Done, tmp_path: Path) -> None:
        self._varied()
        first = self.first(done, self.sometimes).outcomes
        result = self.evaluate(tmp_path, self.sometimes, seed=SEED + SHIFT)
        later = self.outcomes(result, tmp_path)
        shared = sorted(set(first) & set(later))
        assert shared, (
            f"with seed = {SEED} the episodes are {_few(sorted(first))}, with {SEED + SHIFT} "
            f"{_few(sorted(later))}, expected some of the same seeds: they count up from it"
        )
        differ = [key for key in shared if first[key] != later[key]]
        assert not differ, (
            f"{len(differ)} of {len(shared)} episodes of the same task and seed ended otherwise "
            f"when the evaluation began at another seed ({_few(differ)}), expected the same: an "
            "episode follows from its own seed, not from those before it"
        )

    def test_the_same_command_again_changes_nothing(self, done: Done) -> None:
        first, work_dir, before = self.first(done, self._usual)
        again = self.evaluate(work_dir, self._usual)
        after = dict(self.outcomes(again, work_dir))
        assert after == before, (
            f"the same evaluation in the same work dir has {len(after)} episodes, and had "
            f"{len(before)}, expected the same ones: who starts a command that was interrupted "
            "again wants one evaluation"
        )
        assert abs(self.rate(again) - self.rate(first)) < _TOLERANCE, (
            f"the same evaluation in the same work dir has the rate {self.rate(again):.4g}, and "
            f"had {self.rate(first):.4g}, expected the same: are episodes counted twice?"
        )

    def test_an_error_is_no_result(self, tmp_path: Path) -> None:
        capability(self.broken is not None, "broken would be a policy that raises an error")
        result, raised = None, False
        try:
            result = self.evaluate(tmp_path, self.broken, episodes=1)
        except Exception:  # noqa: BLE001 - any will do
            raised = True
        assert raised, (
            f"{self.broken!r} raises an error in every episode, and run() returned "
            f"{result!r:.200}, expected an error: a rate of 0 would say that it was tried"
        )

    def _varied(self) -> None:
        capability(
            self.sometimes is not None,
            "sometimes would be a policy that succeeds in some episodes, by its seed",
        )

    @property
    def _usual(self) -> Any:
        return self.always if self.sometimes is None else self.sometimes


def _few(keys: list[tuple[str, int]]) -> str:
    return ", ".join(f"{task} {seed}" for task, seed in keys[:4]) or "none"
