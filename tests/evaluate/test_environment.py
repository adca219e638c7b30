"""Environments behind the contract: outcomes by seed, Gymnasium's interface, impossible chunks."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from fluxvla_core.contracts.reporter import SilentReporter
from fluxvla_core.errors import RunFailed
from fluxvla_core.evaluate.environment import EnvironmentEpisodes, GymnasiumEnvironment
from fluxvla_core.evaluate.episodes import run_episodes
from fluxvla_core.evaluate.ledger import EpisodeKey, Ledger
from tests.evaluate.environments import Forward, Walk, make_environment


def run(tmp_path, workers, speed=0.2, max_steps=30):
    keys = [EpisodeKey("policy", "walk", seed) for seed in range(4)]
    episodes = EnvironmentEpisodes(make_environment, partial(Forward, speed), max_steps, 2)
    ledger = Ledger(tmp_path / f"{workers}.jsonl", {})
    return run_episodes(episodes, keys, ledger, workers, SilentReporter())


@pytest.mark.parametrize("workers", [1, 3])
def test_outcomes_follow_from_seeds_alone(tmp_path, workers):
    records = run(tmp_path, workers)
    assert records == run(tmp_path / "again", 2)
    assert [record["success"] for record in records] == [True] * 4
    assert len({record["state_hash"] for record in records}) == 4
    assert all(record["calls"] == -(-record["steps"] // 2) for record in records)


def episode(policy, max_steps=30, replan_every=1, **environment):
    made = GymnasiumEnvironment(Walk, **environment)
    episodes = EnvironmentEpisodes(lambda: made, lambda: policy, max_steps, replan_every)
    return episodes()(EpisodeKey("policy", "walk", 5)), made


def test_an_episode_ends_with_success_with_the_environment_or_with_the_steps():
    assert episode(Forward(0.5))[0]["success"] is True
    fell = episode(Forward(-0.5))[0]
    assert (fell["success"], fell["steps"] < 5) == (False, True)
    stood = episode(Forward(0.0), max_steps=7)[0]
    assert (stood["success"], stood["steps"], stood["calls"]) == (False, 7, 7)
    assert episode(Forward(0.0), max_steps=100)[0]["steps"] == 40, "truncated by Gymnasium"


def test_the_policy_is_told_seed_and_place():
    policy = Forward()
    _, made = episode(policy)
    assert policy.seeds == [5]
    assert policy.place is made
    assert made.env.action_space.seeded == 5


def test_observations_are_rows_and_pictures():
    made = GymnasiumEnvironment(partial(Walk, pictures=True), instructions={"walk": "go on"})
    seen = made.reset(0, "walk")
    np.testing.assert_array_equal(seen["qpos"], np.array([0, 1, 2], np.float32))
    assert list(seen["images"]) == ["eye"]
    assert seen["task_description"] == "go on"
    assert made.reset(0, "run")["task_description"] == "run"
    made.close()
    assert made.env.closed == 1


def test_success_is_read_from_either_name_or_a_function():
    assert episode(Forward(0.5), success=lambda o, r, t, i: r > 0.4)[0]["steps"] == 1
    other = GymnasiumEnvironment(partial(Walk, "success"))
    other.reset(0, "walk")
    assert other.step(np.array([2.0])).success is True


def test_an_environment_that_does_not_say_is_refused():
    made = GymnasiumEnvironment(partial(Walk, "score"))
    made.reset(0, "walk")
    with pytest.raises(RunFailed, match=r"does not say whether its task is done.*\['score'\]"):
        made.step(np.array([0.1]))


@pytest.mark.parametrize(
    ("chunk", "message"),
    [
        (np.zeros(3), r"shape \(3,\); \(T, D\) is needed"),
        (np.zeros((0, 1)), r"shape \(0, 1\)"),
        (np.full((1, 1), np.inf), "not finite"),
    ],
)
def test_impossible_chunks_end_the_episode(chunk, message):
    policy = Forward()
    policy.predict_action = lambda observation: chunk
    with pytest.raises(RunFailed, match=message):
        episode(policy)


@pytest.mark.parametrize(("steps", "every"), [(0, 1), (1, 0)])
def test_impossible_numbers_are_refused(steps, every):
    with pytest.raises(ValueError, match="must be at least 1"):
        EnvironmentEpisodes(make_environment, Forward, steps, every)
