"""Bad input from the command line: one message that says what, where and what to do."""

from __future__ import annotations

import json
import math

import pytest
import torch
from safetensors.torch import load_file, save_file

from fluxvla_core.errors import ConfigError
from tests.policies.refused import change_json, change_rows, import_refused, spoil

from .oracles import pi_inputs
from .published_folders import (
    fast_folder,
    fast_words_folder,
    lerobot_folder,
    openpi_folder,
    robot_file,
    tokenizer_folder,
)
from .tiny import fast_model, model_of

SAVED = {
    "pi0": lambda folder: lerobot_folder(folder, "pi0"),
    "pi05": lambda folder: lerobot_folder(folder, "pi05"),
    "pi0_fast": fast_folder,
    "openpi": lambda folder: openpi_folder(folder, "pi05"),
}
LEROBOT = ("pi0", "pi05", "pi0_fast")


@pytest.fixture
def bring(tmp_path):
    """A published folder, and what to import it with."""

    def make(kind):
        fast = kind == "pi0_fast"
        words = (fast_words_folder if fast else tokenizer_folder)(tmp_path / "words")
        robot = robot_file(tmp_path / "robot.json")
        options = ["--tokenizer", words, "--embodiment", robot, "--rate", "10"]
        return SAVED[kind](tmp_path / "theirs"), options

    return make


@pytest.mark.parametrize("kind", SAVED)
def test_a_setting_that_is_not_known(bring, capsys, kind):
    source, options = bring(kind)
    more = {"use_visual_memory": True, "optimizer_more": 1, "off": False}
    change_json(source / "config.json", lambda c: c.update(more))
    said = import_refused(source, options, capsys)
    if kind == "openpi":
        assert "no setting of that name is known" in said
    else:
        assert "config.json: use_visual_memory is 'True', and no setting of that name" in said


@pytest.mark.parametrize(
    ("change", "words"),
    [({"adapt_to_pi_aloha": True}, "adapt_to_pi_aloha is True; False is read")]
    + [({"num_steps": 4}, "num_steps is 4; 10 is read")],
)
def test_settings_of_before_lerobot_04(bring, capsys, change, words):
    source, options = bring("pi0")
    change_json(source / "config.json", lambda c: c.update(change))
    assert words in import_refused(source, options, capsys)


@pytest.mark.parametrize("kind", LEROBOT)
@pytest.mark.parametrize("number", [math.nan, math.inf])
def test_statistics_that_are_no_numbers(bring, capsys, kind, number):
    source, options = bring(kind)
    for file in source.glob("policy_*.safetensors"):
        rows = load_file(file)
        save_file({n: spoiled(n, row, number) for n, row in rows.items()}, file)
    said = import_refused(source, options, capsys)
    assert f"[{number}, " in said
    assert "finite numbers are expected" in said


def spoiled(name, row, number):
    if not name.startswith(("observation.state.", "action.")) or row.ndim != 1:
        return row
    return torch.cat([torch.full((1,), number), row[1:].float()])


@pytest.mark.parametrize("kind", LEROBOT)
def test_statistics_of_the_state_alone(bring, capsys, kind):
    source, options = bring(kind)
    for file in source.glob("policy_*.safetensors"):
        rows = load_file(file)
        save_file({n: row for n, row in rows.items() if not n.startswith("action.")}, file)
    said = import_refused(source, options, capsys)
    assert "there are statistics of observation.state, and none of action" in said


@pytest.mark.parametrize(
    ("value", "words"),
    [(math.nan, "has nan; finite numbers"), ("a", "mean, std, q01, q99 are not rows of numbers")],
)
def test_openpis_statistics_that_are_no_numbers(bring, capsys, value, words):
    source, options = bring("openpi")
    change_rows(source / "assets" / "acme" / "arm" / "norm_stats.json", spoil(value))
    names = ("base_0_rgb=front", "left_wrist_0_rgb=wrist", "right_wrist_0_rgb=none")
    options += [word for name in names for word in ("--camera", name)]
    assert words in import_refused(source, options, capsys)


def test_a_tokenizer_that_is_not_named(bring, capsys):
    source, _ = bring("pi05")
    said = import_refused(source, [], capsys)
    assert "model_path 'google/paligemma-3b-pt-224' does not exist" in said
    assert "next: --tokenizer DIR" in said


def test_a_tokenizer_that_is_damaged(bring, capsys):
    source, options = bring("pi05")
    (options[1] / "tokenizer.json").write_text("{")
    said = import_refused(source, options, capsys)
    assert "no tokenizer can be read from" in said
    assert "next: copy or download it again" in said


def test_a_prompt_beyond_the_budget(bring, capsys):
    """Its state in words takes most of it: no answer could ever be given."""
    source, options = bring("pi05")

    def shorten(content):
        step = next(s for s in content["steps"] if s["registry_name"] == "tokenizer_processor")
        step["config"]["max_length"] = 7

    change_json(source / "policy_preprocessor.json", shorten)
    said = import_refused(source, options, capsys)
    assert "ProcessPrompts: the instruction 'Task: go, State:" in said
    assert "tokens, max_len is 7" in said


def test_states_of_another_width():
    model = model_of("pi0")
    states = torch.zeros(1, model.max_state_dim + 1)
    with pytest.raises(ConfigError, match=rf"{states.shape[1]} numbers, max_state_dim is \d"):
        model.state_tokens(states)


def test_actions_of_another_shape_than_action_tokens_are_read_as():
    model = fast_model()
    horizon, dim = model.action_shape
    with pytest.raises(ConfigError, match=r"PI0FAST: actions are .* the model's chunks"):
        model(*[torch.zeros(1)] * 5, actions=torch.zeros(1, horizon, dim + 1))


def test_lerobots_config_names_the_robot_s_widths(bring, capsys):
    source, options = bring("pi0")
    arm = json.loads(options[3].read_text())
    arm["joints"].pop()
    options[3].write_text(json.dumps(arm))
    said = import_refused(source, options, capsys)
    joints = pi_inputs.ROBOT_ACTIONS
    assert f"statistics of 'action' have {joints} dimensions, arm has {joints - 1}" in said
