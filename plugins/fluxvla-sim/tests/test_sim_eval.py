"""The evaluation runner: outcomes that depend on seeds alone, what it writes, what it refuses."""

from __future__ import annotations

import json
from dataclasses import replace

import av
import numpy as np
import pytest
from fluxvla_aloha.embodiment import aloha_spec
from fluxvla_sim.aloha.arms import HOME
from fluxvla_sim.aloha.scene import AlohaScene
from fluxvla_sim.aloha.world import ALOHA, CUBE
from fluxvla_sim.eval_runner import AlohaSimEvalRunner, count_behaviours
from fluxvla_sim.eval_worker import policy_cameras
from fluxvla_sim.operators import AlohaSimOperator
from fluxvla_sim.policies import ExpertPolicy
from fluxvla_sim.rollout import rollout

from fluxvla_core.build import RunContext, build_runner_from_cfg
from fluxvla_core.contracts.reporter import SilentReporter
from fluxvla_core.errors import CheckpointError, ConfigError, RunFailed, SpecMismatch
from fluxvla_core.infer.base_runner import BaseInferenceRunner
from fluxvla_core.spec.embodiment import Camera

TASKS = {task.name: task for task in CUBE.tasks}


class Listener(SilentReporter):
    def __init__(self):
        self.lines, self.artifacts = [], []

    def info(self, text):
        self.lines.append(text)

    def warn(self, text):
        self.lines.append(f"warning: {text}")

    def artifact(self, kind, path):
        self.artifacts.append((kind, path.name))


def runner(work_dir, reporter=None, **arguments):
    context = RunContext(work_dir=work_dir, section="eval", reporter=reporter or Listener())
    made = AlohaSimEvalRunner(context=context, **{"policy": "expert", "episodes": 2, **arguments})
    made.run_setup()
    return made


def outcomes(work_dir):
    lines = (work_dir / "eval" / "episodes.jsonl").read_text().splitlines()[1:]
    records = [json.loads(line) for line in lines]
    for record in records:
        del record["timing"]
    return sorted(records, key=lambda r: (r["group"], r["seed"], r["task"]))


def test_outcomes_are_the_same_for_any_number_of_workers(tmp_path):
    for workers in (1, 3):
        runner(tmp_path / str(workers), workers=workers, record_videos=0).run()
    assert outcomes(tmp_path / "1") == outcomes(tmp_path / "3")
    assert [r["success"] for r in outcomes(tmp_path / "1")] == [True] * 4
    assert len({r["state_hash"] for r in outcomes(tmp_path / "1")}) == 4


def test_results_say_what_was_done_how_well_and_how_fast(tmp_path):
    listener = Listener()
    results = runner(tmp_path, listener, instruction_swap=True, record_videos=2).run()
    written = json.loads((tmp_path / "eval" / "results.json").read_text())
    assert written == {"format": "fluxvla-eval-1", "policy": "expert", **results}
    policy = results["groups"]["policy"]
    assert policy["tasks"]["lift_hold"]["successes"] == 2
    assert policy["all"]["rate"] == 1.0
    assert policy["all"]["low"] == pytest.approx(0.5101, abs=1e-4)
    assert results["groups"]["swapped"]["all"]["rate"] == 0.0
    said = TASKS["lift_hold"].instruction
    expected = {"episodes": 2, "neither": 0, "transfer_cube": 0, "lift_hold": 2}
    assert results["behaviours"]["swapped"][said] == expected
    assert results["timing"]["steps_per_s"] > 0
    assert results["timing"]["steps"] == sum(r["steps"] for r in outcomes(tmp_path))
    assert "policy lift_hold: 2/2 = 100% (95% interval 34% to 100%)" in listener.lines
    assert ("evaluation", "results.json") in listener.artifacts
    for video in results["videos"]:
        with av.open(str(tmp_path / "eval" / video["path"])) as container:
            frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
        assert frames[0].shape == (240, 320, 3)
        assert len(frames) == (94 if video["task"] == "transfer_cube" else 151)
        assert np.abs(frames[0].astype(int) - frames[-1].astype(int)).mean() > 1


