"""A policy that LeRobot saved acts here and imported into this project's own families alike.

Both begin with the same images, joint states and words, and end with joint commands. Noise is
drawn differently: LeRobot's policy is given what the imported one draws.
"""

from __future__ import annotations

import importlib
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip(
    "lerobot", reason="needs LeRobot: test_in_lerobots_environment.py runs this in its environment"
)

import lerobot
import torch
from fluxvla_lerobot.policy import LeRobotPolicy

from fluxvla_core import EmbodimentSpec
from fluxvla_core.cli.main import main
from fluxvla_core.contracts.policy import with_history
from fluxvla_core.models import load_policy

from .tiny import CAMERAS, ROBOT, observation, save

PLUGINS = Path(__file__).parents[3]
newest = pytest.mark.skipif(
    not lerobot.__version__.startswith("0.6"),
    reason="LeRobot 0.4 asks for a transformers of its own making; nox -s oracles has 0.6.1",
)


def imported(folder, robot, *more):
    """The folder's policy as one of this project's own."""
    described = folder.parent / "robot.json"
    described.write_text(json.dumps(robot.to_dict()))
    out = folder.parent / "ours"
    options = ["--embodiment", str(described), "--rate", "10", *more]
    assert main(["import-checkpoint", str(folder), str(out), *options]) == 0
    return load_policy(out)


def assert_alike(ours, theirs, seen):
    ours.reset(5)
    expected = theirs.predict_action(seen)
    found = ours.predict_action(seen)
    assert found.shape == expected.shape
    assert np.abs(found - expected).max() < 1e-5 * np.abs(expected).max()
    return found


@pytest.mark.parametrize("name", ["plain", "pre_norm"])
def test_act(tmp_path, name):
    cameras = {"plain": CAMERAS, "pre_norm": CAMERAS[:1]}[name]
    settings = {"plain": {}, "pre_norm": {"pre_norm": True, "n_decoder_layers": 2}}[name]
    folder = save(tmp_path / "theirs", "act", cameras, **settings)
    theirs = LeRobotPolicy(str(folder), embodiment=ROBOT.to_dict(), rate_hz=10.0)
    ours = imported(folder, ROBOT)
    chunks = [assert_alike(ours, theirs, observation(number)) for number in range(3)]
    assert np.abs(chunks[0] - chunks[1]).max() > 1e-3  # they look at what they are shown


def test_diffusion(tmp_path, monkeypatch):
    """By DDIM, whose only draw is the first noise. LeRobot returns the actions that it executes."""
    folder = save(tmp_path / "theirs", "diffusion", n_obs_steps=1)
    theirs = LeRobotPolicy(str(folder), embodiment=ROBOT.to_dict(), rate_hz=10.0)
    ours = imported(folder, ROBOT)
    shape = ours.model.action_shape
    noise = torch.from_numpy(ours_noise(shape))
    monkeypatch.setattr(ours, "_noise", lambda seed, call: noise.numpy())
    first = noise.reshape(1, -1, shape[-1])[:, : theirs._loaded.policy.config.horizon]
    monkeypatch.setattr(torch, "randn", lambda *_, **__: first.clone())
    for number in range(2):
        seen = observation(number)
        theirs.reset(0)
        expected, found = theirs.predict_action(seen), ours.predict_action(seen)
        assert np.abs(found[: len(expected)] - expected).max() < 1e-5 * np.abs(expected).max()


@pytest.mark.parametrize("n_obs_steps", [2, 3])
def test_a_rollout_of_a_diffusion_policy_of_several_observations(
    tmp_path, monkeypatch, n_obs_steps
):
    """LeRobot keeps its last observations itself; ours is given them with each question."""
    settings = {"n_obs_steps": n_obs_steps, "n_action_steps": 4}
    folder = save(tmp_path / "theirs", "diffusion", CAMERAS[:1], **settings)
    robot = replace(ROBOT, cameras=ROBOT.cameras[:1])
    theirs = LeRobotPolicy(str(folder), embodiment=robot.to_dict(), rate_hz=10.0)
    ours = imported(folder, robot)
    assert (ours.n_obs_steps, ours.horizon, theirs.horizon) == (n_obs_steps, 9 - n_obs_steps, 1)
    noise = torch.from_numpy(ours_noise(ours.model.action_shape))
    monkeypatch.setattr(ours, "_noise", lambda seed, call: noise.numpy())
    monkeypatch.setattr(torch, "randn", lambda *_, **__: noise.clone())
    seen = [observation(number, CAMERAS[:1]) for number in range(11)]
    theirs.reset(0)
    ours.reset(0)
    expected = np.concatenate([theirs.predict_action(each) for each in seen])

    found = []
    for step in range(0, 11, 4):
        asked = with_history(seen[step], n_obs_steps, seen[:step])
        found.append(ours.predict_action(asked)[:4])
    commands = np.concatenate(found)[:11]
    assert np.abs(commands - expected).max() < 1e-5 * np.abs(expected).max()
    assert np.abs(found[0] - found[1]).max() > 1e-3  # they look at what they are shown


