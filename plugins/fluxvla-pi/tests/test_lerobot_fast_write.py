"""``fluxvla export --format lerobot`` of PI0-FAST: it goes back as it came, and acts there.

``tests/written/pi0_fast`` is what is written, without the weights;
``oracles/make_lerobot061_fast_written.py`` loads that in LeRobot and records what follows there.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from fluxvla_models.lerobot_files import full_tensor
from fluxvla_pi import lerobot_fast_write
from fluxvla_pi.action_tokens import ActionWords
from fluxvla_pi.lerobot_fast_format import LeRobotPi0FastFormat
from fluxvla_pi.names import LEROBOT
from safetensors.torch import load_file

from fluxvla_core.cli.main import main
from fluxvla_core.errors import CheckpointError
from fluxvla_core.models import load_policy

from .oracles import pi_inputs as tiny
from .published_folders import GOLDEN, fast_folder, fast_words_folder, observation, robot_file

WRITTEN = Path(__file__).parent / "written" / "pi0_fast"
PROCESSORS = ("policy_preprocessor", "policy_postprocessor")


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """LeRobot's sizes and words are the tiny ones."""
    sizes = {"variant": "variant", "vision_variant": "vision_variant", "vocab_size": "vocab_size"}
    sizes = {key: tiny.FAST_SIZES[name] for key, name in sizes.items()}
    monkeypatch.setattr(lerobot_fast_write, "SIZES", sizes)
    monkeypatch.setattr(lerobot_fast_write, "WORDS", ActionWords.of(tiny.ACTION_WORDS, "test"))


@pytest.fixture
def source(tmp_path):
    return fast_folder(tmp_path / "theirs")


@pytest.fixture
def words(tmp_path):
    return fast_words_folder(tmp_path / "words")


@pytest.fixture
def bring(tmp_path, words):
    """Import a folder for the robot."""
    robot = robot_file(tmp_path / "robot.json")

    def run(folder, name):
        told = ["--tokenizer", str(words), "--embodiment", str(robot), "--rate", "10"]
        assert main(["import-checkpoint", str(folder), str(tmp_path / name), *told]) == 0
        return tmp_path / name

    return run


@pytest.fixture
def back(tmp_path, source, bring):
    """What is written of an import of ``source``."""
    out = bring(source, "ours")
    assert main(["export", str(out), str(tmp_path / "back"), "--format", "lerobot"]) == 0
    return tmp_path / "back"


def test_every_tensor_comes_back_bit_for_bit(source, back):
    ours, theirs = (load_file(f / "model.safetensors") for f in (back, source))
    assert ours.keys() == theirs.keys()
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)
    embedding = LEROBOT.theirs("llm_backbone.embed_tokens.weight")
    assert not torch.equal(ours[LEROBOT.head], ours[embedding])  # LeRobot's are not tied


def test_config_processors_and_tokenizer_come_back(source, back):
    config, written = (read(f / "config.json") for f in (source, back))
    assert written.pop("action_tokenizer_name") == "fast-action-tokenizer"
    assert {key: config[key] for key in written} == written
    for name in PROCESSORS:
        before, after = (read(f / f"{name}.json") for f in (source, back))
        named = [s["config"] for s in after["steps"] if "action_tok" in s["registry_name"]]
        for step in named:
            assert step["action_tokenizer_name"] == "fast-action-tokenizer"
            step["action_tokenizer_name"] = "lerobot/fast-action-tokenizer"
        assert after == before
    for file in source.glob("policy_*.safetensors"):
        one, other = load_file(file), load_file(back / file.name)
        assert one.keys() == other.keys()
        assert all(torch.equal(one[key], other[key]) for key in one)
    for name in ("tokenizer.json", "processor_config.json"):
        theirs = (GOLDEN / "fast" / name).read_bytes()
        assert (back / "fast-action-tokenizer" / name).read_bytes() == theirs


def test_it_is_what_lerobot_was_given(back):
    """LeRobot's side was computed with these files: if they change, so does that, by nox."""
    files = {f.relative_to(back) for f in back.rglob("*") if f.is_file()}
    files -= {Path("model.safetensors")}
    assert files == {f.relative_to(WRITTEN) for f in WRITTEN.rglob("*") if f.is_file()}
    for name in files:
        assert (back / name).read_bytes() == (WRITTEN / name).read_bytes(), name


