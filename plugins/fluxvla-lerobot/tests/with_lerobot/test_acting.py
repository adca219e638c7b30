"""Policies act here as in LeRobot's own loop, on a robot of other names, and follow their seeds."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip(
    "lerobot", reason="needs LeRobot: test_in_lerobots_environment.py runs this in its environment"
)

import torch
from fluxvla_lerobot.policy import LeRobotPolicy
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.policies.utils import prepare_observation_for_inference

from fluxvla_core import EmbodimentSpec, Joint
from fluxvla_core.errors import CheckpointError, ConfigError, DataError, LoadFailed, SpecMismatch
from fluxvla_core.testing import PolicyConformance

from .tiny import CAMERAS, JOINTS, ROBOT, SIZE, features, observation, save

KINDS = {
    "act": {},
    "act averaged": {"temporal_ensemble_coeff": 0.01, "n_action_steps": 1},
    "diffusion": {"n_obs_steps": 1},
    "diffusion history": {"n_obs_steps": 2},
    "vqbet": {"cameras": CAMERAS[:1]},
    "tdmpc": {"cameras": ("image",), "size": (64, 64)},
}


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Name of ``KINDS`` -> folder that LeRobot saved."""
    root = tmp_path_factory.mktemp("policies")
    return {
        name: save(root / name, name.split()[0], **settings) for name, settings in KINDS.items()
    }


def seen_by(name, number):
    settings = KINDS[name]
    return observation(number, settings.get("cameras", CAMERAS), settings.get("size", SIZE))


def drawn(seed, call):
    """LeRobot's draws in a call, as the policy here has them."""
    (number,) = np.random.SeedSequence((seed, call)).generate_state(1, np.uint64)
    torch.manual_seed(int(number))


def lerobots_episode(folder, name, length):
    """Commands of LeRobot's loop: ``select_action`` at each step, then the postprocessor."""
    config = PreTrainedConfig.from_pretrained(folder)
    policy = get_policy_class(config.type).from_pretrained(folder, config=config)
    before, after = make_pre_post_processors(config, pretrained_path=str(folder))
    policy.reset()
    commands = []
    for step in range(length):
        drawn(3, step)
        raw = features(seen_by(name, step))
        batch = before(prepare_observation_for_inference(raw, torch.device("cpu"), "pick"))
        with torch.inference_mode():
            commands.append(after(policy.select_action(batch))[0].double().numpy())
    return np.array(commands)


class TestLeRobotPolicy(PolicyConformance):
    entry_point = "LeRobotPolicy"

    @pytest.fixture(autouse=True)
    def _saved(self, folders):
        self.path = str(folders["act"])

    def make(self):
        return LeRobotPolicy(self.path, embodiment=ROBOT.to_dict(), rate_hz=10.0)


@pytest.mark.parametrize("name", ["act averaged", "diffusion history", "vqbet", "tdmpc"])
def test_what_is_asked_at_each_step_gives_what_lerobots_loop_gives(folders, name):
    """Twelve steps: several chunks of LeRobot's queues, with the observations between them."""
    policy = LeRobotPolicy(str(folders[name]))
    assert policy.horizon == 1
    policy.reset(3)
    found = [policy.predict_action(seen_by(name, step)) for step in range(12)]
    assert np.array_equal(np.concatenate(found), lerobots_episode(folders[name], name, 12))


