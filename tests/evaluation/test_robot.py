"""Success of an inference section: simulated and real robots, stops, people, going on."""

from __future__ import annotations

import json

import numpy as np
import pytest

from fluxvla_core.build import RunContext, build_runner_from_cfg
from fluxvla_core.contracts.frame import Frame
from fluxvla_core.control.clock import SimulatedClock
from fluxvla_core.errors import ConfigError, RunFailed, SafetyStop, UsageError
from fluxvla_core.evaluation.robot import RobotEvalRunner
from fluxvla_core.operators import EpisodeTrace
from fluxvla_core.plugins.registry import OPERATORS, RUNNERS
from fluxvla_core.robot.runner import BaseInferenceRunner
from fluxvla_core.spec import EmbodimentSpec, Joint

SPEC = EmbodimentSpec("slider", (Joint("x", "m", -2.0, 2.0, 5.0, 200.0, "prismatic"),), (), 50.0)
TASKS = {"1": "go to the right", "2": "go to the left"}


class Slider:
    """One joint in simulated time. Even seeds begin within reach of the goal, odd ones too far."""

    api = "1.0"
    made: list[Slider]

    def __init__(self, seed: int = 0) -> None:
        self.embodiment, self.clock = SPEC, SimulatedClock()
        self.seed, self.x, self.sign = seed, 0.0, 1.0
        type(self).made.append(self)

    def connect(self):
        return

    def get_frame(self):
        return Frame(np.array([self.x]), {}, {"state": self.clock.now()})

    def send_action(self, action):
        self.x = float(action[0])
        self.clock.advance(0.02)

    def stop(self):
        return

    def close(self):
        return


class Simulated(Slider):
    """Begins episodes, judges them, and tells of its time."""

    def begin_episode(self, instruction, episode):
        self.sign = 1.0 if instruction.endswith("right") else -1.0
        self.x = -self.sign * 1.5 * ((self.seed + episode) % 2)

    def task_success(self):
        return self.sign * self.x > 0.3

    def task_done(self):
        return self.task_success()

    def episode_facts(self):
        return {"real_time_factor": 0.5, "real_time_kept": 0.9 + self.seed / 1000}


class Mover:
    """Goes 0.5 m in the direction that it is told."""

    embodiment, cameras, action_rate_hz, horizon = SPEC, (), 10.0, 5

    def __init__(self):
        self.seeds = []
        self.wild = ()

    def reset(self, seed):
        self.seeds.append(seed)

    def predict_action(self, observation):
        sign = 1.0 if observation["task_description"].endswith("right") else -1.0
        if self.seeds[-1] in self.wild:
            return np.full((5, 1), np.nan)
        return observation["qpos"] + sign * np.linspace(0.1, 0.5, 5)[:, None]


@pytest.fixture
def section(monkeypatch):
    RUNNERS.register_module("PlainRunner")(type("PlainRunner", (BaseInferenceRunner,), {}))
    for cls in (Slider, Simulated):
        monkeypatch.setattr(cls, "made", [], raising=False)
        OPERATORS.register_module(cls.__name__)(cls)
    yield {
        "type": "PlainRunner",
        "operator": {"type": "Simulated", "seed": 0},
        "policy": Mover(),
        "task_descriptions": TASKS,
        "max_publish_step": 25,
        "record_fps": None,
    }
    RUNNERS.unregister("PlainRunner")
    for cls in (Slider, Simulated):
        OPERATORS.unregister(cls.__name__)


@pytest.fixture
def evaluate(tmp_path, listener, section):
    def run(inference=None, **arguments):
        config = {"inference": section | (inference or {}), "eval": {}}
        context = RunContext(config, "eval", tmp_path, reporter=listener)
        table = {"type": "RobotEvalRunner", "episodes": 4, "seed": 10, **arguments}
        runner = build_runner_from_cfg(table, context)
        runner.run_setup()
        return runner.run()

    return run


def episodes(work_dir):
    lines = (work_dir / "eval_robot" / "episodes.jsonl").read_text().splitlines()[1:]
    return [json.loads(line) for line in lines]


def test_every_task_is_counted_over_its_seeds(evaluate, section, tmp_path, listener):
    found = evaluate(tasks={"right": "1", "left": "2"})
    assert json.loads((tmp_path / "eval_robot" / "results.json").read_text()) == found
    for task in ("right", "left"):
        assert found["groups"]["policy"]["tasks"][task]["successes"] == 2
    assert found["groups"]["policy"]["all"]["low"] == pytest.approx(0.2152, abs=1e-4)
    assert found["provenance"]["seeds"] == {"policy": [10, 13]}
    assert "fluxvla-core" in found["provenance"]["versions"]
    assert (tmp_path / "eval_robot" / "config.resolved.json").exists()
    records = episodes(tmp_path)
    assert [(r["task"], r["seed"]) for r in records[:3]] == [
        ("right", 10),
        ("left", 10),
        ("right", 11),
    ]
    # A scene's seed is the policy's; both begin anew in every episode.
    assert section["policy"].seeds == [10, 10, 11, 11, 12, 12, 13, 13]
    assert [r["success"] for r in records] == [True, True, False, False] * 2
    assert records[0]["folder"] == "inference/001-1"
    assert records[0]["instruction"] == "go to the right"
    assert records[0]["steps"] < records[2]["steps"] == 25
    assert (found["mode"], found["settings"]["operator.type"]) == ("robot", "Simulated")
    assert found["settings"]["least_real_time_kept"] == 0.91
    assert any("right: 2/4 = 50% (95% interval" in line for line in listener.lines)
    assert ("evaluation", "results.json") in listener.artifacts