def test_it_acts_there_as_here_and_comes_again(tmp_path, source, back, bring):
    there = load_file(GOLDEN / "lerobot061_pi0_fast_written.safetensors")
    first = load_file(GOLDEN / "lerobot061_pi0_fast_policy.safetensors")
    assert torch.equal(there["answer"], first["answer"])
    assert torch.equal(there["commands"], first["commands"])
    assert torch.equal(there["action_tokens"], first["action_tokens"])
    policy = load_policy(bring(back, "again"))
    policy.reset(tiny.SEED)
    found, expected = policy.predict_action(observation("pi05")), there["commands"][0].double()
    assert np.abs(found - expected.numpy()).max() < 1e-5 * expected.abs().max().item()


def test_a_tied_head_is_written_under_both_names(tmp_path, source, words):
    read_ = LeRobotPi0FastFormat().read(source, str(words))
    tensors = {name: t for name, t in read_.tensors.items() if name != "lm_head.weight"}
    tied = replace(read_, model={**read_.model, "tied_head": True}, tensors=tensors)
    (tmp_path / "out").mkdir()
    LeRobotPi0FastFormat().write(tied, tmp_path / "out")
    found = load_file(tmp_path / "out" / "model.safetensors")
    embedding = LEROBOT.theirs("llm_backbone.embed_tokens.weight")
    assert torch.equal(found[LEROBOT.head], found[embedding])


@pytest.mark.parametrize("narrow", [True, False])
def test_weights_keep_their_dtype_and_the_config_says_it(tmp_path, source, words, narrow):
    """As LeRobot in bf16, where normalisations stay in float32."""
    read_ = LeRobotPi0FastFormat().read(source, str(words))
    tensors = {
        name: full_tensor(t).bfloat16() if narrow and "norm" not in name else full_tensor(t)
        for name, t in read_.tensors.items()
    }
    (tmp_path / "out").mkdir()
    LeRobotPi0FastFormat().write(replace(read_, tensors=tensors), tmp_path / "out")
    dtype = "bfloat16" if narrow else "float32"
    assert read(tmp_path / "out" / "config.json")["dtype"] == dtype
    found = load_file(tmp_path / "out" / "model.safetensors")
    assert {str(t.dtype) for t in found.values()} == {"torch.float32", f"torch.{dtype}"}


def test_the_published_tokenizer_keeps_its_name(tmp_path, source, words):
    settings = read(source / "fast-action-tokenizer" / "processor_config.json")
    published = {**settings, **lerobot_fast_write.PUBLISHED}
    file = source / "fast-action-tokenizer" / "processor_config.json"
    file.write_text(json.dumps(published))
    (tmp_path / "out").mkdir()
    LeRobotPi0FastFormat().write(LeRobotPi0FastFormat().read(source, str(words)), tmp_path / "out")
    written = read(tmp_path / "out" / "config.json")
    assert written["action_tokenizer_name"] == "lerobot/fast-action-tokenizer"


@pytest.mark.parametrize(
    ("change", "words_of_error"),
    [
        ({"strict_decoding": True}, "strict_decoding is True; the format implies False"),
        ({"bos_in_prompt": False}, "bos_in_prompt is False; the format implies True"),
        ({"variant": "gemma_9b"}, "LeRobot's PI0-FAST has the sizes"),
        ({"words": {**tiny.ACTION_WORDS, "stop": 9}}, "writes actions with PaliGemma's words"),
    ],
)
def test_what_lerobot_cannot_say(tmp_path, source, words, change, words_of_error):
    read_ = LeRobotPi0FastFormat().read(source, str(words))
    with pytest.raises(CheckpointError, match=words_of_error):
        LeRobotPi0FastFormat().write(replace(read_, model={**read_.model, **change}), tmp_path)


def test_other_transforms_are_refused(tmp_path, source, words):
    read_ = LeRobotPi0FastFormat().read(source, str(words))
    changed = [
        {**table, "ending": "Action: "} if "ending" in table else table
        for table in read_.transforms
    ]
    with pytest.raises(CheckpointError, match="ending is 'Action: '; the format implies ''"):
        LeRobotPi0FastFormat().write(replace(read_, transforms=changed), tmp_path)
    fewer = [table for table in read_.transforms if table["type"] != "ProcessActionTokens"]
    with pytest.raises(CheckpointError, match="there is no ProcessActionTokens"):
        LeRobotPi0FastFormat().write(replace(read_, transforms=fewer), tmp_path)


def read(file):
    return json.loads(file.read_text())
