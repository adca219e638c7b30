"""Real Gymnasium environments behind the contract, and what is said where they do not fit."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib.util import find_spec

import gymnasium
import numpy as np
import pytest
from fluxvla_gymnasium.environment import GymnasiumEnvironment, SuccessCriterion
from fluxvla_gymnasium.parts import images_of, parts, state_row
from fluxvla_mujoco import divergence

from fluxvla_core import build_environment_from_cfg, build_runner_from_cfg
from fluxvla_core.errors import ConfigError, MissingPlugin, RunFailed, SpecMismatch
from fluxvla_core.evaluation import RolloutSettings, run_episode
from fluxvla_core.evaluation.results_file import summarise
from fluxvla_core.operators import RunContext
from fluxvla_core.testing import EnvironmentConformance

needs_mujoco = pytest.mark.skipif(find_spec("mujoco") is None, reason="mujoco is not installed")
needs_aloha = pytest.mark.skipif(
    find_spec("gym_aloha") is None or find_spec("dm_control") is None,
    reason="gym-aloha is not installed, or not with its simulator",
)


def joint(name, low=-1.0, high=1.0):
    limits = {"lower": low, "upper": high, "velocity": 100.0, "acceleration": 1000.0}
    return {"name": name, "unit": "normalized", "kind": "revolute", **limits}


def body(dim, state_dim, cameras=(), rate=50.0):
    return {
        "name": "body",
        "rate_hz": rate,
        "joints": [joint(f"a{i}") for i in range(dim)],
        "state_joints": [joint(f"s{i}") for i in range(state_dim)],
        "cameras": [{"name": n, "height": h, "width": w} for n, h, w in cameras],
        "action_mode": "delta",
    }


def reacher(**arguments):
    """Two joints, ten numbers, drawn by MuJoCo; its reward is the negative distance."""
    return {
        "type": "GymnasiumEnvironment",
        "id": "Reacher-v5",
        "embodiment": body(2, 10, [("front", 64, 80)]),
        "cameras": {"front": "render"},
        "make": {"width": 80, "height": 64},
        "success_reward": -0.02,
        "instruction": "reach the ball",
        "max_steps": 20,
        **arguments,
    }


@needs_mujoco
class TestGymnasiumEnvironment(EnvironmentConformance):
    entry_point = "GymnasiumEnvironment"
    arguments = {key: value for key, value in reacher().items() if key != "type"}  # noqa: RUF012
    image_size = None


@needs_mujoco
def test_a_real_environment_with_images():
    made = build_environment_from_cfg(reacher())
    assert (made.spec.name, made.spec.details["render"]) == ("Reacher-v5", "cheap")
    (task,) = made.spec.tasks
    assert (task.name, task.instruction, task.max_steps) == ("Reacher-v5", "reach the ball", 20)
    made.reset(3, task.name)
    seen = made.observe(made.spec.embodiment.cameras)
    assert seen["images"]["front"].shape == (64, 80, 3)
    assert seen["images"]["front"].std() > 5, "something is seen"
    assert (seen["qpos"].shape, seen["qpos"].dtype) == ((10,), np.float32)
    np.testing.assert_array_equal(seen["qpos"], made.state.astype(np.float32))
    assert made._env.unwrapped.model.vis.quality.shadowsize == 0
    found = made.step(np.array([0.1, -0.1]))
    assert found.reward < 0
    assert not found.ended
    made.close()
    made.close()


@needs_mujoco
def test_an_episode_follows_from_its_seed():
    made = build_environment_from_cfg(reacher())

    def states(seed):
        made.reset(seed, "Reacher-v5")
        return np.stack([made.step(np.array([0.2, 0.1])) and made.state for _ in range(5)])

    first = states(1)
    assert not np.array_equal(states(2), first)
    np.testing.assert_array_equal(states(1), first)
    made.close()


@needs_mujoco
def test_it_is_evaluated_by_the_cores_runner(tmp_path):
    table = {
        "type": "EvalRunner",
        "environment": reacher(),
        "policy": "random",
        "episodes": 3,
        "workers": 1,
        "record_videos": 1,
    }
    runner = build_runner_from_cfg(table, RunContext(work_dir=tmp_path, section="eval"))
    runner.run_setup()
    found = runner.run()
    counted = found["groups"]["policy"]["tasks"]["Reacher-v5"]
    assert (counted["episodes"], counted["errors"]) == (3, 0)
    assert found["settings"]["render"] == "cheap", "the results say how images are drawn"
    assert len(found["videos"]) == 1
    lines = (tmp_path / "eval" / "episodes.jsonl").read_text().splitlines()[1:]
    records = [json.loads(line) for line in lines]
    assert len({record["state_hash"] for record in records}) == 3


def aloha(**arguments):
    sides = ("left", "right")
    names = [f"{s}_{n}" for s in sides for n in ("j1", "j2", "j3", "j4", "j5", "j6", "gripper")]
    return {
        "id": "gym_aloha/AlohaTransferCube-v0",
        "module": "gym_aloha",
        "make": {"obs_type": "pixels_agent_pos"},
        "state": ["agent_pos"],
        "embodiment": {
            "name": "aloha",
            "rate_hz": 50.0,
            "joints": [joint(name, -3.2, 3.2) for name in names],
            "cameras": [{"name": "top", "height": 480, "width": 640}],
        },
        "max_steps": 300,
        **arguments,
    }


@needs_aloha
def test_gym_aloha_from_a_config():
    made = GymnasiumEnvironment(**aloha())
    assert made.spec.tasks[0].name == "gym_aloha-AlohaTransferCube-v0", "a file name"
    made.reset(5, made.spec.tasks[0].name)
    home = made.state
    image = made.observe(made.spec.embodiment.cameras)["images"]["top"]
    assert (home.shape, image.shape) == ((14,), (480, 640, 3))
    physics = made._env.unwrapped._env.physics
    assert physics.model.ptr.vis.quality.shadowsize == 0, "behind dm_control, too"
    found = made.step(home)
    assert (found.success, found.ended, found.reward) == (False, False, 0.0)
    np.testing.assert_allclose(made.state, home, atol=0.05)
    made.close()


@needs_aloha
def test_a_simulation_behind_dm_control_is_watched_too(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where MuJoCo leaves its log
    from dm_control.rl.control import PhysicsError

    made = GymnasiumEnvironment(**aloha())
    made.reset(5, made.spec.tasks[0].name)
    assert divergence(made.simulation) is None
    made.simulation.qvel[:] = 1e12
    with pytest.raises(PhysicsError, match="BADQVEL"):  # dm_control says it by itself, as a rule
        made.step(made.state)
    assert divergence(made.simulation) == "MuJoCo warned of BADQVEL at index 0"
    made.close()


def test_a_discrete_action_is_the_nearest_one(monkeypatch):
    made = GymnasiumEnvironment("CartPole-v1", body(1, 4), success="terminated")
    given = []
    made.reset(0, "CartPole-v1")
    step = made._env.step
    monkeypatch.setattr(made._env, "step", lambda action: given.append(action) or step(action))
    for value in (-7.0, 0.4, 0.6, 9.0):
        made.step(np.array([value]))
    assert given == [0, 0, 1, 1]
    while not (found := made.step(np.array([1.0]))).ended:
        assert not found.success
    assert found.success
    made.close()


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"embodiment": body(2, 4)}, SpecMismatch, "have 1 numbers, the embodiment has 2 joints"),
        ({"embodiment": body(1, 3)}, SpecMismatch, "has 4 numbers, the embodiment 3"),
        ({"state": ["agent_pos"]}, SpecMismatch, "the observation has no part 'agent_pos'"),
        ({"id": "NoSuch-v0"}, MissingPlugin, "there is no Gymnasium environment 'NoSuch-v0'"),
        ({"module": "no_such_package"}, MissingPlugin, "'no_such_package' cannot be imported"),
        ({"make": {"nonsense": 1}}, RunFailed, "the environment cannot be made: TypeError"),
    ],
)
def test_what_does_not_fit_is_refused_before_the_first_step(arguments, error, message):
    table = {"id": "CartPole-v1", "embodiment": body(1, 4), **arguments}
    made = GymnasiumEnvironment(**table)
    with pytest.raises(error, match=message):
        made.reset(0, made.spec.tasks[0].name)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"render": "nice"}, "render 'nice' is unknown; choose one of"),
        (
            {"id": "gym_aloha:gym_aloha/X-v0"},
            "--set <GymnasiumEnvironment>.module=gym_aloha "
            "--set <GymnasiumEnvironment>.id=gym_aloha/X-v0",
        ),
        ({"module": "os.path"}, "'os.path' is not the name of an installed package"),
        ({"success": "reward"}, "success 'reward' is not one of info, terminated, truncated"),
        (
            {"success_reward": 1.0, "success_return": 9.0},
            "success_reward and success_return are two ways: give one of them",
        ),
        (
            {"instruction": "balance", "instruction_from": "mission"},
            "instruction and instruction_from are two ways",
        ),
        ({"max_steps": 0}, "max_steps must be at least 1, got 0"),
        ({"cameras": {"top": "render"}}, "the embodiment has no camera 'top'; it has none"),
    ],
)
def test_impossible_values_are_refused(arguments, message):
    with pytest.raises(ConfigError) as caught:
        GymnasiumEnvironment(**{"id": "CartPole-v1", "embodiment": body(1, 4), **arguments})
    assert message in str(caught.value)


def test_an_image_that_is_not_there_is_named():
    made = GymnasiumEnvironment("CartPole-v1", body(1, 4, [("top", 8, 8)]), success="terminated")
    made.reset(0, "CartPole-v1")
    with pytest.raises(SpecMismatch, match="has no image 'top'; it has none") as caught:
        made.observe(made.spec.embodiment.cameras)
    assert "--set '<GymnasiumEnvironment>.cameras={top = \"NAME\"}'" in str(caught.value)
    made.close()


def test_observations_are_taken_apart_by_name():
    eye = np.zeros((4, 5, 3), np.uint8)
    found = parts({"z": np.array([[1.0, 2.0]]), "eyes": {"left": eye}, "a": 3})
    assert list(found) == ["a", "eyes.left", "z"]
    assert list(images_of(found)) == ["eyes.left"]
    np.testing.assert_array_equal(state_row(found, None), [3, 1, 2])
    np.testing.assert_array_equal(state_row(found, ["z"]), [1, 2])
    assert list(parts(eye)) == ["image"]
    assert state_row(parts(eye), None).shape == (0,)


@pytest.mark.parametrize(
    ("judge", "reward", "total", "terminated", "lasted", "info", "done"),
    [
        (SuccessCriterion(), 0, 0, False, False, {"is_success": np.True_}, True),
        (SuccessCriterion(), 0, 0, True, False, {"success": 0.0}, False),
        (SuccessCriterion(), 0, 0, False, False, {}, False),
        (SuccessCriterion("terminated"), 0, 0, True, False, {}, True),
        (SuccessCriterion("truncated"), 0, 0, False, True, {}, True),
        (SuccessCriterion("truncated"), 0, 0, True, True, {}, False),
        (SuccessCriterion(reward=4.0), 4.0, 0, False, False, {}, True),
        (SuccessCriterion(reward=4.0), 3.9, 9, True, False, {}, False),
        (SuccessCriterion(total=9.0), 1.0, 9.0, False, False, {}, True),
        (SuccessCriterion(total=9.0), 10.0, 8.9, True, True, {}, False),
    ],
)
def test_success_has_five_ways_of_being_said(judge, reward, total, terminated, lasted, info, done):
    assert judge.done(reward, total, terminated, lasted, info) is done


@pytest.mark.parametrize(
    ("ways", "steps", "success"),
    [
        ({"success": "truncated"}, 12, True),
        ({"success_return": 12.0}, 12, True),
        ({"success_return": 13.0}, 12, False),
        ({"success": "truncated", "max_steps": 8}, 8, True),
    ],
)
def test_lasting_is_a_success_where_that_is_the_task(ways, steps, success):
    """A pole that is still up when the time is: Gymnasium truncates, nothing terminates."""
    made = GymnasiumEnvironment("CartPole-v1", body(1, 4), make={"max_episode_steps": 12}, **ways)
    made.reset(0, "CartPole-v1")
    for step in range(steps):
        found = made.step(np.array([step % 2]))
    assert found.success is success
    assert found.ended or made.spec.tasks[0].max_steps == steps
    made.close()


def test_who_never_says_whether_it_is_done_is_refused_before_the_first_episode():
    made = GymnasiumEnvironment("CartPole-v1", body(1, 4))
    with pytest.raises(ConfigError, match="CartPole-v1 does not say whether its task is") as caught:
        made.reset(0, "CartPole-v1")
    assert "its info has nothing, and neither of is_success, success" in str(caught.value)
    assert "--set <GymnasiumEnvironment>.success=terminated (or truncated)" in str(caught.value)


def test_in_a_run_the_hint_is_an_option_for_its_config(tmp_path):
    table = {"type": "GymnasiumEnvironment", "id": "CartPole-v1", "embodiment": body(1, 4)}
    section = {"type": "EvalRunner", "environment": table, "policy": "random", "episodes": 1}
    (tmp_path / "c.py").write_text(f"eval = {section!r}\n")
    words = ["run", "--config", "c.py", "--section", "eval", "--work-dir", "work"]
    ended = subprocess.run(
        [sys.executable, "-m", "fluxvla_core", *words],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 2
    assert "next: --set eval.environment.success=terminated (or truncated)" in ended.stderr


class Errand(gymnasium.Env):
    """A place to go to, said in words that are another in each episode; a nested observation.

    Says whether it is done at its end alone.
    """

    observation_space = gymnasium.spaces.Dict(
        {
            "mission": gymnasium.spaces.Text(20),
            "pair": gymnasium.spaces.Tuple(
                (gymnasium.spaces.Discrete(9), gymnasium.spaces.Box(-9, 9, (2,)))
            ),
        }
    )
    action_space = gymnasium.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.goal, self.place = int(self.np_random.integers(3, 6)), 0
        return self._seen(), {}

    def step(self, action):
        self.place += 1 if action else -1
        over = abs(self.place) == self.goal
        info = {"is_success": self.place == self.goal} if over else {}
        return self._seen(), -1.0, over, False, info

    def _seen(self):
        pair = (self.place % 9, np.array([self.place, self.goal], np.float32))
        return {"mission": f"go to {self.goal}", "pair": pair}


gymnasium.register("FluxErrand-v0", Errand)


def errand(**arguments):
    return {
        "type": "GymnasiumEnvironment",
        "id": "FluxErrand-v0",
        "embodiment": body(1, 3),
        "instruction_from": "mission",
        "max_steps": 200,
        **arguments,
    }


class Obedient:
    """Goes right as often as the instruction says: what it does follows from the words alone."""

    def __init__(self):
        self.told = []

    def reset(self, seed):
        return

    def predict_action(self, observation):
        self.told.append(observation["task_description"])
        return np.ones((1, 1))


def test_words_of_each_episode_reach_the_policy_and_the_record():
    made = build_environment_from_cfg(errand())
    policy, task = Obedient(), made.spec.tasks[0]
    records = [run_episode(made, policy, task, seed, RolloutSettings()) for seed in range(12)]
    assert {r["instruction"] for r in records} == {"go to 3", "go to 4", "go to 5"}
    assert all(r["success"] and r["instruction"] == f"go to {r['steps']}" for r in records)
    assert set(policy.told) == {"go to 3", "go to 4", "go to 5"}
    assert made.state.shape == (3,), "nested parts, and no text among them"
    made.close()
    counted = summarise([{**r, "group": "g", "task": "t", "status": "done"} for r in records])
    assert counted["g"]["all"]["mean_return"] == -np.mean([r["steps"] for r in records])


def test_what_is_no_array_of_numbers_is_refused_in_words():
    with pytest.raises(SpecMismatch, match=r"observation's part 'odd\.1' is a set: no array of n"):
        parts({"mission": "go", "odd": (1.0, {2})})
    made = build_environment_from_cfg(errand(state=["mission", "pair.0"]))
    with pytest.raises(SpecMismatch, match="the observation's part 'mission' is a text") as caught:
        made.reset(0, "FluxErrand-v0")
    assert "instruction_from = 'mission'" in str(caught.value)
    made = build_environment_from_cfg(errand(instruction_from="pair.0"))
    made.reset(0, "FluxErrand-v0")
    with pytest.raises(SpecMismatch, match=r"has no text 'pair\.0'; it has mission"):
        made.observe(())


def test_importing_imports_no_simulator():
    code = (
        "import sys, fluxvla_gymnasium.environment\n"
        "print([m for m in ('mujoco', 'gymnasium', 'torch') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "[]", done.stderr