@pytest.mark.parametrize(("name", "horizon"), [("act", 8), ("diffusion", 5)])
def test_a_chunk_is_what_lerobots_loop_takes_out_of_its_queue(folders, name, horizon):
    policy = LeRobotPolicy(str(folders[name]))
    assert policy.horizon == horizon
    policy.reset(3)
    chunk = policy.predict_action(seen_by(name, 0))
    expected = lerobots_episode(folders[name], name, 5)
    # One call is the same but for the order in which rows are denormalised.
    np.testing.assert_allclose(chunk[:5], expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("name", ["diffusion", "diffusion history"])
def test_draws_follow_from_the_seed_alone(folders, name):
    policy = LeRobotPolicy(str(folders[name]))

    def episode(seed):
        policy.reset(seed)
        return np.concatenate([policy.predict_action(seen_by(name, i)) for i in range(3)])

    torch.manual_seed(1)
    before = torch.random.get_rng_state()
    first = episode(3)
    assert torch.equal(torch.random.get_rng_state(), before)  # others' draws are left alone
    assert not np.array_equal(first, episode(4))
    assert np.array_equal(first, episode(3))


def test_a_robot_with_other_names_order_and_units(folders):
    """The policy's joints are j0, j1, …, in degrees; the robot has them backwards, in radians."""
    backwards = replace(
        ROBOT,
        joints=ROBOT.joints[::-1],
        cameras=tuple(
            replace(camera, name=name)
            for camera, name in zip(ROBOT.cameras, ("cam_high", "cam_right"), strict=True)
        ),
    )
    plain = LeRobotPolicy(str(folders["act"]))
    mapped = LeRobotPolicy(
        str(folders["act"]),
        embodiment=backwards.to_dict(),
        cameras={"front": "cam_high", "wrist": "cam_right"},
        state=JOINTS,
        actions=JOINTS,
        degrees=True,
    )
    assert mapped.cameras == ("cam_high", "cam_right")
    seen = observation(0)
    turned = {
        **seen,
        "qpos": np.float32(np.deg2rad(seen["qpos"][::-1])),
        "images": {
            "cam_high": seen["images"]["front"],
            "cam_right": seen["images"]["wrist"],
        },
    }
    expected = np.deg2rad(plain.predict_action(seen)[:, ::-1])
    np.testing.assert_allclose(mapped.predict_action(turned), expected, rtol=1e-5, atol=1e-7)


def test_larger_images_of_the_same_view_are_scaled(folders):
    policy = LeRobotPolicy(str(folders["act"]), embodiment=ROBOT.to_dict())
    small = observation(0)
    large = {
        **small,
        "images": {n: i.repeat(2, axis=0).repeat(2, axis=1) for n, i in small["images"].items()},
    }
    assert np.array_equal(policy.predict_action(large), policy.predict_action(small))
    other = {**small, "images": {**small["images"], "front": np.zeros((72, 72, 3), np.uint8)}}
    with pytest.raises(DataError, match=r"front gives 72 x 72 .* trained on 72 x 96: another view"):
        policy.predict_action(other)


@pytest.mark.parametrize(
    ("settings", "kind", "words"),
    [
        ({"rate_hz": 0.0}, ConfigError, "rate_hz must be positive, got 0.0"),
        ({"cameras": {"top": "front"}}, ConfigError, "no camera 'top'; it has front, wrist"),
        ({"cameras": {"front": "wrist"}}, ConfigError, "two of the policy's cameras are 'wrist'"),
        ({"left_out": ["wrist"]}, LoadFailed, "does not answer by predict_action_chunk: KeyError"),
        ({"tokenizer": "x"}, CheckpointError, "type 'act' has no tokenizer_processor"),
        ({"device": "abacus"}, ConfigError, "device is 'abacus', and torch knows no such one"),
        ({"device": "cuda"}, ConfigError, "device is 'cuda', and LeRobot finds 'cpu' here"),
        ({"state": JOINTS[:5]}, SpecMismatch, "takes 6 state values .*; arm has 5: j0"),
        ({"actions": ("j9",)}, SpecMismatch, "arm has no joint 'j9'; it has j0, j1"),
    ],
)
def test_what_does_not_fit_is_refused(folders, settings, kind, words):
    robot = {"embodiment": ROBOT.to_dict()} if {"state", "actions"} & set(settings) else {}
    with pytest.raises(kind, match=words):
        LeRobotPolicy(str(folders["act"]), **robot, **settings)


def test_another_robot_is_refused(folders):
    path = str(folders["act"])
    short = replace(ROBOT, joints=ROBOT.joints[:5])
    with pytest.raises(SpecMismatch, match=r"takes 6 state values .*; arm has 5"):
        LeRobotPolicy(path, embodiment=short.to_dict())
    seven = replace(ROBOT, joints=(*ROBOT.joints, Joint("j6", "rad", -1, 1, 1, 1)))
    with pytest.raises(SpecMismatch, match="gives 6 values for an action; arm takes 7"):
        LeRobotPolicy(path, embodiment=seven.to_dict(), state=JOINTS)
    wide = EmbodimentSpec.from_dict({**ROBOT.to_dict()})
    wide = replace(wide, cameras=tuple(replace(c, width=128) for c in wide.cameras))
    with pytest.raises(SpecMismatch, match=r"front gives 72 x 128 images; .* trained on 72 x 96"):
        LeRobotPolicy(path, embodiment=wide.to_dict())
    policy = LeRobotPolicy(path)
    with pytest.raises(DataError, match="no image of 'wrist'; it has front"):
        policy.predict_action(observation(0, CAMERAS[:1]))
    with pytest.raises(DataError, match=r"qpos has shape \(5,\); \(6,\) is expected"):
        policy.predict_action({**observation(0), "qpos": np.zeros(5, np.float32)})
    named = LeRobotPolicy(path, state=JOINTS)
    with pytest.raises(SpecMismatch, match="about a robot's joints, and none is known"):
        named.predict_action(observation(0))


def test_chunks_without_history_cannot_be_asked_of_a_policy_with_history(folders):
    with pytest.raises(ConfigError, match="each_step is False, and the policy looks at 2"):
        LeRobotPolicy(str(folders["diffusion history"]), each_step=False)
    with pytest.raises(LoadFailed, match="does not answer by predict_action_chunk"):
        LeRobotPolicy(str(folders["tdmpc"]), each_step=False)


def edited(folder, target, change):
    """The folder's weights, changed."""
    import shutil

    from safetensors.torch import load_file, save_file

    shutil.copytree(folder, target)
    tensors = load_file(target / "model.safetensors")
    change(tensors)
    save_file(tensors, target / "model.safetensors", {"format": "pt"})
    return str(target)


def test_weights_that_are_not_there_are_refused(folders, tmp_path):
    name = "model.action_head.weight"
    missing = edited(folders["act"], tmp_path / "missing", lambda tensors: tensors.pop(name))
    with pytest.raises(CheckpointError, match=name):
        LeRobotPolicy(missing)


def test_random_weights_are_noticed_where_lerobot_goes_on_with_them(folders, monkeypatch):
    """As its PI0 and PI0.5 do after an error."""
    kind = get_policy_class("act")

    def forgetful(folder, config, strict):
        torch.manual_seed(5)
        return kind(config)

    monkeypatch.setattr(kind, "from_pretrained", forgetful)
    with pytest.raises(CheckpointError, match=r"tensors are not those of model\.safe"):
        LeRobotPolicy(str(folders["act"]))


def test_missing_statistics_are_refused(folders, tmp_path):
    import shutil

    from safetensors.torch import load_file, save_file

    shutil.copytree(folders["act"], tmp_path / "base")
    (file,) = (tmp_path / "base").glob("policy_postprocessor*.safetensors")
    kept = {n: t for n, t in load_file(file).items() if not n.startswith("action.")}
    save_file(kept, file)
    with pytest.raises(CheckpointError, match="UnnormalizerProcessorStep has no statistics of ac"):
        LeRobotPolicy(str(tmp_path / "base"))


def test_a_chunk_is_finite_and_near_its_statistics(folders):
    policy = LeRobotPolicy(str(folders["act"]))
    chunk = policy.predict_action(observation(0))
    assert chunk.dtype == np.float64
    assert all(math.isfinite(value) for value in chunk.flat)
    assert set(policy.stages) == {"preprocess", "inference", "postprocess"}
