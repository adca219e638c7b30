"""The simulated robots as environments, their expert as a policy, and the runners over both."""

from __future__ import annotations

import json
from importlib.metadata import version

import numpy as np
import pytest
from fluxvla_aloha.embodiment import aloha_spec
from fluxvla_sim.aloha.arms import HOME
from fluxvla_sim.environment import AlohaSimEnvironment, URSimEnvironment
from fluxvla_sim.eval_runner import AlohaSimEvalRunner, URSimEvalRunner
from fluxvla_sim.expert import SimExpert
from fluxvla_sim.operators import AlohaSimOperator

from fluxvla_core import build_runner_from_cfg
from fluxvla_core.contracts.check import check_class
from fluxvla_core.errors import CheckpointError, ConfigError
from fluxvla_core.evaluation import RolloutSettings, run_episode
from fluxvla_core.operators import BaseInferenceRunner, Camera, RunContext

LIFT = "pick up the cube with the right arm and hold it"


@pytest.fixture(scope="module")
def aloha():
    environment = AlohaSimEnvironment()
    yield environment
    environment.close()


def episode(environment, actor, task, seed, instructed=None, **settings):
    spec = environment.spec
    other = None if instructed is None else spec.task(instructed)
    settings = RolloutSettings(**{"replan_every": 5, **settings})
    return run_episode(environment, actor, spec.task(task), seed, settings, other)


@pytest.mark.parametrize("cls", [AlohaSimEnvironment, URSimEnvironment])
def test_what_an_environment_says_before_anything_is_built(cls):
    check_class("environments", cls, "fluxvla-sim")
    spec = cls(render="reference").spec
    assert spec.limited
    assert spec.details == {"render": "reference"}
    assert spec.embodiment.camera_names == cls.robot.cameras
    assert {task.max_steps for task in spec.tasks} == {300}
    with pytest.raises(
        ConfigError, match="render 'best' is unknown; choose one of cheap, coarse, reference"
    ):
        cls(render="best")


def test_only_tasks_of_one_scene_can_be_told_instead_of_each_other():
    environment = AlohaSimEnvironment()
    names = [task.name for task in environment.spec.tasks]
    assert names == ["transfer_cube", "lift_hold", "insertion"]
    assert environment.other_tasks("lift_hold") == ("transfer_cube",)
    assert environment.other_tasks("insertion") == ()
    with pytest.raises(ConfigError, match="there is no task 'juggle'; there are transfer_cube"):
        environment.reset(0, "juggle")


@pytest.mark.parametrize("task", ["lift_hold", "transfer_cube", "insertion"])
def test_the_expert_does_every_task_through_keyframes_and_limits(aloha, task):
    found = episode(aloha, SimExpert(), task, 7_000_001)
    assert found["success"]
    assert [name for name, did in found["behaviours"].items() if did] == [task]


def test_the_expert_lifts_the_cube_with_the_ur5e():
    environment = URSimEnvironment()
    found = episode(environment, SimExpert(), "lift_cube", 7_000_001)
    assert found["success"]
    assert found["return"] >= 10
    environment.close()


def test_an_episode_follows_from_its_seed_alone(aloha):
    hashes = [episode(aloha, SimExpert(), "lift_hold", seed)["state_hash"] for seed in (3, 4, 3)]
    assert hashes[0] == hashes[2] != hashes[1]


def test_whoever_is_told_the_other_task_does_that(aloha):
    found = episode(aloha, SimExpert(), "transfer_cube", 31, instructed="lift_hold")
    assert found["instruction"] == LIFT
    assert found["behaviours"] == {"transfer_cube": False, "lift_hold": True}
    assert (found["success"], found["steps"]) == (False, 300)


def watched(scene):
    """The commands that ``scene`` will be stepped with."""
    commands, step = [], scene.step

    def watch(action):
        commands.append(np.array(action))
        step(action)

    scene.step = watch
    return commands


