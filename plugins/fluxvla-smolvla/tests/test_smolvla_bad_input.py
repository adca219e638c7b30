"""Bad input from the command line: one message that says what, where and what to do."""

from __future__ import annotations

import math

import pytest
import torch
from safetensors.torch import load_file, save_file

from tests.policies.refused import change_json, import_refused

from .tiny import byte_tokenizer, lerobot_folder


@pytest.fixture
def source(tmp_path):
    return lerobot_folder(tmp_path / "theirs")


@pytest.fixture
def options(tmp_path):
    return ["--tokenizer", byte_tokenizer(tmp_path / "words")]


def test_a_setting_that_is_not_known(source, options, capsys):
    more = {"visual_memory_frames": 4, "scheduler_more": 1, "off": []}
    change_json(source / "config.json", lambda c: c.update(more))
    said = import_refused(source, options, capsys)
    assert "config.json: visual_memory_frames is '4', and no setting of that name" in said


def without(name, row):
    return None if name in ("observation.state.std", "action.std") else row


def without_action(name, row):
    return None if name.startswith("action.") else row


def no_number(name, row):
    return torch.full_like(row, math.nan) if name == "action.mean" else row


def shorter(name, row):
    return row[:-1].clone() if name == "observation.state.std" else row


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (without, "have no 'std'; they have mean"),
        (without_action, "there are statistics of observation.state, and none of action"),
        (no_number, "the statistics' 'mean' of 'action' has nan; finite numbers are expected"),
        (shorter, "the statistics of 'proprio' have 6 dimensions in 'mean', 5 in 'std'"),
    ],
)
def test_statistics_that_are_wrong(source, options, capsys, change, words):
    for file in source.glob("policy_*.safetensors"):
        rows = {name: change(name, row) for name, row in load_file(file).items()}
        save_file({name: row for name, row in rows.items() if row is not None}, file)
    said = import_refused(source, options, capsys)
    assert words in said
    assert said.startswith(str(source))