def test_scenes_count_up_from_the_seed_where_the_operators_table_has_none(evaluate, tmp_path):
    evaluate({"operator": {"type": "Simulated"}})

    # As with a seed of its own: even ones begin within reach of the goal.
    assert [r["success"] for r in episodes(tmp_path)] == [True, True, False, False] * 2


def test_an_interrupted_evaluation_goes_on(evaluate, section, tmp_path, listener, monkeypatch):
    real, calls = Simulated.task_done, []

    def interrupted(self):
        calls.append(1)
        if len(calls) == 60:
            raise KeyboardInterrupt
        return real(self)

    monkeypatch.setattr(Simulated, "task_done", interrupted)
    with pytest.raises(KeyboardInterrupt):
        evaluate(tasks=["1"])
    done = len(episodes(tmp_path))
    assert 0 < done < 4
    found = evaluate(tasks=["1"])
    assert found["groups"]["policy"]["tasks"]["1"]["episodes"] == 4
    assert f"{done} of 4 episodes are there already; running the others" in listener.lines
    assert [r["seed"] for r in episodes(tmp_path)] == [10, 11, 12, 13]


def test_a_stop_ends_the_evaluation_unless_nobody_can_be_hurt(evaluate, section, tmp_path):
    section["policy"].wild = (11,)
    with pytest.raises(SafetyStop, match="not finite"):
        evaluate(tasks=["1"])
    last = episodes(tmp_path)[-1]
    assert (last["seed"], last["status"], last["success"]) == (11, "done", False)
    assert "not finite" in last["problem"]
    found = evaluate(tasks=["1"], go_on=True)
    assert found["groups"]["policy"]["tasks"]["1"]["episodes"] == 4
    assert found["groups"]["policy"]["tasks"]["1"]["errors"] == 0
    assert [(row["status"], row["episodes"]) for row in found["problems"]] == [("done", 1)]


def test_a_robot_that_fails_is_an_error_and_no_failure_of_the_policy(
    evaluate, tmp_path, monkeypatch, listener
):
    real = Simulated.send_action

    def breaks(self, action):
        if self.seed == 12:
            raise OSError("the cable is out")
        real(self, action)

    monkeypatch.setattr(Simulated, "send_action", breaks)
    with pytest.raises(RunFailed, match=r"1 of 4 episodes gave no result.*cable is out"):
        evaluate(tasks=["1"], go_on=True)
    found = json.loads((tmp_path / "eval_robot" / "results.json").read_text())
    assert [(row["status"], row["episodes"]) for row in found["problems"]] == [("error", 1)]
    counted = found["groups"]["policy"]["tasks"]["1"]
    assert (counted["episodes"], counted["successes"], counted["errors"]) == (3, 1, 1)
    assert any("1, episode 12: " in line and "cable" in line for line in listener.warnings)
    monkeypatch.setattr(Simulated, "send_action", real)
    again = evaluate(tasks=["1"], go_on=True)["groups"]["policy"]["tasks"]["1"]
    assert (again["episodes"], again["errors"]) == (4, 0), "an error is tried again"


REAL = {"operator": {"type": "Slider"}}


class TestRealRobot:
    def test_a_person_puts_things_in_place_and_judges(self, evaluate, tmp_path):
        asked, answers = [], iter(["", "perhaps", "Yes", "", "n"])

        def answer(question):
            asked.append(question)
            return next(answers)

        found = evaluate(REAL, tasks=["1"], episodes=2, answer=answer)
        assert asked[0] == "1, episode 10: put things in place, then press Enter: "
        assert asked[1] == asked[2] == "1, episode 10: was the task done? [y/n] "
        counted = found["groups"]["policy"]["tasks"]["1"]
        assert counted["episodes"] == 2
        assert [r["success"] for r in episodes(tmp_path)] == [True, False]

    def test_without_anybody_to_ask_nothing_moves(self, evaluate, monkeypatch):
        monkeypatch.setattr("sys.stdin", None)
        with pytest.raises(RunFailed, match="this robot cannot tell whether a task was done"):
            evaluate(REAL, tasks=["1"])
        assert all(slider.x == 0.0 for slider in Slider.made)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"section": "other"}, "section 'other' is not in the config"),
        ({"tasks": ["9"]}, "tasks '9' is not a task of inference; there are 1, 2"),
        ({"episodes": 0}, "episodes must be at least 1, got 0"),
    ],
)
def test_impossible_values_are_refused(section, arguments, message):
    context = RunContext({"inference": section}, "eval")
    with pytest.raises(ConfigError, match=message):
        RobotEvalRunner(context=context, **arguments)


def test_a_section_without_tasks_cannot_be_evaluated(section):
    context = RunContext({"inference": section | {"task_descriptions": {}}}, "eval")
    with pytest.raises(ConfigError, match="inference has no task_descriptions to evaluate"):
        RobotEvalRunner(context=context)


def test_what_the_section_refuses_is_refused_before_anything_moves(evaluate, section):
    with pytest.raises((ConfigError, UsageError), match="max_publish_step must be at least 1"):
        evaluate({"max_publish_step": 0})
    assert not any(slider.x for slider in Simulated.made)


def test_an_episode_whose_recording_fails_is_counted_all_the_same(
    evaluate, section, monkeypatch, listener
):
    real = EpisodeTrace.close

    def close(self, summary):
        real(self, summary)
        raise RunFailed("the episode could not be recorded completely: no space left")

    monkeypatch.setattr(EpisodeTrace, "close", close)
    section["policy"].wild = range(10, 14)
    found = evaluate(tasks=["1"], go_on=True)
    counted = found["groups"]["policy"]["all"]
    assert (counted["successes"], counted["episodes"], counted["errors"]) == (0, 4, 0)
    assert any("no space left" in line for line in listener.warnings)
