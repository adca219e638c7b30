"""Weights in checkpoints: averaged ones, left-out ones, other models' ones."""

from __future__ import annotations

import json
import os

import pytest
import torch
from torch import nn

from fluxvla_core.checkpoints.checkpoint import Checkpoint
from fluxvla_core.checkpoints.tensors import TensorFile
from fluxvla_core.checkpoints.writer import CheckpointWriter
from fluxvla_core.errors import CheckpointError
from fluxvla_core.testing.training import run_ranks, tiny_config, train
from fluxvla_core.training.state import Ema
from fluxvla_core.training.weights import (
    check_model_tensors,
    external_weights,
    load_for_inference,
    load_full_tensors,
    weights_by_name,
)
from tests.training.runs import run


class Encoder(nn.Module):
    frozen_source = "package:words 1.0"

    def __init__(self, seed):
        super().__init__()
        torch.manual_seed(seed)
        self.words = nn.Linear(3, 4).requires_grad_(False)
        self.adapter = nn.Linear(4, 4)


class Model(nn.Module):
    def __init__(self, seed=0, words=0):
        super().__init__()
        self.encoder = Encoder(words)
        torch.manual_seed(seed)
        self.head = nn.Linear(4, 2)
        self.frozen = nn.Linear(2, 2).requires_grad_(False)
        self.register_buffer("scale", torch.ones(2))


def checkpoint(tmp_path, model, without, ema=None):
    with CheckpointWriter(tmp_path, 1, 0) as writer:
        tensors = weights_by_name(model, without.names)
        TensorFile.full("model.safetensors", tensors, True).write(writer)
        if ema is not None:
            TensorFile.full("ema.safetensors", ema.shadow, True).write(writer)
        writer.write_json("trainer.json", {"left_out": without.to_dict()})
        return Checkpoint.open(writer.commit())


def equal(a, b):
    a, b = a.state_dict(), b.state_dict()
    return {name for name in a if not torch.equal(a[name], b[name])}


def test_only_frozen_weights_with_a_source_are_left_out(tmp_path):
    found = external_weights(Model())
    assert found.names == {"encoder.words.weight", "encoder.words.bias"}
    assert found.sources == {"encoder": "package:words 1.0"}
    saved = checkpoint(tmp_path, Model(), found).tensors("model.safetensors")
    assert set(saved) == {
        "encoder.adapter.weight",
        "encoder.adapter.bias",
        "head.weight",
        "head.bias",
        "frozen.weight",
        "frozen.bias",
        "scale",
    }


def test_loading_gives_the_model_back(tmp_path):
    model = Model(seed=1)
    other = Model(seed=2)
    load_for_inference(other, checkpoint(tmp_path, model, external_weights(model)))
    assert equal(model, other) == set()


def test_everything_can_be_saved_too(tmp_path):
    model = Model(seed=1, words=1)
    other = Model(seed=2, words=2)
    load_for_inference(other, checkpoint(tmp_path, model, type(external_weights(model))()))
    assert equal(model, other) == set()


def test_frozen_weights_of_another_version_are_refused(tmp_path):
    model = Model(words=1)
    saved = checkpoint(tmp_path, model, external_weights(model))
    with pytest.raises(CheckpointError) as caught:
        load_for_inference(Model(words=2), saved)
    assert str(caught.value) == (
        f"{saved.path}/model.safetensors: frozen weights differ from those that the checkpoint was "
        "trained with (encoder from package:words 1.0)\n"
        "  likely cause: another version of the package or file that they come from is installed\n"
        "  next: environment.json in the checkpoint's folder has the versions that made it"
    )


def test_weights_of_another_model_are_refused():
    """T3 of upstream's bugs: a wrong checkpoint resumed silently."""
    model = Model()
    tensors = {**weights_by_name(model), "head.weight": torch.zeros(9, 4)}
    del tensors["scale"]
    with pytest.raises(
        CheckpointError, match=r"1 missing in the checkpoint: scale\n.*head\.weight"
    ):
        check_model_tensors(model, tensors, external_weights(model), {}, "here")


def test_state_that_is_no_tensor_is_refused():
    class Odd(nn.Linear):
        def get_extra_state(self):
            return {"a": 1}

        def set_extra_state(self, state):
            return

    with pytest.raises(CheckpointError, match="holds other than tensors: _extra_state"):
        weights_by_name(Odd(1, 1))