def test_an_inference_run_sends_the_commands_that_were_evaluated(tmp_path):
    environment = AlohaSimEnvironment()
    evaluated = watched(environment.scene)
    found = episode(environment, SimExpert(), "transfer_cube", 31)
    operator, expert = AlohaSimOperator(camera_names=(), seed=31), SimExpert()
    expert.enter(operator)
    operator.connect()
    sent = watched(operator.scene)
    inference = BaseInferenceRunner(
        context=RunContext(
            work_dir=tmp_path, section="inference", task="hand the cube over to the left arm"
        ),
        free_tasks=True,
        policy=expert,
        operator=operator,
        execute_horizon=5,
        max_publish_step=300,
        record_fps=None,
    )
    inference.run_setup()
    inference.run()
    assert found["success"]
    assert operator.task_success()
    # Times are summed up in another order there; what is left is rounding.
    np.testing.assert_allclose(sent[: len(evaluated)], evaluated, atol=1e-9)


class Fixed:
    """A policy that always answers the same."""

    action_rate_hz, horizon, cameras = 10.0, 5, ()

    def __init__(self, chunk):
        self.chunk = chunk

    def reset(self, seed):
        self.seed = seed

    def predict_action(self, observation):
        self.observation = observation
        return self.chunk


def test_a_policy_that_does_nothing_fails_both_tasks(aloha):
    policy = Fixed(np.tile(HOME, (5, 1)))
    found = episode(aloha, policy, "lift_hold", 9, cameras=(Camera("top", 48, 64),))
    assert (found["success"], found["steps"], found["calls"]) == (False, 300, 12)
    assert found["behaviours"] == {"transfer_cube": False, "lift_hold": False}
    assert policy.observation["task_description"] == LIFT
    assert policy.observation["qpos"].shape == (14,)
    assert policy.observation["images"]["top"].shape == (48, 64, 3)


def test_wild_commands_are_kept_within_the_limits(aloha):
    wild = np.tile(np.where(np.arange(14) % 2, 1e3, -1e3), (5, 1))
    assert episode(aloha, Fixed(wild), "lift_hold", 9)["clamped"] == 300
    joints, sent = aloha_spec(()).joints, aloha.scene.data.ctrl
    assert (sent[:6] >= [j.lower for j in joints[:6]]).all()
    assert (sent[:6] <= [j.upper for j in joints[:6]]).all()


class TestExpert:
    def test_it_fulfils_its_contract(self):
        check_class("policies", SimExpert, "fluxvla-sim")

    def test_words_that_it_does_not_know_are_refused(self, aloha):
        aloha.reset(9, "lift_hold")
        expert = SimExpert()
        expert.enter(aloha)
        with pytest.raises(ConfigError, match="the expert does not know 'dance'"):
            expert.predict_action({"task_description": "dance"})

    def test_it_must_know_where_it_is(self):
        with pytest.raises(ConfigError, match="SimExpert does not know where it is"):
            SimExpert().predict_action({"task_description": LIFT})
        with pytest.raises(ConfigError, match="AlohaSimEnvironment and URSimEnvironment only"):
            SimExpert().enter(object())

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ({"action_rate_hz": 15.0}, "15 frames a second do not divide 50 control steps"),
            ({"action_rate_hz": 0.0}, "0 frames a second do not divide 50 control steps"),
            ({"horizon": 0}, "horizon must be at least 1, got 0"),
            ({"noise": 0.5}, "noise must be from 0 to 0.2 rad, got 0.5"),
        ],
    )
    def test_impossible_values_are_refused(self, arguments, message):
        with pytest.raises(ConfigError, match=message):
            SimExpert(**arguments)

    def test_noise_disturbs_what_is_executed_and_not_what_is_meant(self, aloha):
        aloha.reset(3, "lift_hold")
        plain, noisy = SimExpert(), SimExpert(noise=0.02)
        observation = aloha.observe(())
        for expert in (plain, noisy):
            expert.enter(aloha)
            expert.reset(3)
        meant = noisy.predict_action(observation)
        np.testing.assert_array_equal(meant, plain.predict_action(observation))
        np.testing.assert_array_equal(plain.executed[-1], meant[0])
        assert noisy.executed.shape == (5, 14)
        assert 0 < np.abs(noisy.executed[-1] - meant[0]).max() < 0.15