def ours_noise(shape):
    return np.random.default_rng(0).standard_normal((1, *shape)).astype(np.float32)


@pytest.fixture
def oracle(monkeypatch):
    """Modules that make tiny policies of a family, as its plugin's golden files are made."""
    before = set(sys.modules)

    def of(plugin, *names):
        monkeypatch.syspath_prepend(PLUGINS / plugin / "tests" / "oracles")
        return [importlib.import_module(name) for name in names]

    yield of
    for name in set(sys.modules) - before:
        if name.startswith(("make_", "pi_inputs")):
            del sys.modules[name]


def robot_of(joints, cameras, states=None):
    from fluxvla_core import Camera, Joint

    def named(count):
        return tuple(Joint(f"j{i}", "rad", -9.0, 9.0, 9.0, 9.0) for i in range(count))

    views = tuple(Camera(name, *size) for name, size in cameras.items())
    own = named(states) if states is not None else None
    return EmbodimentSpec("arm", named(joints), views, 10.0, state_joints=own)


@newest
@pytest.mark.parametrize("family", ["pi0", "pi05"])
def test_pi(tmp_path, monkeypatch, oracle, family):
    made, inputs = oracle("fluxvla-pi", "make_lerobot061_policies", "pi_inputs")
    policy = made.build(family)
    stats = {
        key: {name: torch.from_numpy(row) for name, row in rows.items()}
        for key, rows in inputs.statistics().items()
    }
    words = tmp_path / "words"
    words.mkdir()
    inputs.tokenizer().save(str(words / "tokenizer.json"))
    (words / "tokenizer_config.json").write_text(
        json.dumps({"pad_token": "<pad>", "bos_token": "<bos>"})
    )
    monkeypatch.setattr(made.tokenizer_processor, "AutoTokenizer", made.LocalTokenizer)
    folder = tmp_path / "theirs"
    policy.save_pretrained(folder)
    for processor in made.make_pre_post_processors(policy.config, dataset_stats=stats):
        processor.save_pretrained(folder)
    robot = robot_of(inputs.ROBOT_ACTIONS, inputs.SIZES_OF_CAMERAS)
    theirs = LeRobotPolicy(str(folder), embodiment=robot.to_dict(), tokenizer=str(words))
    first = torch.from_numpy(inputs.first_noise())
    monkeypatch.setattr(theirs._loaded.policy.model, "sample_noise", lambda *_: first.clone())
    ours = imported(folder, robot, "--tokenizer", str(words))
    images, state = inputs.observation()
    task = inputs.TASKS[family]
    assert_alike(ours, theirs, {"images": images, "qpos": state, "task_description": task})


@newest
def test_smolvla(tmp_path, monkeypatch, oracle):
    (made,) = oracle("fluxvla-smolvla", "make_lerobot061")
    for name in ("AutoConfig", "AutoProcessor"):  # make_policy sets them
        monkeypatch.setattr(made.smolvlm_with_expert, name, getattr(made.smolvlm_with_expert, name))
    policy = made.make_policy(empty_cameras=1).eval()
    words = tmp_path / "words"
    words.mkdir()
    made.byte_tokenizer(words)
    policy.config.vlm_model_name = str(words)
    processors = made.make_smolvla_pre_post_processors(policy.config, made.make_statistics())
    policy.config.vlm_model_name = made.BACKBONE
    made.save_folder(policy, tmp_path, *processors)
    folder = (tmp_path / "saved").rename(tmp_path / "theirs")
    robot = robot_of(made.ACTION, made.CAMERAS, made.STATE)
    theirs = LeRobotPolicy(str(folder), embodiment=robot.to_dict(), tokenizer=str(words))
    ours = imported(folder, robot, "--tokenizer", str(words))
    noise = made.noise_of(1)
    monkeypatch.setattr(theirs._loaded.policy.model, "sample_noise", lambda *_: noise.clone())
    monkeypatch.setattr(ours, "_noise", lambda seed, call: noise.numpy())
    for number in range(2):
        seen = {
            "images": {
                name: made.fill.integers(f"picture {name} {number}", (*size, 3), 256).astype(
                    np.uint8
                )
                for name, size in made.CAMERAS.items()
            },
            "qpos": made.fill.normal(f"state {number}", (made.STATE,)),
            "task_description": made.TASKS[number],
        }
        assert_alike(ours, theirs, seen)
