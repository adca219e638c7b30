"""Bad input from the command line: one message that says what, where and what to do."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
import torch
from fluxvla_gr00t import robots

from fluxvla_core.errors import ConfigError
from tests.policies.refused import (
    change_json,
    change_rows,
    checked_with_transformers,
    drop,
    import_refused,
    shorten,
    spoil,
    widen,
)

from . import published
from .gr00t_sizes import tiny

STATISTICS = {"n1.5": "experiment_cfg/metadata.json", "n1.7": "statistics.json"}
USED = {"n1.5": "max", "n1.7": "q99"}


@pytest.fixture
def bring(tmp_path, monkeypatch):
    """A published folder, and what to import it with."""
    monkeypatch.setitem(robots.N15_EMBODIMENTS, "new_embodiment", 2)

    def make(version):
        source = published.folder(version, tmp_path / "theirs", monkeypatch)
        words = published.tokenizer(version, tmp_path / "words")
        arm = tmp_path / "arm.json"
        arm.write_text(json.dumps(published.robot(published.SIDES[version]).to_dict()))
        return source, ["--tokenizer", words, "--embodiment", arm, "--rate", "20"]

    return make


@pytest.mark.parametrize("version", ["n1.5", "n1.7"])
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (drop("max", "q99"), "not all groups have '{used}'"),
        (spoil(float("nan")), "has nan; finite numbers are expected"),
        (spoil("a"), "not numbers"),
        (shorten("max", "q99"), "not statistics of one shape"),
        (widen, "the statistics of 'action' have 7 dimensions, action_dim of the model is 5"),
    ],
)
def test_statistics_that_are_wrong(bring, capsys, version, change, words):
    source, options = bring(version)
    change_rows(source / STATISTICS[version], change)
    assert words.format(used=USED[version]) in import_refused(source, options, capsys)


@pytest.mark.parametrize(
    ("version", "place"),
    [
        ("n1.5", ()),
        ("n1.5", ("action_head_cfg",)),
        ("n1.5", ("action_head_cfg", "diffusion_model_cfg")),
        ("n1.5", ("backbone_cfg",)),
        ("n1.7", ()),
        ("n1.7", ("vl_self_attention_cfg",)),
    ],
)
def test_a_setting_that_is_not_known(bring, capsys, version, place):
    source, options = bring(version)

    def add(config):
        for name in place:
            config = config[name]
        config |= {"logit_softcap": 30.0, "tune_more": True, "off": False}

    change_json(source / "config.json", add)
    said = import_refused(source, options, capsys)
    assert "config.json: logit_softcap is '30.0', and no setting of that name is known" in said


def test_weights_of_the_other_version(bring, capsys, tmp_path, monkeypatch):
    source, options = bring("n1.5")
    other = published.folder("n1.7", tmp_path / "other", monkeypatch)
    (other / "model.safetensors").replace(source / "model.safetensors")
    said = import_refused(source, options, capsys)
    assert "missing: action_head.future_tokens.weight" in said


@pytest.mark.parametrize("version", ["n1.5", "n1.7"])
def test_lerobots_statistics_of_half_a_robot(bring, capsys, tmp_path, monkeypatch, version):
    from safetensors.torch import load_file, save_file

    _, options = bring(version)
    source = published.lerobot_folder(version, tmp_path / "lerobot", monkeypatch)
    (file,) = source.glob("policy_*.safetensors")
    save_file({n: t for n, t in load_file(file).items() if not n.startswith("action.")}, file)
    said = import_refused(source, options, capsys)
    assert "there are statistics of observation.state, and none of action" in said


@pytest.mark.parametrize("name", ["gr00t_n15_aloha", "gr00t_n17_libero"])
def test_another_version_of_transformers(tmp_path, name):
    config = Path(__file__).parents[3] / "configs" / f"{name}.py"
    said = checked_with_transformers("4.40.0", config, tmp_path)
    assert re.search(r"gr00t_\w+\.py:\d+: model\.type: fluxvla-gr00t", said)
    assert "needs transformers>=5.5,<6, but 4.40.0 is installed" in said
    assert "pip install 'transformers>=5.5,<6'" in said


@pytest.mark.parametrize("version", ["n1.5", "n1.7"])
def test_states_and_actions_of_another_width(version):
    head = tiny(version).vla_head
    ids = torch.zeros(1, dtype=torch.int64)
    states, width = torch.zeros(1, head.state_dim + 1), head.state_dim
    with pytest.raises(ConfigError, match=f"states have {width + 1} numbers, state_dim is {width}"):
        head.encode_states(states, ids)
    chunk = torch.zeros(1, head.horizon, head.action_dim - 1)
    with pytest.raises(ConfigError, match="the model's chunks"):
        head.errors(None, states, ids, chunk, chunk[:, None], torch.zeros(1, 1))