def test_a_finished_evaluation_is_not_run_again(tmp_path):
    first = runner(tmp_path, record_videos=0).run()
    records = (tmp_path / "eval" / "episodes.jsonl").read_text()
    listener = Listener()
    again = runner(tmp_path, listener, record_videos=0).run()
    assert again["groups"] == first["groups"]
    assert again["timing"]["episodes"] == 0
    assert (tmp_path / "eval" / "episodes.jsonl").read_text() == records
    other = runner(tmp_path, listener, record_videos=0, replan_every=4).run()
    assert other["timing"]["episodes"] == 4, "other settings are another evaluation"
    assert any("was about another evaluation" in line for line in listener.lines)


def watched(scene):
    """The commands that ``scene`` will be stepped with."""
    commands, step = [], scene.step

    def watch(action):
        commands.append(np.array(action))
        step(action)

    scene.step = watch
    return commands


def test_an_inference_run_sends_the_commands_that_were_evaluated(tmp_path):
    scene, task = AlohaScene(), TASKS["transfer_cube"]
    evaluated = watched(scene)
    found = rollout(
        ALOHA,
        CUBE,
        scene,
        ExpertPolicy(ALOHA, CUBE, scene),
        task,
        task.instruction,
        31,
        (),
        replan_every=5,
    )
    operator = AlohaSimOperator(camera_names=(), seed=31)
    operator.connect()
    sent = watched(operator._scene)
    inference = BaseInferenceRunner(
        context=RunContext(work_dir=tmp_path, section="inference", task=task.instruction),
        policy=ExpertPolicy(ALOHA, CUBE, operator._scene),
        operator=operator,
        execute_horizon=5,
        max_publish_step=300,
        record_fps=None,
    )
    inference.run_setup()
    inference.run()
    assert found.success
    assert operator.task_success()
    # Times are summed up in another order there; what is left is rounding.
    np.testing.assert_allclose(sent[: len(evaluated)], evaluated, atol=1e-9)


class Fixed:
    """A policy that always answers the same."""

    action_rate_hz, horizon, cameras = 10.0, 5, ()

    def __init__(self, chunk):
        self.chunk = chunk
        self.seeds = []

    def reset(self, seed):
        self.seeds.append(seed)

    def predict_action(self, observation):
        self.observation = observation
        return self.chunk


def test_a_policy_that_does_nothing_fails_both_tasks():
    scene, policy = AlohaScene(), Fixed(np.tile(HOME, (5, 1)))
    camera = Camera("top", 48, 64)
    found = rollout(ALOHA, CUBE, scene, policy, TASKS["lift_hold"], "say this", 9, [camera], 5)
    assert (found.success, found.steps, found.calls) == (False, 300, 12)
    assert found.behaviours == {"transfer_cube": False, "lift_hold": False}
    assert policy.seeds == [9]
    observation = policy.observation
    assert observation["task_description"] == "say this"
    assert (observation["qpos"].dtype, observation["qpos"].shape) == (np.float32, (14,))
    assert observation["images"]["top"].shape == (48, 64, 3)


def test_wild_commands_are_kept_within_the_limits():
    scene = AlohaScene()
    wild = np.tile(np.where(np.arange(14) % 2, 1e3, -1e3), (5, 1))
    found = rollout(ALOHA, CUBE, scene, Fixed(wild), TASKS["lift_hold"], "x", 9, (), 5, 300)
    assert found.clamped == 300
    joints = aloha_spec(()).joints
    assert (scene.data.ctrl[:6] >= [j.lower for j in joints[:6]]).all()
    assert (scene.data.ctrl[:6] <= [j.upper for j in joints[:6]]).all()


@pytest.mark.parametrize(
    ("chunk", "message"),
    [
        (np.zeros((5, 7)), r"chunk has shape \(5, 7\); \(T, 14\) is needed"),
        (np.zeros((0, 14)), r"chunk has shape \(0, 14\)"),
        (np.full((5, 14), np.nan), "chunk is not finite"),
    ],
)
def test_a_chunk_that_is_none_is_an_error_and_not_a_failure(chunk, message):
    with pytest.raises(RunFailed, match=message):
        rollout(ALOHA, CUBE, AlohaScene(), Fixed(chunk), TASKS["lift_hold"], "x", 9, (), 5)


