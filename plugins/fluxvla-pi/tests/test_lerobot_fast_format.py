"""LeRobot's PI0-FAST: it acts here as there, its tokenizer of actions goes with it."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
import torch
from fluxvla_pi.lerobot_fast_format import LeRobotPi0FastFormat
from fluxvla_pi.lerobot_format import LeRobotPiFormat
from fluxvla_pi.names import LEROBOT
from safetensors.torch import load_file, save_file

from fluxvla_core.build import build_transform_from_cfg
from fluxvla_core.cli.main import main
from fluxvla_core.data import PrivateInferenceDataset
from fluxvla_core.errors import CheckpointError, ConfigError
from fluxvla_core.models import load_policy

from .oracles import pi_inputs as tiny
from .published_folders import GOLDEN, fast_folder, fast_words_folder, observation, robot_file

CHANGES = [
    (lambda c: c.update(use_peft=True), "use_peft is True; False is read"),
    (lambda c: c.update(fast_skip_tokens="x"), "fast_skip_tokens is 'x', not a number"),
    (lambda c: c.update(max_action_tokens=0), "max_action_tokens is 0, not a number from 1"),
    (
        lambda c: c.update(action_tokenizer_name="someone/other"),
        "tokenizer of actions, someone/other, is not in the checkpoint's files",
    ),
]


@pytest.fixture
def source(tmp_path):
    return fast_folder(tmp_path / "theirs")


@pytest.fixture
def words(tmp_path):
    return fast_words_folder(tmp_path / "words")


@pytest.fixture(scope="module")
def golden():
    return load_file(GOLDEN / "lerobot061_pi0_fast_policy.safetensors")


def test_it_acts_as_there_from_images_and_joints_to_commands(tmp_path, source, words, golden):
    robot = robot_file(tmp_path / "robot.json")
    told = ["--tokenizer", str(words), "--embodiment", str(robot), "--rate", "10"]
    out = tmp_path / "ours"
    assert main(["import-checkpoint", str(source), str(out), *told]) == 0
    shutil.rmtree(source)
    shutil.rmtree(words)
    policy = load_policy(out)
    policy.reset(tiny.SEED)
    row = policy.host_batch([_question(observation("pi05"))])
    with torch.no_grad():
        said = policy.model.answer(**{key: v for key, v in row.items() if key != "noise"})
    assert torch.equal(said, golden["answer"][:, : said.shape[1]])
    found = policy.predict_action(observation("pi05"))
    expected = golden["commands"][0].double().numpy()
    assert found.shape == expected.shape == (tiny.HORIZON, tiny.ROBOT_ACTIONS)
    assert np.abs(found - expected).max() < 1e-5 * np.abs(expected).max()

    # The same without luck in what random weights say: the answer that is a chunk.
    ids = policy.model._action_tokenizer().encode_actions(golden["normalized_actions"][0])
    answer = policy.model.words.read(tiny.fast_answers(ids)["whole"])
    chunk = policy.model._action_tokenizer().decode_actions(answer, *policy.model.action_shape)
    commands = policy._denormalize({"action": chunk[None], "states": observation("pi05")["qpos"]})
    expected = golden["decoded_commands"][0].double().numpy()
    assert np.abs(commands - expected).max() < 1e-5 * np.abs(expected).max()
    assert np.abs(expected - golden["commands"][0].numpy()).max() > 0.5


def _question(seen):
    from fluxvla_core.policies.local import Query

    return Query(seen, tiny.SEED, 0)


def test_what_the_model_gets_is_what_it_gets_there(source, words, golden):
    read = LeRobotPi0FastFormat().read(source, str(words))
    prepare = PrivateInferenceDataset(read.img_keys, read.transforms, read.statistics)
    batch = prepare(observation("pi05"))
    assert torch.equal(batch["lang_tokens"], golden["tokens"])
    assert torch.equal(batch["lang_masks"], golden["token_masks"])
    normalize, write = (build_transform_from_cfg(read.transforms[i]) for i in (2, 5))
    sample = {
        "states": tiny.observation()[1],
        "actions": tiny.chunk()[0],
        "stats": read.statistics["private"],
    }
    sample = write(normalize(sample))
    np.testing.assert_allclose(
        sample["actions"], golden["normalized_actions"][0], rtol=1e-5, atol=2e-6
    )
    assert torch.equal(torch.from_numpy(sample["action_tokens"]), golden["action_tokens"][0])
    assert torch.equal(
        torch.from_numpy(sample["action_token_masks"]), golden["action_token_masks"][0]
    )


def test_a_file_with_the_head_only_is_tied(source, words):
    tensors = load_file(source / "model.safetensors")
    del tensors[LEROBOT.theirs("llm_backbone.embed_tokens.weight")]
    save_file(tensors, source / "model.safetensors", {"format": "pt"})
    read = LeRobotPi0FastFormat().read(source, str(words))
    assert read.model["tied_head"]
    head = tensors[LEROBOT.head]
    stored = read.tensors["llm_backbone.embed_tokens.weight"]
    assert torch.equal(stored[slice(None), slice(None)], head)


@pytest.mark.parametrize(("change", "words_of_error"), CHANGES)
def test_what_cannot_be_read_is_told(source, words, change, words_of_error):
    config = json.loads((source / "config.json").read_text())
    change(config)
    (source / "config.json").write_text(json.dumps(config))
    with pytest.raises(CheckpointError, match=words_of_error):
        LeRobotPi0FastFormat().read(source, str(words))


def test_another_family_or_tokenizer(source, words):
    assert LeRobotPi0FastFormat().recognizes(source)
    assert not LeRobotPiFormat().recognizes(source)
    assert not LeRobotPi0FastFormat().recognizes(words)
    with pytest.raises(CheckpointError, match=r"has no single token for <bos>, <eos> or \|"):
        LeRobotPi0FastFormat().read(source, str(GOLDEN / "fast"))
    with pytest.raises(ConfigError, match="does not exist"):
        LeRobotPi0FastFormat().read(source, str(source / "nowhere"))
