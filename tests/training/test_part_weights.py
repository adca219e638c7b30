"""Parts of a model that start from published weights, under the names that they have there."""

from __future__ import annotations

import json

import pytest
import torch
from safetensors.torch import save_file

from fluxvla_core.build import RunContext, build_runner_from_cfg
from fluxvla_core.errors import CheckpointError
from fluxvla_core.models import PartWeights
from fluxvla_core.plugins.registry import VLAS
from fluxvla_core.testing.training import TinyDataset, tiny_config
from fluxvla_core.training.part_weights import load_part_weights, tensors_at

NAMES = {"tower.": "vision.model."}


class TwoParts(torch.nn.Module):
    """A tower from somewhere else, whose first weight has two names, and a head."""

    action_shape = (4, 2)

    def __init__(self, place: str | None = None, unread=()):
        super().__init__()
        self.tower = torch.nn.Sequential(torch.nn.Linear(2, 3), torch.nn.Linear(3, 2))
        self.head = torch.nn.Linear(2, 2)
        self.tower.again = torch.nn.Linear(2, 3, bias=False)
        self.tower.again.weight = self.tower[0].weight
        self.part_weights = () if place is None else (PartWeights(place, NAMES, unread),)

    def forward(self, x, y):
        return {"loss": (self.head(self.tower[1](self.tower[0](x))) - y).square().mean()}


def weights():
    torch.manual_seed(0)
    shapes = {"0.weight": (3, 2), "0.bias": (3,), "1.weight": (2, 3), "1.bias": (2,)}
    return {f"vision.model.{name}": torch.randn(shape) for name, shape in shapes.items()}


def saved(place, tensors=None):
    """The weights as a file of its kind, or as a folder."""
    tensors = weights() if tensors is None else tensors
    if place.suffix == ".safetensors":
        save_file(tensors, place)
    elif place.suffix == ".pth":
        torch.save(tensors, place, _use_new_zipfile_serialization=False)
    elif place.suffix == ".pt":
        torch.save({"model": tensors, "epoch": 3}, place)
    else:
        place.mkdir()
        names = sorted(tensors)
        for part, some in (("a", names[:2]), ("b", names[2:])):
            save_file({name: tensors[name] for name in some}, place / f"{part}.safetensors")
        if place.name == "indexed":
            listed = {name: f"{'ab'[place_ > 1]}.safetensors" for place_, name in enumerate(names)}
            (place / "model.safetensors.index.json").write_text(json.dumps({"weight_map": listed}))
    return str(place)


@pytest.mark.parametrize(
    "name", ["tower.safetensors", "tower.pt", "tower.pth", "folder", "indexed"]
)
def test_a_part_gets_its_weights_and_the_rest_stays(tmp_path, name):
    model = TwoParts()
    before = model.head.weight.detach().clone()

    load_part_weights(model, [PartWeights(saved(tmp_path / name), NAMES)])

    for own, theirs in ((model.tower[i], f"vision.model.{i}") for i in (0, 1)):
        assert torch.equal(own.weight, weights()[f"{theirs}.weight"])
        assert torch.equal(own.bias, weights()[f"{theirs}.bias"])
    assert model.tower.again.weight is model.tower[0].weight
    assert torch.equal(model.head.weight, before)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"vision.model.1.bias": None}, "1 missing: vision.model.1.bias"),
        ({"vision.head.weight": torch.zeros(2)}, "1 left over: vision.head.weight"),
        (
            {"vision.model.1.weight": torch.zeros(5, 3)},
            r"1 of another size: vision.model.1.weight: \(5, 3\) there, \(2, 3\) here",
        ),
    ],
)
def test_what_does_not_correspond_is_listed(tmp_path, change, words):
    tensors = {n: t for n, t in {**weights(), **change}.items() if t is not None}
    place = saved(tmp_path / "tower.safetensors", tensors)
    model = TwoParts()
    before = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    with pytest.raises(CheckpointError, match=words) as caught:
        load_part_weights(model, [PartWeights(place, NAMES)])
    assert "'tower.' is 'vision.model.' there" in str(caught.value)
    assert all(torch.equal(t, before[n]) for n, t in model.state_dict().items())


def test_what_nothing_reads_may_be_named(tmp_path):
    tensors = {**weights(), "vision.head.weight": torch.zeros(2)}
    place = saved(tmp_path / "tower.safetensors", tensors)
    load_part_weights(TwoParts(), [PartWeights(place, NAMES, ("vision.head.",))])


def test_the_longest_of_several_names_counts(tmp_path):
    tensors = weights()
    moved = {n.replace("vision.model.1.", "last."): t for n, t in tensors.items()}
    place = saved(tmp_path / "tower.safetensors", moved)
    model = TwoParts()
    load_part_weights(model, [PartWeights(place, {**NAMES, "tower.1.": "last."})])
    assert torch.equal(model.tower[1].weight, tensors["vision.model.1.weight"])


def test_a_part_that_the_model_does_not_have(tmp_path):
    place = saved(tmp_path / "tower.safetensors")
    with pytest.raises(
        CheckpointError, match=r"no weight of the model has 'towel\.' in its"
    ) as caught:
        load_part_weights(TwoParts(), [PartWeights(place, {"towel.": "vision.model."})])
    assert "the model's parts are tower, head" in str(caught.value)


class Trap:
    """What a file of pickled objects could run."""

    def __reduce__(self):
        return (print, ("run",))


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("gone.safetensors", None, "there are no weights at"),
        ("x.txt", b"", "weights are read from files that end in .safetensors, .pt, .pth, .bin"),
        ("x.safetensors", b"no", "x.safetensors cannot be read"),
        ("x.pt", b"no", "it cannot be read as tensors"),
        ("x.pth", Trap(), "it cannot be read as tensors"),
        ("x.bin", [torch.zeros(1)], "it holds no table of tensors"),
        ("folder", None, "there is no safetensors file"),
    ],
)
def test_places_without_weights(tmp_path, capsys, name, content, words):
    place = tmp_path / name
    if name == "folder":
        place.mkdir()
    elif isinstance(content, bytes):
        place.write_bytes(content)
    elif content is not None:
        torch.save(content, place)
    with pytest.raises(CheckpointError, match=words):
        tensors_at(place)
    assert "run" not in capsys.readouterr().out


def test_a_training_starts_from_them_and_resumes_without(tmp_path):
    VLAS.register_module()(TwoParts)
    try:
        place = saved(tmp_path / "tower.safetensors")
        config = tiny_config({"type": "OneProcessRunner", "max_steps": 1})
        config["model"] = {"type": "TwoParts", "place": place}
        context = RunContext(config=config, section="runner", work_dir=tmp_path / "run")
        runner = build_runner_from_cfg(config["runner"], context)
        runner.run_setup(len(TinyDataset(37)))
        assert torch.equal(runner.vla.tower[1].weight.detach(), weights()["vision.model.1.weight"])
    finally:
        VLAS.unregister("TwoParts")
