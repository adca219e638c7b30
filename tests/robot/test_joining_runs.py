"""Every way of joining chunks, through the whole loop: in lockstep, on a robot, and against it."""

from __future__ import annotations

import itertools
import time

import numpy as np
import pytest

from fluxvla_core.control.joiners import METHODS, STREAMED
from fluxvla_core.robot.runner import BaseInferenceRunner


class Going:
    """Waver's way, as a policy that can go on from a chunk; notes what it was told."""

    def __init__(self, waver):
        self.waver = waver
        self.embodiment, self.horizon = waver.embodiment, waver.horizon
        self.action_rate_hz = waver.action_rate_hz
        self.told = []
        self.slow_s = 0.0

    def reset(self, seed):
        self.told.clear()

    def predict_action(self, observation):
        time.sleep(self.slow_s)
        self.told.append(None)
        return self.waver.predict_action(observation)

    def continue_action(self, observation, rest):
        chunk = self.predict_action(observation)
        self.told[-1] = rest
        chunk[: rest.frozen] = rest.actions[: rest.frozen]
        return chunk


@pytest.fixture
def going(bench):
    bench.policy = Going(bench.policy)
    return bench.policy


def chunk_times(bench):
    return [row["observed"] for row in bench.trace() if row["event"] == "chunk"]


@pytest.mark.parametrize("method", METHODS)
def test_every_method_brings_the_arm_there_in_lockstep(bench, going, method):
    bench.run(chunk_joining=method)

    assert bench.arm.state[0] == pytest.approx(0.8, abs=0.05)
    bench.assert_within_limits()


@pytest.mark.parametrize("method", STREAMED)
def test_in_lockstep_an_episode_can_be_repeated(bench, make_arm, going, method):
    bench.run(chunk_joining=method)
    first = bench.arm.sent
    bench.arm = make_arm()
    bench.run(chunk_joining=method)

    np.testing.assert_array_equal(first, bench.arm.sent)


@pytest.mark.parametrize(("horizon", "gap"), [(None, 0.1), (3, 0.3)])
def test_in_lockstep_observations_are_as_far_apart_as_the_horizon_says(bench, going, horizon, gap):
    bench.run(chunk_joining="latest_only", execute_horizon=horizon)

    gaps = np.diff(chunk_times(bench))
    np.testing.assert_allclose(gaps, gap, atol=1e-9)


def test_the_short_form_means_the_latest_only(bench):
    runner = bench.runner(async_execution=True)
    assert runner.chunk_joining == "latest_only"
    assert bench.runner().chunk_joining == "synchronous"
    kept = bench.runner(async_execution=True, chunk_joining={"method": "overlap", "fade_s": 0.1})
    assert kept.chunk_joining == {"method": "overlap", "fade_s": 0.1}


def test_a_method_that_is_not_there_is_named_with_its_place(bench):
    from fluxvla_core.build import RunContext
    from fluxvla_core.errors import ConfigError

    context = RunContext(section="inference", origins={"inference.chunk_joining": "arm.py:7"})
    with pytest.raises(ConfigError) as caught:
        BaseInferenceRunner(context=context, operator=bench.arm, chunk_joining="rct")
    assert str(caught.value).startswith(
        "arm.py:7: inference.chunk_joining: chunk_joining method 'rct'; did you mean 'rtc'?"
    )


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("latency", [0.03, 0.25])
def test_a_simulated_latency_is_between_observation_and_chunk(bench, going, method, latency):
    bench.run(chunk_joining=method, simulated_latency=latency, max_publish_step=150)

    chunks = [row for row in bench.trace() if row["event"] == "chunk"][1:]
    took = [row["t"] - row["observed"] for row in chunks]
    # It is there at the first tick after it.
    np.testing.assert_allclose(took, np.ceil(latency * 50 - 1e-6) / 50, atol=1e-6)
    assert bench.arm.state[0] == pytest.approx(0.8, abs=0.05)
    bench.assert_within_limits()


