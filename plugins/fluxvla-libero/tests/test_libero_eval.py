"""Evaluation, inference and collection in LIBERO: outcomes that follow from trials alone."""

from __future__ import annotations

import argparse
import json
from dataclasses import replace

import av
import numpy as np
import pyarrow.parquet as pq
import pytest
from fluxvla_libero.collect import Collection, pairs
from fluxvla_libero.collect_command import CollectLiberoCommand
from fluxvla_libero.demonstrations import demonstrate
from fluxvla_libero.embodiment import libero_spec
from fluxvla_libero.eval_runner import LiberoEvalRunner
from fluxvla_libero.expert import Expert, ExpertPolicy
from fluxvla_libero.inference_runner import LiberoInferenceRunner
from fluxvla_libero.rollout import Episode, rollout
from fluxvla_libero.suites import init_states, suite_tasks

from fluxvla_core.build import RunContext
from fluxvla_core.data.parquet_dataset import ParquetDataset
from fluxvla_core.errors import ConfigError, SpecMismatch, UsageError

SALAD = "pick_up_the_salad_dressing_and_place_it_in_the_basket"


def runner(work_dir, listener, **arguments):
    context = RunContext(work_dir=work_dir, section="eval", reporter=listener)
    settings = {"policy": "expert", "tasks": [2], "num_trials_per_task": 2, **arguments}
    made = LiberoEvalRunner(context=context, **settings)
    made.run_setup()
    return made


def outcomes(work_dir):
    lines = (work_dir / "eval" / "episodes.jsonl").read_text().splitlines()[1:]
    records = [json.loads(line) for line in lines]
    for record in records:
        del record["timing"]
    return sorted(records, key=lambda r: (r["group"], r["task"], r["seed"]))


class Replay:
    """A recorded action sequence as a policy."""

    cameras, action_rate_hz = (), 20.0

    def __init__(self, actions):
        self.actions, self.horizon = actions, len(actions)
        self.embodiment = libero_spec(())

    def reset(self, seed):
        self.seed = seed

    def predict_action(self, observation):
        self.observation = observation
        return self.actions


def test_recorded_actions_replayed_give_the_recorded_success(scene):
    task, state = scene.task, init_states("libero_object", 2)[0]
    actions = []

    def watch(action):
        if action is not None:
            actions.append(action)

    episode = Episode(state, 7, task, (), 1000, 280)
    recorded = rollout(scene, ExpertPolicy(), episode, watch)
    replay = Replay(np.array(actions))
    replayed = rollout(scene, replay, episode)
    assert recorded.success
    assert recorded.behaviours == {task.name: True}
    assert (replayed.success, replayed.steps) == (True, recorded.steps)
    assert replayed.state_hash == recorded.state_hash
    assert replayed.calls == 1
    assert replay.seed == 7
    assert replay.observation["task_description"] == task.language
    # The other way round the gripper is never closed on anything.
    flipped = np.array(actions) * [1, 1, 1, 1, 1, 1, -1]
    episode = replace(episode, max_steps=len(actions))
    assert not rollout(scene, Replay(flipped), episode).success


def test_an_episode_ends_at_the_step_limit_and_counts_what_libero_cuts(scene):
    episode = Episode(init_states("libero_object", 2)[0], 7, scene.task, (), 3, 8)
    found = rollout(scene, Replay(np.full((5, 7), 1.5)), episode)
    assert (found.success, found.steps, found.calls, found.clamped) == (False, 8, 3, 8)


def test_the_expert_refuses_what_it_cannot_do(scene):
    goal = suite_tasks("libero_goal")[0]
    with pytest.raises(ConfigError, match="the scripted expert cannot do"):
        Expert(scene, goal)
    policy = ExpertPolicy()
    policy.enter(scene)
    policy.reset(0)
    with pytest.raises(ConfigError, match="the expert does not know 'juggle'"):
        policy.predict_action({"task_description": "juggle"})


def test_results_are_the_same_for_any_number_of_workers(tmp_path, libero, listener, save):
    settings = {"policy": "checkpoint", "baseline": True, "max_steps": 6, "eval_chunk_size": 3}
    for workers in (1, 2):
        path = save(tmp_path / str(workers))
        run = runner(
            tmp_path / str(workers), listener, workers=workers, record_videos=0, **settings
        )
        found = run.run()
        assert found["checkpoint"]["path"] == str(path)
    assert outcomes(tmp_path / "1") == outcomes(tmp_path / "2")
    trained, _, untrained, _ = outcomes(tmp_path / "1")
    assert (trained["calls"], trained["steps"]) == (2, 6)
    assert trained["state_hash"] != untrained["state_hash"], "the weights matter"


