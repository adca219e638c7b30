"""One episode: when it ends, what is executed, what is recorded, what is refused."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from fluxvla_core.errors import ConfigError, RunFailed, SpecMismatch
from fluxvla_core.evaluation.policies import RandomPolicy, match_policy, resolve_policy
from fluxvla_core.evaluation.rollout import RolloutSettings, memory_mb, run_episode, swapped_task
from fluxvla_core.evaluation.stepping import Diverged
from fluxvla_core.spec import Camera


@pytest.fixture
def walk(walking):
    return sys.modules["fluxvla_plugin_walking"]


class Says:
    """Answers with what it was given."""

    def __init__(self, chunk, **attributes):
        self.chunk = chunk
        self.__dict__.update(attributes)

    def reset(self, seed):
        self.seed = seed

    def predict_action(self, observation):
        self.seen = observation
        return self.chunk


def episode(environment, actor, task="right", instructed=None, on_step=None, **settings):
    spec = environment.spec
    other = None if instructed is None else spec.task(instructed)
    settings = RolloutSettings(**settings)
    return run_episode(environment, actor, spec.task(task), 5, settings, other, on_step)


def test_it_ends_with_the_environment_or_with_the_steps(walk):
    assert episode(walk.Walk(), Says([[0.5]]))["success"] is True
    stood = episode(walk.Walk(), Says([[0.0]]), max_steps=7)
    assert (stood["success"], stood["steps"], stood["calls"]) == (False, 7, 7)
    assert episode(walk.Walk(), Says([[0.0]]))["steps"] == 40, "the task's own limit"


def test_so_many_actions_of_a_chunk_are_used(walk):
    chunk = [[0.0]] * 6
    assert episode(walk.Walk(), Says(chunk), max_steps=12)["calls"] == 2
    assert episode(walk.Walk(), Says(chunk), max_steps=12, replan_every=4)["calls"] == 3


class LooksBack(Says):
    """Keeps what its questions show."""

    def reset(self, seed):
        self.shown = []

    def predict_action(self, observation):
        seen = [*observation["history"], observation]
        self.shown.append([float(each["qpos"][0]) for each in seen])
        return self.chunk


@pytest.mark.parametrize(
    ("rate", "n_obs_steps", "replan_every", "steps"),
    [
        (10.0, 2, None, [[0, 0], [5, 6], [11, 12]]),
        (10.0, 3, 1, [[0, 0, 0], [0, 0, 1], [0, 1, 2], [1, 2, 3]]),
        (5.0, 3, None, [[0, 0, 0], [2, 4, 6], [8, 10, 12]]),
        (5.0, 4, 2, [[0, 0, 0, 0], [0, 0, 0, 2], [0, 0, 2, 4], [0, 2, 4, 6]]),
    ],
)
def test_a_policy_of_several_observations_gets_those_of_the_actions_before(
    walk, rate, n_obs_steps, replan_every, steps
):
    actor = LooksBack([[0.01]] * 6, action_rate_hz=rate, n_obs_steps=n_obs_steps)
    places = []
    episode(
        walk.Walk(), actor, max_steps=13, replan_every=replan_every,
        on_step=lambda world, step: places.append(np.float32(world.state[0])),
    )  # fmt: skip
    assert len(set(places)) == 14
    assert actor.shown[: len(steps)] == [[places[step] for step in each] for each in steps]


def test_a_history_between_two_steps_is_refused(walk):
    actor = LooksBack([[0.0]], action_rate_hz=4.0, n_obs_steps=2)
    with pytest.raises(ConfigError, match=r"2 observations \(n_obs_steps\) 1/4 s apart"):
        episode(walk.Walk(), actor)


def test_the_policy_sees_what_it_asks_for_and_has_a_seed_of_its_own(walk):
    says = Says([[0.0]])
    episode(walk.Walk(), says, cameras=(Camera("eye", 8, 9),), policy_seed=100, max_steps=1)
    assert says.seed == 105
    assert says.seen["images"]["eye"].shape == (8, 9, 3)
    assert says.seen["task_description"] == "go right"


def test_another_instruction_ends_the_episode_and_is_no_success(walk):
    found = episode(walk.Walk(), walk.Walker(), instructed="left")
    assert found["instruction"] == "go left"
    assert found["behaviours"] == {"right": False, "left": True}
    assert found["success"] is False
    assert found["steps"] < 40


def test_actions_beyond_the_limits_are_counted(walk):
    assert episode(walk.Walk(), Says([[3.0]]), max_steps=1)["clamped"] == 1
    assert episode(walk.Walk(), Says([[2.0]]), max_steps=1)["clamped"] == 0


def test_joint_targets_are_joined_and_kept_within_the_limits(walk):
    places = []
    world = walk.Walk(limited=True)
    says = Says([[0.9], [0.9]], action_rate_hz=5.0)
    found = episode(
        world, says, replan_every=1, max_steps=8, on_step=lambda w, n: places.append(w.place)
    )
    assert found["calls"] == 4, "an action lasts two control steps"
    assert found["clamped"] > 0
    moves = np.abs(np.diff(places))
    assert moves.max() < 3.0 * 0.1 + 0.2, "3 m/s at 10 steps a second, and the ground's shaking"


@pytest.mark.parametrize(
    ("chunk", "text"),
    [
        ([0.1], r"chunk has shape \(1,\); \(T, 1\) is needed"),
        (np.zeros((0, 1)), r"chunk has shape \(0, 1\)"),
        ([[1.0, 2.0]], r"chunk has shape \(1, 2\)"),
        ([[1.0], [1.0, 2.0]], "chunk is not an array of numbers: "),
    ],
)
def test_chunks_of_another_shape_are_refused(walk, chunk, text):
    with pytest.raises(SpecMismatch, match=text):
        episode(walk.Walk(), Says(chunk))


@pytest.mark.parametrize("limited", [False, True])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_chunk_that_is_not_finite_is_a_failure_that_says_why(walk, value, limited):
    found = episode(walk.Walk(limited=limited), Says([[0.1], [value]]))
    assert (found["success"], found["steps"], found["calls"]) == (False, 0, 1)
    assert found["problem"] == f"the policy's chunk is not finite: action 1, x is {value}"
    assert episode(walk.Walk(), Says([[0.1]]))["problem"] is None


def test_a_success_does_not_outlive_a_chunk_that_is_not_finite(walk):
    world = walk.Walk()
    real = world.step
    # A success that does not end the episode, as some environments have it.
    world.step = lambda action: replace(real(action), success=True, ended=False)
    found = episode(world, walk.Dazed())
    assert (found["success"], found["steps"], found["calls"]) == (False, 3, 2)


def test_a_state_that_is_not_finite_is_not_the_policys_fault(walk):
    class Lost(walk.Walk):
        state = property(lambda self: np.array([np.nan]))

    # What a policy makes of such a state would look like its own failure.
    echo = walk.Walker()
    echo.predict_action = lambda observation: observation["qpos"][:, None] + 0.1
    for world, steps in ((Lost(limited=True), 0), (walk.Walk(diverging=6), 3)):
        with pytest.raises(RunFailed, match=f"state is not finite after {steps} steps") as caught:
            episode(world, echo)
        assert "likely cause: the simulation diverged" in str(caught.value)


@pytest.mark.parametrize("instructed", [None, "left"])
def test_the_last_steps_state_is_looked_at_too(walk, instructed):
    """Nobody observes after it: such an episode was a failure, or a success that was not."""
    with pytest.raises(Diverged, match="state is not finite after 3 steps"):
        episode(walk.Walk(diverging=6), walk.Walker(), max_steps=3, instructed=instructed)


def test_equal_seeds_give_equal_courses(walk):
    one, two = (episode(walk.Walk(), walk.Walker()) for _ in range(2))
    assert one["state_hash"] == two["state_hash"]
    assert set(one["timing"]) == {
        "seconds", "policy_seconds", "step_seconds", "observe_seconds",
    }  # fmt: skip


def test_a_policy_that_does_not_fit_is_refused(walk):
    spec = walk.Walk().spec
    assert match_policy(Says(None), spec) == ()
    assert match_policy(Says(None, cameras=("eye",)), spec) == (walk.EYE,)
    assert match_policy(Says(None, cameras=("eye",)), spec, (5, 6)) == (Camera("eye", 5, 6),)
    with pytest.raises(SpecMismatch, match="the policy looks at ear; a line has eye"):
        match_policy(Says(None, cameras=("ear",)), spec)
    with pytest.raises(SpecMismatch, match=r"for steps of 1/20 s, a line's for 1/10 s"):
        match_policy(Says(None, action_rate_hz=20.0), spec)
    assert match_policy(Says(None, action_rate_hz=20.0), walk.Walk(limited=True).spec) == ()
    with pytest.raises(SpecMismatch, match="frame: joint / world"):
        match_policy(Says(None, embodiment=replace(spec.embodiment, frame="joint")), spec)


def test_names_of_policies(walk):
    assert resolve_policy("checkpoint", walk.Walk()) == "checkpoint"
    assert resolve_policy("expert", walk.Walk()) == {"type": "Walker"}
    assert resolve_policy("random", walk.Walk()) == {"type": "RandomPolicy"}
    assert resolve_policy({"type": "X"}, walk.Walk()) == {"type": "X"}
    with pytest.raises(ConfigError, match="object names no expert"):
        resolve_policy("expert", object())


def test_random_actions_follow_from_the_seed(walk):
    policy = RandomPolicy(horizon=2)
    policy.enter(walk.Walk())
    drawn = []
    for seed in (1, 1, 2):
        policy.reset(seed)
        drawn.append(policy.predict_action(None))
    assert drawn[0].shape == (2, 1)
    assert (np.abs(drawn[0]) <= 2).all()
    assert np.array_equal(drawn[0], drawn[1])
    assert not np.array_equal(drawn[0], drawn[2])
    with pytest.raises(ConfigError, match="horizon must be at least 1, got 0"):
        RandomPolicy(0)


def test_a_wrong_instruction_is_the_next_task_of_those_evaluated(walk):
    class World:
        spec = walk.Walk().spec

        def other_tasks(self, task):
            return ["left"] if task == "right" else []

    assert swapped_task(World(), "right", ["right"]) == "left"
    assert swapped_task(walk.Walk(), "left", ["left", "right"]) == "right"
    with pytest.raises(ConfigError, match="no other task of a line can be done in the scene of 'l"):
        swapped_task(World(), "left", [])


@pytest.mark.skipif(not os.path.exists("/proc/self/status"), reason="Linux tells it there")
def test_a_processs_memory_is_its_own_and_not_its_parents():
    code = "from fluxvla_core.evaluation.rollout import memory_mb; print(memory_mb())"
    ballast = np.ones(64_000_000)
    found = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout
    assert 5 < float(found) < memory_mb() - 100
    assert ballast.nbytes == 512_000_000