def test_frozen_actions_follow_the_simulated_latency(bench, make_waver):
    bench.policy = going = Going(make_waver(horizon=10))
    bench.run(chunk_joining="rtc", simulated_latency=0.25, max_publish_step=100)

    frozen = [rest.frozen for rest in going.told if rest is not None]
    # The first answer took no time; from the second on 0.26 s were measured: three actions.
    assert frozen[0] == 0
    assert set(frozen[1:]) == {3}


@pytest.mark.realtime
def test_in_real_time_the_policy_is_told_what_is_executed_meanwhile(bench, make_arm, going):
    bench.arm = make_arm(realtime=True)
    going.slow_s = 0.12

    bench.run(chunk_joining="rtc", max_publish_step=75)

    told = [rest for rest in going.told if rest is not None]
    assert going.told[0] is None, "nothing is under way at first"
    assert len(told) >= 3
    # 0.12 s and more are two actions of 10 Hz at least; and never more than there are.
    # Where the machine stood still, fewer than two may be left: those that count.
    assert all(min(2, (rest.weights > 0).sum()) <= rest.frozen <= 5 for rest in told)
    assert all((rest.weights[: rest.frozen] == 1).all() for rest in told)
    bench.assert_within_limits()


@pytest.mark.realtime
def test_a_robot_that_waits_for_its_policy_says_how_it_need_not(bench, make_arm, going):
    going.slow_s = 0.15
    waited = {}
    for method in ("synchronous", "overlap"):
        bench.arm, bench.notes.lines = make_arm(realtime=True), []
        bench.run(chunk_joining=method, max_publish_step=75)
        waited[method] = [line for line in bench.notes.lines if "waited for the policy" in line]

    (line,) = waited["synchronous"]
    assert "% of the control periods; chunk_joining = 'overlap'" in line
    assert waited["overlap"] == []


@pytest.mark.realtime
def test_the_target_has_no_seam_where_a_policy_keeps_to_what_is_frozen(bench, make_arm, going):
    """The same slow policy, with and without real-time chunking, on an arm that lags behind."""
    going.slow_s = 0.15
    going.waver.stride = 0.05
    going.waver.goal = 1.4
    seams = {}
    for method in ("latest_only", "rtc"):
        bench.arm = make_arm(realtime=True)
        lagging(bench.arm)
        bench.run(chunk_joining=method, max_publish_step=75)
        name = sorted(path.name for path in (bench.work_dir / "inference").iterdir())[-1]
        wanted = [
            (row["t"], row["wanted"][0])
            for row in bench.trace(name)
            if row["event"] == "command" and row["phase"] == "run"
        ]
        # By the time between two commands: a tick that is missed is no seam.
        jumps = [
            abs(after - before) / max((later - at) * 50.0, 1.0)
            for (at, before), (later, after) in itertools.pairwise(wanted)
        ]
        seams[method] = sum(jump > 0.03 for jump in jumps)
    # 0.05 rad an action are 0.01 rad a command, and each chunk starts 0.1 rad behind. With
    # real-time chunking there is a seam only where the machine stood still for a chunk's rest.
    assert seams["latest_only"] >= 3
    assert seams["rtc"] < seams["latest_only"] / 2


def lagging(arm):
    """The state that is read is 0.1 rad behind: each chunk of a plain policy starts back there."""
    follow = arm.get_frame

    def behind():
        frame = follow()
        frame.state[0] -= 0.1
        return frame

    arm.get_frame = behind


@pytest.mark.parametrize("method", STREAMED)
def test_no_method_lets_an_adversary_out_of_the_limits(bench, make_arm, method):
    from tests.robot.test_adversarial import Adversary

    bench.policy = Adversary(bench.arm.embodiment, 5)
    bench.policy.continue_action = lambda observation, rest: bench.policy.predict_action(
        observation
    )
    bench.run(
        max_publish_step=400,
        safety={"jump_s": 1e12, "excess": 1e12, "tracking_error": 100},
        chunk_joining=method,
    )

    assert bench.policy.chunks >= 70
    bench.assert_within_limits()
