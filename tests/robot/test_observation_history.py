"""A policy that acts on several observations gets those of the actions before, on a robot too."""

from __future__ import annotations

import time
from collections import deque
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fluxvla_core.control.joiners import METHODS
from fluxvla_core.control.safety import BadTiming
from fluxvla_core.robot.observations import ObservationHistory
from fluxvla_core.robot.recording.recorded import open_recording

STRIDE = 5  # control steps of the arm, at 50 Hz, for an action of the policy, at 10 Hz


class Looking:
    """Waver's way, as a policy of three observations; notes when each was made, and waits."""

    n_obs_steps = 3

    def __init__(self, waver: Any, slow_s: float = 0.0) -> None:
        self.waver, self.slow_s = waver, slow_s
        self.embodiment, self.horizon = waver.embodiment, waver.horizon
        self.action_rate_hz = waver.action_rate_hz
        self.seen: list[list[int]] = []
        self.states: list[list[float]] = []
        self.names: set[str] = set()

    def reset(self, seed: int) -> None:
        self.seen.clear()

    def predict_action(self, observation: Any) -> np.ndarray:
        time.sleep(self.slow_s)
        shown = [*observation["history"], observation]
        self.seen.append([int(each["images"]["front"][0, 0, 0]) for each in shown])
        self.names |= {each["task_description"] for each in shown}
        assert not any("history" in each for each in observation["history"])
        return self.waver.predict_action(observation)


@pytest.fixture
def looking(bench):
    bench.policy = Looking(bench.policy)
    return bench.policy


def queued(asked: list[int]) -> list[list[int]]:
    """What a queue of three holds at control steps ``asked``, filled once an action."""
    queue: deque[int] = deque(maxlen=3)
    held = {}
    for step in range(0, asked[-1] + 1, STRIDE):
        while len(queue) < 2:
            queue.append(step)
        queue.append(step)
        held[step] = list(queue)
    return [held[step] for step in asked]


@pytest.mark.parametrize("method", [method for method in METHODS if method != "rtc"])
@pytest.mark.parametrize("horizon", [1, 2, 5])
def test_in_lockstep_it_is_a_queue_that_is_filled_at_every_action(bench, looking, method, horizon):
    bench.run(chunk_joining=method, execute_horizon=horizon, max_publish_step=60)

    asked = [steps[-1] for steps in looking.seen]
    assert len(asked) >= 60 / STRIDE / horizon - 1
    assert all(step % STRIDE == 0 for step in asked)
    assert looking.seen == queued(asked)
    assert looking.names == {"wave at the camera"}


def in_time(bench, seen: list[list[int]]) -> list[list[int]]:
    """Those whose commands were all sent in time, as recorded.

    What is seen is counted in commands. A machine that stands still sends none meanwhile, and
    nobody looks at the arm.
    """
    newest = max((bench.work_dir / "inference").iterdir()).name
    times = [row["t"] for row in bench.trace(newest) if row["event"] == "command"]
    late = np.diff(times) > 0.05
    return [steps for steps in seen if not late[max(steps[0] - 1, 0) : steps[-1] + 1].any()]


def observed_in_time(
    bench, make_arm, waver, slow_s: float = 0.0, **settings: Any
) -> list[list[int]]:
    """What a policy saw of an arm in real time, from its second question on.

    Tried again while too little of it is of a machine that ran.
    """
    for _ in range(3):
        bench.arm = make_arm(realtime=True)
        bench.policy = looking = Looking(waver, slow_s)
        bench.run(control_process=False, safety={"max_age_s": 5.0, "max_skew_s": 5.0}, **settings)
        assert len(looking.seen) >= 3
        assert looking.seen[0] == [0, 0, 0]
        found = in_time(bench, looking.seen[1:])
        if len(found) >= 2:
            return found
    pytest.fail("three times this machine stood still again and again")


@pytest.mark.realtime
@pytest.mark.parametrize("method", ["synchronous", "latest_only"])
@pytest.mark.realtime
def test_an_arm_in_real_time_is_looked_at_between_two_questions(bench, make_arm, method):
    found = observed_in_time(
        bench, make_arm, bench.policy, chunk_joining=method, execute_horizon=3, max_publish_step=60
    )

    for *before, last in found:
        for back, step in zip((2, 1), before, strict=True):
            # 0.6 of an action away at most, and one command for what the machine adds
            assert abs(step - max(last - back * STRIDE, 0)) <= 4


