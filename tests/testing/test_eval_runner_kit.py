"""The kit of evaluation runners: a right one passes, and each wrong one fails its own check."""

from __future__ import annotations

import pytest

from fluxvla_core.testing import EvalRunnerConformance

from .specimens import Fault, Outcomes, check_fault, check_good, outcomes

GOOD = """
import json
from pathlib import Path
from fluxvla_core import RUNNERS, Runner, RunContext
from fluxvla_core.build import build_environment_from_cfg, build_policy_from_cfg
from fluxvla_core.evaluation import RolloutSettings, run_episode
from fluxvla_core.testing import EvalRunnerConformance

@RUNNERS.register_module()
class Specimen(Runner):
    api = "1.0"
    def __init__(self, environment, policy, seed, episodes, context: RunContext):
        self.environment, self.policy = environment, policy
        self.seed, self.episodes = seed, episodes
        self.path = Path(context.work_dir) / "trials.json"
    def run_setup(self):
        self.place = build_environment_from_cfg(self.environment)
        self.tasks = self.place.spec.tasks
        name = self.place.expert if self.policy == "expert" else self.policy
        self.actor = build_policy_from_cfg({"type": name})
    def run(self):
        seeds = range(self.seed, self.seed + self.episodes)
        rows = [self.trial(task, seed) for seed in seeds for task in self.tasks]
        self.write(rows)
        done = sum(row["success"] for row in rows)
        return {"rate": done / len(rows)}
    def trial(self, task, seed):
        found = run_episode(self.place, self.actor, task, seed, RolloutSettings())
        return {"task": task.name, "seed": seed, "success": found["success"]}
    def write(self, rows):
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.path.write_text(json.dumps(rows))

class TestSpecimen(EvalRunnerConformance):
    entry_point = "Specimen"
    def outcomes(self, result, work_dir):
        path = work_dir / "trials.json"
        rows = json.loads(path.read_text()) if path.exists() else []
        return {(row["task"], row["seed"]): row["success"] for row in rows}
    def rate(self, result):
        return result["rate"]
"""
FOUND = "found = run_episode(self.place, self.actor, task, seed, RolloutSettings())"
SUCCESS = '"success": found["success"]'
VARIED = ("an_episode_follows_from_its_own_seed", "an_evaluation_can_be_repeated")
FAULTS = {
    "no version": Fault("is_complete", '    api = "1.0"\n', "", "the version of the contract"),
    "open": Fault(
        "constructor_names_every_parameter", "context: RunContext):",
        "context: RunContext, **more):", "expected every parameter by name",
    ),
    "runs at once": Fault(
        "building_it_runs_nothing", '        self.actor = build_policy_from_cfg({"type": name})\n',
        '        self.actor = build_policy_from_cfg({"type": name})\n'
        '        if self.policy == "expert":\n            self.run()\n',
        "expected none before run()",
    ),
    "one task": Fault(
        "every_task_has_its_episodes", "self.tasks = self.place.spec.tasks",
        "self.tasks = self.place.spec.tasks[:1]", "6 are missing (right 20",
    ),
    "one too few": Fault(
        "every_task_has_its_episodes", "self.seed + self.episodes)",
        "self.seed + max(self.episodes - 1, 1))", "2 are missing (left 25, right 25)",
    ),
    "own seeds": Fault(
        "every_task_has_its_episodes", "self.seed, self.episodes = seed, episodes",
        "self.seed, self.episodes = 0, episodes", "12 are others (left 0",
    ),
    "an object": Fault(
        "what_run_returns_is_json", 'return {"rate": done / len(rows)}',
        'return {"rate": done / len(rows), "path": self.path}', "expected JSON values",
    ),
    "rate of another number": Fault(
        "the_rate_is_that_of_the_episodes", 'done / len(rows)}', 'done / (len(rows) + 1)}',
        "it is what people compare policies by",
    ),
    "too short": Fault(
        "a_policy_that_always_succeeds_does", "RolloutSettings())", "RolloutSettings(max_steps=3))",
        "has it the instruction of its task, and its whole time?",
    ),
    "one instruction": Fault(
        "a_policy_that_always_succeeds_does", "self.tasks = self.place.spec.tasks",
        "self.tasks = self.place.spec.tasks\n        see = self.place.observe\n"
        "        self.place.observe = lambda cameras: {\n"
        '            **see(cameras), "task_description": self.tasks[0].instruction}',
        "of right, expected in none",
    ),
    "the end is a success": Fault(
        "a_policy_that_never_succeeds_does_not", SUCCESS,
        '"success": found["success"] or found["steps"] >= 12', "expected in none: is it the end",
    ),
    "chance": Fault(
        "an_evaluation_can_be_repeated", SUCCESS,
        '"success": found["success"] != (self.policy == "KitGuesser" and later(self))',
        "the same evaluation in two work dirs has other outcomes",
        ("an_episode_follows_from_its_own_seed", "the_same_command_again_changes_nothing"),
    ),
    "by its place": Fault(
        "an_episode_follows_from_its_own_seed",
        'return {"task": task.name, "seed": seed, ',
        "return {'task': task.name, 'seed': seed, 'success': found['success'] and not ("
        "self.policy == 'KitGuesser' and (seed - self.seed) % 3 == 1)}\n        return {",
        "an episode follows from its own seed, not from those before it",
    ),
    "counts again": Fault(
        "the_same_command_again_changes_nothing",
        "        self.write(rows)\n",
        "        if self.path.exists():\n            rows += [dict(row, success=False) for row in "
        "rows]\n        self.write(rows)\n",
        "expected the same",
    ),
    "goes on to new seeds": Fault(
        "the_same_command_again_changes_nothing",
        "    def run(self):\n",
        "    def run(self):\n        self.seed += 100 * self.path.exists()\n",
        "who starts a command that was interrupted again wants one evaluation",
    ),
    "an error is a failure": Fault(
        "an_error_is_no_result", f"        {FOUND}\n",
        f"        try:\n            {FOUND}\n        except ValueError:\n"
        "            found = {'success': False}\n",
        "a rate of 0 would say that it was tried",
    ),
}  # fmt: skip
LATER = """
RUNS = {}

def later(runner):
    return RUNS.setdefault(runner, len(RUNS)) > 0
"""


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Outcomes:
    return outcomes(tmp_path_factory.mktemp("runners"), LATER + GOOD, FAULTS)


def test_a_right_runner_passes_every_check(found: Outcomes) -> None:
    check_good(found, checks=12)


@pytest.mark.parametrize("name", FAULTS)
def test_a_wrong_runner_fails_its_own_check(found: Outcomes, name: str) -> None:
    check_fault(found, name, FAULTS[name])


class TestEvalRunner(EvalRunnerConformance):
    """The core's own."""

    entry_point = "EvalRunner"
