"""Live episodes: the world goes on while the policy thinks, and a robot's safety is in the way."""

from __future__ import annotations

import json
import sys
import time

import numpy as np
import pytest

from fluxvla_core.build import RunContext
from fluxvla_core.errors import ConfigError, Rejected, RunFailed
from fluxvla_core.evaluation.live import EnvironmentOperator, live_options
from fluxvla_core.evaluation.runner import EvalRunner

LINE = {"type": "Walk", "limited": True, "max_steps": 30}


def evaluate(work_dir, environment=LINE, **options):
    options = {"policy": "expert", "episodes": 1, "tasks": ["right"], "record_videos": 0, **options}
    runner = EvalRunner(
        context=RunContext(work_dir=work_dir, section="eval", **options.pop("context", {})),
        environment=environment,
        live=options.pop("live", True),
        **options,
    )
    runner.run_setup()
    return runner.run()


def record(work_dir):
    lines = (work_dir / "eval_live" / "episodes.jsonl").read_text().splitlines()
    return json.loads(lines[1])


@pytest.mark.realtime
def test_a_quick_policy_reaches_what_it_reaches_stepped(tmp_path, walking, listener):
    result = evaluate(tmp_path, context={"reporter": listener})
    assert result["mode"] == "live"
    assert result["groups"]["policy"]["all"]["successes"] == 1
    found = record(tmp_path)
    assert found["outcome"] == "done"
    assert found["ticks"] >= 3
    assert (tmp_path / "eval_live" / "episodes" / found["record"] / "episode.json").is_file()
    assert any("ticks without a target of the policy" in line for line in listener.lines)
    assert not (tmp_path / "eval").exists(), "stepped results are elsewhere"


@pytest.mark.realtime
def test_a_slow_policy_misses_ticks_and_fails_in_time_that_does_not_wait(tmp_path, walking):
    slow = {"type": "Thinker", "seconds": 1.0}
    result = evaluate(tmp_path, policy=slow, live={"safety": {"starvation_s": 60.0}})
    assert result["groups"]["policy"]["all"]["successes"] == 0
    assert result["live"]["missed_ticks"] >= 5
    assert result["live"]["stopped_by"] == {}
    found = record(tmp_path)
    assert (found["outcome"], found["ticks"]) == ("done", 30), "three seconds, and no more"


@pytest.mark.realtime
def test_the_robots_safety_stops_a_policy_that_starves_it(tmp_path, walking):
    slow = {"type": "Thinker", "seconds": 1.5}
    result = evaluate(tmp_path, policy=slow, live={"safety": {"starvation_s": 0.3}})
    assert result["live"]["stopped_by"] == {"starvation": 1}
    assert "waits for a chunk" in record(tmp_path)["problem"]
    assert result["groups"]["policy"]["all"]["errors"] == 0, "it is the policy that failed"


@pytest.mark.realtime
def test_a_simulation_that_diverges_is_no_failure_of_the_policy(tmp_path, walking):
    with pytest.raises(RunFailed, match="the environment's state is not finite after 3 steps"):
        evaluate(tmp_path, {**LINE, "diverging": 2**63})
    assert "the simulation diverged" in record(tmp_path)["error"]


@pytest.mark.realtime
def test_videos_are_those_that_were_taken_live(tmp_path, walking):
    pytest.importorskip("av")
    result = evaluate(tmp_path, policy={"type": "Walker"}, record_videos=1, max_steps=5)
    assert result["videos"] == [], "this policy looks at nothing"
    result = evaluate(
        tmp_path / "seen", policy={"type": "Thinker", "seconds": 0.0}, record_videos=1
    )
    (video,) = result["videos"]
    assert (tmp_path / "seen" / "eval_live" / video["path"]).stat().st_size


def test_what_cannot_be_live_is_refused(tmp_path, walking):
    with pytest.raises(
        ConfigError, match="live needs an environment that takes joint targets; a l"
    ):
        evaluate(tmp_path, {"type": "Walk"})
    with pytest.raises(ConfigError, match="instruction_swap cannot be live: evaluate it stepped"):
        evaluate(tmp_path, instruction_swap=True)
    with pytest.raises(ConfigError, match="live takes no speed; it takes action_chunk, "):
        evaluate(tmp_path, live={"speed": 3})
    with pytest.raises(ConfigError, match="live has chunk_joining 'rtc', and the policy cannot"):
        evaluate(tmp_path, live={"chunk_joining": "rtc"})
    assert live_options({}) == live_options(True) == {"chunk_joining": "latest_only"}
    assert live_options(False) is None


@pytest.fixture
def operator(walking):
    module = sys.modules["fluxvla_plugin_walking"]
    world = module.Walk(limited=True)
    made = EnvironmentOperator(world, module.Walker(), world.spec.tasks[0], 5, (), 8)
    made.begin_episode("go right", 0)
    return made


@pytest.mark.realtime
def test_the_last_command_holds_while_time_passes(operator):
    time.sleep(0.25)
    assert operator.ticks == 0, "time begins with the first command"
    operator.send_action(np.array([0.5]))
    deadline = time.monotonic() + 30
    while operator.ticks < 3 and time.monotonic() < deadline:
        time.sleep(0.02)
        assert operator.get_frame().state.shape == (1,)
    assert abs(operator.get_state()[0] - 0.5) < 0.2
    while not operator.task_done() and time.monotonic() < deadline:
        time.sleep(0.05)
    time.sleep(0.25)
    operator.get_state()
    assert operator.ticks == 8, "the world stands still once the episode is over"
    assert operator.task_success() is False


@pytest.mark.parametrize(
    ("action", "text"),
    [
        (np.zeros(2), r"takes actions of shape \(1,\), got \(2,\)"),
        (np.array([np.nan]), "x: the command is nan, not a finite number"),
        (np.array([2.5]), r"x: the command 2.5 m is outside \[-2, 2\]"),
    ],
)
def test_impossible_commands_are_rejected(operator, action, text):
    with pytest.raises(Rejected, match=text):
        operator.send_action(action)