@pytest.mark.realtime
@pytest.mark.parametrize("thinks_s", [0.0, 0.15])
@pytest.mark.realtime
def test_what_it_saw_in_real_time_is_recorded_and_can_be_shown_again(bench, make_arm, thinks_s):
    pytest.importorskip("rosbags")
    bench.arm = make_arm(realtime=True)
    bench.policy = looking = Looking(bench.policy, thinks_s)
    root = str(bench.work_dir / "rec")
    settings = {"chunk_joining": "latest_only", "execute_horizon": 3, "control_process": False}
    bench.run(record=root, max_publish_step=60, **settings)

    found, seen = open_recording(root), {step for steps in looking.seen for step in steps}
    times = [event["t"] for event in found.of("observation")]
    assert len(set(times)) == len(times) > len(found.chunks())
    recorded = {
        int(found.images["front"].read(found.images["front"].newest(at))[0, 0, 0]) for at in times
    }
    assert seen <= recorded
    table = {"type": "ReplayOperator", "recording": f"{root}/001-1"}
    bench.run(operator=table, max_publish_step=1000, **{**settings, "control_process": None})
    assert bench.episode()["outcome"] == "done"
    assert {step for steps in looking.seen for step in steps} <= recorded


@pytest.mark.realtime
def test_a_policy_that_thinks_all_the_time_waits_for_what_it_needs(bench, make_arm):
    """Asked again as soon as it has answered, it has seen nothing of the time in between."""
    found = observed_in_time(
        bench, make_arm, bench.policy, 0.3, chunk_joining="latest_only", max_publish_step=100
    )

    for *before, last in found[1:]:
        assert [last - step for step in before] == pytest.approx([10, 5], abs=4)


@pytest.mark.realtime
def test_a_robot_that_cannot_be_read_that_often_is_refused(bench, make_arm):
    bench.arm = make_arm(realtime=True)
    bench.arm.faults |= {"get_frame": lambda: time.sleep(0.4), "after": 5}
    bench.policy = Looking(bench.policy)
    with pytest.raises(BadTiming, match=r"acts on 3 observations 0.1 s apart \(n_obs_steps\), and"):
        bench.run(max_publish_step=200, control_process=False)
    assert "stop" in bench.arm.calls


def reader_of(clock: Any, took: float = 0.0) -> Any:
    def read() -> Any:
        made = clock.time
        clock.time += took
        return SimpleNamespace(observation={"qpos": made})

    return read


@pytest.mark.parametrize("took", [0.0, 0.03])
def test_what_is_missing_is_waited_for(took):
    clock = SimpleNamespace(time=1.0)
    clock.now = lambda: clock.time
    robot: Any = SimpleNamespace(clock=clock, lockstep=False, reading=SimpleNamespace(name="eye"))
    policy: Any = SimpleNamespace(n_obs_steps=3, action_rate_hz=10.0)

    def sleep(seconds: float) -> None:
        clock.time += seconds

    read = reader_of(clock, took)
    told: list[Any] = []
    safety = SimpleNamespace(max_age_s=0.5)
    reader: Any = SimpleNamespace(
        read=read, sample=read, robot=robot, safety=safety, emit=told.append
    )
    history = ObservationHistory(reader, policy, sleep)

    def times(seen: Any) -> list[float]:
        return [each["qpos"] for each in (*seen["history"], seen)]

    assert times(history.read()[1]) == [1.0, 1.0, 1.0]
    clock.time = 5.0
    assert times(history.read()[1]) == pytest.approx([5.0, 5.1, 5.2])
    history.reset()
    assert not history.due()
    clock.time = 9.0
    assert times(history.read()[1]) == [9.0, 9.0, 9.0]
    clock.time = 9.1
    assert history.due()
    assert not history.due()
    history.sample()
    clock.time = 9.17
    assert not told, "questions are events by themselves"
    assert times(history.read()[1]) == pytest.approx([9.0, 9.1, 9.17])
    assert [event.observed.observation["qpos"] for event in told] == pytest.approx([9.1])
    assert [event.at for event in told] == pytest.approx([9.1 + took])