def test_the_expert_does_what_it_is_told_and_everything_is_written_down(tmp_path, libero, listener):
    settings = {"instruction_swap": True, "num_trials_per_task": 1, "workers": 1}
    found = runner(tmp_path, listener, record_videos=1, video_fps=1, **settings).run()
    assert found == json.loads((tmp_path / "eval" / "results.json").read_text())
    assert found["groups"]["policy"]["tasks"][SALAD]["successes"] == 1
    # Told to take the ketchup, the expert does that, and not the scene's own task.
    assert found["groups"]["swapped"]["all"]["rate"] == 0.0
    ketchup = suite_tasks("libero_object")[4]
    row = found["behaviours"]["swapped"][ketchup.language]
    assert row == {"episodes": 1, "neither": 0, ketchup.name: 1}
    assert found["instruction_test"]["only_a"] == 1
    assert found["settings"]["render"] == "cheap"
    assert found["settings"]["max_steps"] == 280
    assert any(line.startswith("right instruction against wrong one") for line in listener.lines)
    assert not any("went another way" in line for line in listener.lines)
    (video,) = found["videos"]
    with av.open(str(tmp_path / "eval" / video["path"])) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert frames[0].shape == (256, 512, 3)
    assert len(frames) > 5
    kept = (tmp_path / "eval" / "episodes.jsonl").read_text()
    again = runner(tmp_path, listener, record_videos=0, **settings).run()
    assert again["groups"] == found["groups"]
    assert again["timing"]["episodes"] == 0, "a finished evaluation is not run again"
    assert (tmp_path / "eval" / "episodes.jsonl").read_text() == kept


def test_a_checkpoint_that_does_not_fit_ends_the_evaluation(tmp_path, libero, listener, save):
    save(tmp_path, rate=10.0)
    with pytest.raises(SpecMismatch, match="deltas are for steps of 1/10 s"):
        runner(tmp_path, listener, policy="checkpoint").run()
    assert outcomes(tmp_path) == [], "no episode counts"


def infer(work_dir, listener, task, **arguments):
    context = RunContext(work_dir=work_dir, section="inference", task=task, reporter=listener)
    settings = {"policy": "expert", "record_fps": 2, "video_size": 64, **arguments}
    made = LiberoInferenceRunner(context=context, **settings)
    made.run_setup()
    return made.run()


def test_inference_shows_one_task_and_reports_success(tmp_path, libero, listener):
    (summary,) = infer(tmp_path, listener, "2", init_state=1)
    assert summary["success"] is True
    assert summary["instruction"] == "pick up the salad dressing and place it in the basket"
    folder = tmp_path / "inference" / "001-2"
    on_disk = json.loads((folder / "episode.json").read_text())
    assert on_disk["state_hash"] == summary["state_hash"]
    assert sorted(p.name for p in folder.glob("*.mp4")) == [
        "agentview.mp4",
        "robot0_eye_in_hand.mp4",
    ]
    lines = [json.loads(line) for line in (folder / "trace.jsonl").read_text().splitlines()]
    assert len(lines) == summary["steps"]
    assert len(lines[0]["command"]) == 7
    assert f"success after {summary['steps']} steps" in listener.lines


def test_inference_takes_free_words_only_in_a_named_scene(tmp_path, libero, listener, save):
    save(tmp_path)
    limited = {"policy": "checkpoint", "max_steps": 2, "eval_chunk_size": 1}
    with pytest.raises(UsageError, match=r"no instruction of libero_object: in which scene\?"):
        infer(tmp_path, listener, "wave at me", **limited)
    (summary,) = infer(tmp_path, listener, "wave at me", scene=2, **limited)
    assert (summary["success"], summary["outcome"], summary["steps"]) == (None, "ended", 2)
    assert "nobody can judge it after 2 steps" in listener.lines
    with pytest.raises(UsageError, match="cannot be done in the scene of"):
        infer(tmp_path, listener, "6", scene=2, **limited)


def test_what_is_asked_for_in_which_scene(libero):
    one = Collection(2, tasks=(2, 6))
    assert [(s.index, t.index) for s, t in pairs(one)] == [(2, 2), (6, 6)]
    mixed = Collection(2, tasks=(2, 4, 6), mixed=True)
    found = [(s.index, t.index) for s, t in pairs(mixed)]
    assert found == [(2, 2), (2, 4), (4, 2), (4, 4), (6, 4), (6, 6)]


def test_noise_and_placement_of_a_demonstration_follow_from_its_seed(scene):
    ketchup = suite_tasks("libero_object")[4]
    one, two = (demonstrate(scene, ketchup, 3, (), 0.3) for _ in range(2))
    np.testing.assert_array_equal(one.states, two.states)
    np.testing.assert_array_equal(one.actions, two.actions)
    assert one.seed == 3


def test_the_command_collects_a_dataset_to_train_on(tmp_path, libero, capsys):
    parser = argparse.ArgumentParser()
    command = CollectLiberoCommand()
    command.add_arguments(parser)
    with pytest.raises(UsageError, match="--workers must be at least 1, got 0"):
        command.run(parser.parse_args(["--out", str(tmp_path / "x"), "--workers", "0"]))
    words = ["--out", str(tmp_path / "x"), "--episodes", "1", "--tasks", "2", "--workers", "1"]
    words += ["--cameras", "agentview", "--height", "16", "--width", "16", "--log-format", "json"]
    assert command.run(parser.parse_args(words)) == 0
    assert "1 episodes, " in capsys.readouterr().out
    dataset = ParquetDataset(str(tmp_path / "x"), [], ["agentview"], action_window_size=4)
    assert len(dataset) > 50
    assert dataset.fps == 20
    assert dataset.embodiment.action_mode == "delta"
    assert dataset.embodiment.joints == libero_spec().joints
    assert dataset.tasks == ("pick up the salad dressing and place it in the basket",)
    table = pq.read_table(tmp_path / "x" / "data/chunk-000/file-000.parquet").to_pydict()
    actions = np.array(table["action"])
    assert np.abs(actions).max() <= 1.0
    assert set(actions[:, 6]) == {-1.0, 1.0}