def test_averages_follow_the_weights_and_act_in_their_place(tmp_path):
    model = Model(seed=1)
    parameters = {n: p for n, p in model.named_parameters() if p.requires_grad}
    ema = Ema(parameters, 0.5)
    before = {n: p.detach().clone() for n, p in parameters.items()}
    with torch.no_grad():
        for p in parameters.values():
            p.add_(1.0)
    ema.update(1)  # decay min(0.5, 2/11)
    assert torch.allclose(ema.shadow["head.bias"], before["head.bias"] + 9 / 11)
    with torch.no_grad():
        for p in parameters.values():
            p.add_(1.0)
    ema.update(100)  # decay 0.5
    assert torch.allclose(ema.shadow["head.bias"], before["head.bias"] + (9 / 11 + 2) / 2)
    saved = checkpoint(tmp_path, model, external_weights(model), ema)
    acting = Model(seed=2)
    load_for_inference(acting, saved)
    assert torch.equal(acting.head.bias, ema.shadow["head.bias"])
    assert torch.equal(acting.frozen.bias, model.frozen.bias)
    restored = Ema(dict(Model(seed=3).named_parameters()) and parameters, 0.5)
    restored.load(saved.tensors("ema.safetensors"), "here")
    assert all(torch.equal(restored.shadow[n], t) for n, t in ema.shadow.items())


def test_averages_of_another_model_are_refused():
    ema = Ema(dict(Model().head.named_parameters()), 0.9)
    with pytest.raises(CheckpointError, match="the averaged weights of the checkpoint are not"):
        ema.load({"weight": torch.zeros(2, 4)}, "here")


def test_loading_leaves_the_checkpoint_as_it_is(tmp_path):
    model = Model()
    saved = checkpoint(tmp_path, model, external_weights(model))
    load_full_tensors(model, saved.tensors("model.safetensors"))
    with torch.no_grad():
        for tensor in model.state_dict().values():
            tensor.add_(1)
    saved.verify()


def test_aliases_header_is_plain_json(tmp_path):
    saved = checkpoint(tmp_path, Model(), external_weights(Model()))
    data = (saved.path / "model.safetensors").read_bytes()
    header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
    assert header["__metadata__"] == {"format": "pt", "aliases": "{}"}


class Tied(nn.Module):
    """Words that go in and come out by the same weights."""

    def __init__(self, seed=0):
        super().__init__()
        torch.manual_seed(seed)
        self.embed = nn.Linear(4, 4, bias=False)
        self.head = nn.Linear(4, 4, bias=False)
        self.head.weight = self.embed.weight


def test_averages_of_tied_weights_act_under_both_names(tmp_path):
    """The averages have their first name only; under the second stood what was not averaged."""
    model = Tied()
    ema = Ema(dict(model.named_parameters()), 0.5)
    with torch.no_grad():
        model.embed.weight.add_(1.0)
    ema.update(1)
    acts = Tied(seed=1)
    load_for_inference(acts, checkpoint(tmp_path, model, external_weights(model), ema))
    assert acts.head.weight is acts.embed.weight
    assert torch.equal(acts.head.weight, ema.shadow["embed.weight"])
    assert not torch.equal(acts.head.weight, model.head.weight)


def begin_from(work_dir, base):
    """Leaves word if the second rank looks for the newest checkpoint itself."""
    opened = Checkpoint.open

    def open_later(place):
        if place == base:
            (work_dir / "looked").touch()
        return opened(place)

    if os.environ["RANK"] == "1":
        Checkpoint.open = staticmethod(open_later)
    table = {"type": "FSDPTrainRunner", "max_steps": 1, "init_from": str(base)}
    train({"config": tiny_config(table, 2), "work_dir": work_dir})


def test_all_ranks_begin_from_the_checkpoint_that_the_first_one_found(tmp_path):
    """A run that goes on saves in between: half the weights would be of another step."""
    run(tmp_path / "base", save_iter_interval=2)
    work_dir = tmp_path / "work"
    assert run_ranks(2, begin_from, work_dir, (tmp_path / "base").resolve()) == [0, 0]
    assert not (work_dir / "looked").exists()