def runner(work_dir, cls=AlohaSimEvalRunner, **arguments):
    context = RunContext(work_dir=work_dir, section="eval")
    made = cls(context=context, **{"policy": "expert", "episodes": 1, "workers": 1, **arguments})
    made.run_setup()
    return made


def test_the_runner_evaluates_both_tasks_with_either_instruction(tmp_path):
    results = runner(tmp_path, instruction_swap=True, record_videos=1).run()
    written = json.loads((tmp_path / "eval" / "results.json").read_text())
    assert written == json.loads(json.dumps(results))
    assert (written["policy"], written["environment"]) == ("SimExpert", "AlohaSimEnvironment")
    for name in ("fluxvla-core", "fluxvla-sim", "gym-aloha", "dm-control", "mujoco"):
        assert written["provenance"]["versions"][name] == version(name)
    assert written["settings"]["render"] == "cheap"
    assert written["settings"]["replan_every"] == 5
    assert list(results["groups"]["policy"]["tasks"]) == ["lift_hold", "transfer_cube"]
    assert results["groups"]["policy"]["all"]["rate"] == 1.0
    assert results["groups"]["swapped"]["all"]["rate"] == 0.0
    expected = {"episodes": 1, "neither": 0, "transfer_cube": 0, "lift_hold": 1}
    assert results["behaviours"]["swapped"][LIFT] == expected
    lines = (tmp_path / "eval" / "episodes.jsonl").read_text().splitlines()[1:]
    seeds = {(r["group"], r["seed"]) for r in map(json.loads, lines)}
    assert seeds == {("policy", 500), ("swapped", 500)}
    tested = results["instruction_test"]
    assert (tested["pairs"], tested["only_a"], tested["only_b"]) == (2, 2, 0), "paired by seed"
    assert tested["verdict"] == "nothing shown: 2 pairs cannot show any difference"


def test_the_runner_of_the_ur5e(tmp_path):
    results = runner(tmp_path, URSimEvalRunner, record_videos=0).run()
    assert results["groups"]["policy"]["tasks"]["lift_cube"]["successes"] == 1


def test_without_a_checkpoint_the_message_says_what_to_do(tmp_path):
    with pytest.raises(CheckpointError, match="there is no undamaged checkpoint in") as caught:
        runner(tmp_path, policy="checkpoint")
    assert "train first" in str(caught.value)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"tasks": ("juggle",)}, "there is no task 'juggle'"),
        ({"tasks": ("lift_hold", "lift_hold")}, "tasks must name each task once"),
        ({"max_steps": 200}, "max_steps must be at least 300, got 200"),
        ({"render": "best"}, "render 'best' is unknown; choose one of cheap"),
        ({"video_cameras": ("head",)}, "'head' is unknown; choose one of top"),
        ({"environment": {"type": "x"}}, "AlohaSimEvalRunner is for AlohaSimEnvironment alone"),
    ],
)
def test_impossible_values_are_refused(tmp_path, arguments, message):
    origins = {f"eval.{name}": "exp.py:7" for name in arguments}
    context = RunContext(work_dir=tmp_path, section="eval", origins=origins)
    table = {"type": "AlohaSimEvalRunner", "policy": "expert", **arguments}

    def set_up():
        build_runner_from_cfg(table, context).run_setup()

    with pytest.raises(ConfigError, match=message) as caught:
        set_up()
    if "max_steps" in message:
        assert str(caught.value).startswith("exp.py:7: eval.max_steps")
