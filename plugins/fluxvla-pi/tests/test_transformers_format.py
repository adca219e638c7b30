"""PI0 as transformers saves it: its weights are read, to be trained on."""

from __future__ import annotations

import json

import pytest
import torch
from fluxvla_pi.lerobot_format import LeRobotPiFormat
from fluxvla_pi.names import OPENPI, TRANSFORMERS
from fluxvla_pi.openpi_format import OpenPiFormat
from fluxvla_pi.pi0 import PI0FlowMatching
from fluxvla_pi.transformers_format import TransformersPi0Format
from safetensors.torch import load_file, save_file

from fluxvla_core.cli.main import main
from fluxvla_core.errors import CheckpointError
from fluxvla_core.training.weights import load_initial_weights

from .oracles import pi_inputs
from .published_folders import weights
from .test_parity_transformers import their_config

pytest.importorskip("transformers.models.pi0", reason="transformers >= 5.20 has PI0")


@pytest.fixture
def saved(tmp_path):
    """Their tiny model, and the folder that transformers saves of it."""
    from transformers import PI0ForConditionalGeneration

    torch.manual_seed(0)
    model = PI0ForConditionalGeneration(their_config())
    model.save_pretrained(tmp_path / "theirs")
    return model, tmp_path / "theirs"


def test_every_weight_comes_as_it_is(saved, tmp_path, capsys):
    model, source = saved
    assert main(["import-checkpoint", str(source), str(tmp_path / "ours")]) == 0
    told = capsys.readouterr().out
    assert "PI0FlowMatching, " in told
    assert "it can be trained on, and drives no robot" in told
    ours, theirs = load_file(tmp_path / "ours" / "model.safetensors"), model.state_dict()
    assert len(ours) == len(theirs) - sum(name in theirs for name in TRANSFORMERS.unused)
    for name, tensor in ours.items():
        assert torch.equal(tensor, theirs[TRANSFORMERS.theirs(name)]), name


def test_names_of_the_model_itself_are_read_too(saved, tmp_path):
    """Whatever saves a ``state_dict`` by itself has them."""
    model, source = saved
    save_file(model.state_dict(), source / "model.safetensors", {"format": "pt"})
    read = TransformersPi0Format().read(source)
    assert read.tensors["projector.weight"].shape == (32, 32)


def test_weights_of_another_project_are_refused(saved, tmp_path):
    _, source = saved
    save_file(weights("pi0", OPENPI), source / "model.safetensors", {"format": "pt"})
    with pytest.raises(CheckpointError, match="the weights are not under transformers' names"):
        TransformersPi0Format().read(source)


def test_a_training_starts_from_it(saved):
    model, source = saved
    read = TransformersPi0Format().read(source)
    assert (read.horizon, read.model["num_steps"]) == (pi_inputs.HORIZON, 10)
    ours = PI0FlowMatching(**{k: v for k, v in read.model.items() if k != "type"})
    load_initial_weights(ours, source)
    expert = model.state_dict()["model.dit.layers.1.mlp.up_proj.weight"]
    assert torch.equal(ours.state_dict()["llm_expert.layers.1.mlp.up_proj.weight"], expert)


def test_parts_of_a_large_model_are_read_too(saved, tmp_path):
    model, _ = saved
    model.save_pretrained(tmp_path / "parts", max_shard_size="40KB")
    assert (tmp_path / "parts" / "model.safetensors.index.json").is_file()
    read = TransformersPi0Format().read(tmp_path / "parts")
    assert set(read.tensors) == set(TransformersPi0Format().read(saved[1]).tensors)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"min_period": 1.0}, r"min_period is 1\.0; 0\.004 is built here"),
        ({"dit_config": {"num_key_value_heads": 2}}, r"dit_config\.num_key_value_heads is 2; 1 is"),
        ({"chunk_size": "long"}, "chunk_size is 'long', not a number from 1"),
    ],
)
def test_what_is_not_built_here_is_refused(saved, change, words):
    _, source = saved
    config = json.loads((source / "config.json").read_text())
    (source / "config.json").write_text(json.dumps({**config, **change}))
    with pytest.raises(CheckpointError, match=words):
        TransformersPi0Format().read(source)


def test_other_tensors_are_refused_by_name(saved):
    _, source = saved
    tensors = load_file(source / "model.safetensors")
    tensors["more"] = tensors.pop("action_out_proj.bias")
    save_file(tensors, source / "model.safetensors", {"format": "pt"})
    with pytest.raises(CheckpointError, match=r"1 missing \(action_out_proj\.bias\), 1 of no use"):
        TransformersPi0Format().read(source)


def test_it_is_told_from_the_others(saved, tmp_path):
    _, source = saved
    assert TransformersPi0Format().recognizes(source)
    assert not LeRobotPiFormat().recognizes(source)
    assert not OpenPiFormat().recognizes(source)
    for content in ('{"type": "pi0", "model_type": "pi0"}', '{"model_type": "pi05"}', "["):
        (tmp_path / "config.json").write_text(content)
        assert not TransformersPi0Format().recognizes(tmp_path)
    assert not TransformersPi0Format().recognizes(tmp_path / "nowhere")