def test_the_expert_refuses_words_that_it_does_not_know():
    scene = AlohaScene()
    expert = ExpertPolicy(ALOHA, CUBE, scene)
    with pytest.raises(ConfigError, match="does not know 'dance'"):
        rollout(ALOHA, CUBE, scene, expert, TASKS["lift_hold"], "dance", 9, (), 5)


def test_an_expert_at_a_rate_that_does_not_fit_is_refused():
    with pytest.raises(ConfigError, match="15 keyframes a second do not divide 50 steps"):
        ExpertPolicy(ALOHA, CUBE, AlohaScene(), action_rate_hz=15.0)


def test_a_policy_for_another_robot_is_refused(tmp_path):
    settings = runner(tmp_path)._settings
    policy = Fixed(None)
    policy.embodiment = aloha_spec([Camera("top", 48, 64)])
    policy.cameras = ("top",)
    assert policy_cameras(ALOHA, policy, settings) == (Camera("top", 48, 64),)
    assert policy_cameras(ALOHA, policy, replace(settings, height=10, width=20))[0].width == 20
    policy.cameras = ("cam_high",)
    with pytest.raises(SpecMismatch, match="cameras: cam_high missing"):
        policy_cameras(ALOHA, policy, settings)
    policy.embodiment = replace(policy.embodiment, joints=policy.embodiment.joints[::-1])
    with pytest.raises(SpecMismatch, match=r"the policy .* and the simulated ALOHA"):
        policy_cameras(ALOHA, policy, settings)


def test_without_a_checkpoint_the_message_says_what_to_do(tmp_path):
    with pytest.raises(CheckpointError, match="there is no whole checkpoint in") as caught:
        runner(tmp_path, policy="checkpoint")
    assert "train first" in str(caught.value)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"policy": "clever"}, "policy 'clever' is none of checkpoint, expert, untrained"),
        ({"tasks": ("juggle",)}, "there is no task 'juggle'"),
        ({"tasks": ("lift_hold", "lift_hold")}, "tasks must name each task once"),
        ({"episodes": 0}, "episodes must be at least 1, got 0"),
        ({"workers": 0}, "workers must be at least 1, got 0"),
        ({"replan_every": 0}, "replan_every must be at least 1, got 0"),
        ({"max_steps": 200}, "max_steps must be at least 300 for lift_hold; got 200"),
        ({"quality": "best"}, "quality 'best' is none of cheap, reference"),
        ({"video_camera": "head"}, "video_camera 'head' is none of top"),
    ],
)
def test_impossible_values_are_refused_where_they_are_set(tmp_path, arguments, message):
    origins = {f"eval.{name}": "exp.py:7" for name in arguments}
    context = RunContext(work_dir=tmp_path, section="eval", origins=origins)
    table = {"type": "AlohaSimEvalRunner", **arguments}
    with pytest.raises(ConfigError, match=message) as caught:
        build_runner_from_cfg(table, context)
    if "task" not in message:
        assert str(caught.value).startswith("exp.py:7: eval.")


def test_nproc_says_how_many_processes(tmp_path):
    context = RunContext(work_dir=tmp_path, nproc=5)
    assert AlohaSimEvalRunner(context=context, policy="expert", workers=2).workers == 5


def record(task, seed, success, group="policy", **more):
    return {
        "group": group,
        "task": task,
        "seed": seed,
        "status": "done",
        "success": success,
        **more,
    }


def test_behaviours_are_counted_by_what_was_said():
    def did(said, **behaviours):
        return record("a", 0, True, instruction=said, behaviours=behaviours)

    records = [
        did("x", a=True, b=False),
        did("x", a=False, b=True),
        did("x", a=False, b=False),
        did("y", a=False, b=True),
        {"group": "policy", "status": "error"},
    ]
    counted = count_behaviours(records)["policy"]
    assert counted["x"] == {"episodes": 3, "neither": 1, "a": 1, "b": 1}
    assert counted["y"] == {"episodes": 1, "neither": 0, "a": 0, "b": 1}
