"""Real Gymnasium environments behind the contract, and what is said where they do not fit."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib.util import find_spec

import numpy as np
import pytest
from fluxvla_gymnasium.environment import GymnasiumEnvironment
from fluxvla_gymnasium.parts import parts, pictures, state_row
from fluxvla_gymnasium.success import is_done

from fluxvla_core.build import RunContext, build_environment_from_cfg, build_runner_from_cfg
from fluxvla_core.errors import ConfigError, MissingPlugin, RunFailed, SpecMismatch
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
    picture = None


@needs_mujoco
def test_a_real_environment_with_pictures():
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
    assert found["settings"]["render"] == "cheap", "the results say how pictures are drawn"
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
    picture = made.observe(made.spec.embodiment.cameras)["images"]["top"]
    assert (home.shape, picture.shape) == ((14,), (480, 640, 3))
    physics = made._env.unwrapped._env.physics
    assert physics.model.ptr.vis.quality.shadowsize == 0, "behind dm_control, too"
    found = made.step(home)
    assert (found.success, found.ended, found.reward) == (False, False, 0.0)
    np.testing.assert_allclose(made.state, home, atol=0.05)
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
        ({"render": "nice"}, "render 'nice' is none of"),
        ({"id": "gym_aloha:gym_aloha/X-v0"}, "set module = 'gym_aloha' and id = 'gym_aloha/X-v0'"),
        ({"module": "os.path"}, "'os.path' is no name of an installed package"),
        ({"success": "reward"}, "success 'reward' is none of info, terminated"),
        ({"max_steps": 0}, "max_steps must be at least 1, got 0"),
        ({"cameras": {"top": "render"}}, "the embodiment has no camera 'top'; it has none"),
    ],
)
def test_impossible_values_are_refused(arguments, message):
    with pytest.raises(ConfigError) as caught:
        GymnasiumEnvironment(**{"id": "CartPole-v1", "embodiment": body(1, 4), **arguments})
    assert message in str(caught.value)


def test_a_picture_that_is_not_there_is_named():
    made = GymnasiumEnvironment("CartPole-v1", body(1, 4, [("top", 8, 8)]))
    made.reset(0, "CartPole-v1")
    with pytest.raises(SpecMismatch, match="has no picture 'top'; it has none") as caught:
        made.observe(made.spec.embodiment.cameras)
    assert "set cameras = {'top': '<one of these, or render>'}" in str(caught.value)
    with pytest.raises(RunFailed, match=r"whether its task is done; its info has \[\]") as caught:
        made.step(np.array([1.0]))
    assert "success = 'terminated'" in str(caught.value)
    made.close()


def test_observations_are_taken_apart_by_name():
    eye = np.zeros((4, 5, 3), np.uint8)
    found = parts({"z": np.array([[1.0, 2.0]]), "eyes": {"left": eye}, "a": 3})
    assert list(found) == ["a", "eyes.left", "z"]
    assert list(pictures(found)) == ["eyes.left"]
    np.testing.assert_array_equal(state_row(found, None), [3, 1, 2])
    np.testing.assert_array_equal(state_row(found, ["z"]), [1, 2])
    assert list(parts(eye)) == ["image"]
    assert state_row(parts(eye), None).shape == (0,)


@pytest.mark.parametrize(
    ("how", "reward_from", "reward", "terminated", "info", "done"),
    [
        ("info", None, 0, False, {"is_success": np.True_}, True),
        ("info", None, 0, True, {"success": 0.0}, False),
        ("terminated", None, 0, True, {}, True),
        ("info", 4.0, 4.0, False, {}, True),
        ("info", 4.0, 3.9, True, {}, False),
    ],
)
def test_success_has_four_ways_of_being_said(how, reward_from, reward, terminated, info, done):
    assert is_done(how, reward_from, reward, terminated, info) is done


def test_importing_imports_no_simulator():
    code = (
        "import sys, fluxvla_gymnasium.environment\n"
        "print([m for m in ('mujoco', 'gymnasium', 'torch') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "[]", done.stderr
