"""Which modules an adapter's names mean: no more than was meant, and none that shares weights."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from fluxvla_core.errors import ConfigError
from fluxvla_core.training import lora
from fluxvla_core.training.lora import LoraOptions

pytest.importorskip("peft")


class Tied(nn.Module):
    def __init__(self):
        super().__init__()
        self.words, self.body, self.logits = nn.Embedding(4, 2), nn.Linear(2, 2), nn.Linear(2, 4)
        self.logits.weight = self.words.weight


@pytest.mark.parametrize(
    ("key", "name", "other"),
    [
        ("target_modules", "logits", "words"),
        ("target_modules", "words", "logits"),
        ("target_modules", r"log\w+", "words"),
        ("target_modules", "all-linear", "words"),
        ("modules_to_save", "logits", "words"),
    ],
)
def test_a_weight_that_two_modules_share_gets_no_adapter(key, name, other):
    names = (name,) if name in ("words", "logits") else name
    options = LoraOptions(**{"rank": 1, "target_modules": ("body",), key: names})
    module = name if name == "words" else "logits"
    with pytest.raises(ConfigError) as caught:
        lora.attach(Tied(), options)
    assert str(caught.value) == (
        f"lora.{key}: {module!r} has a weight that another module uses too: "
        f"{module}.weight and {other}.weight are one\n"
        "  likely cause: the one cannot be trained, nor get an adapter, without the other\n"
        f"  next: leave {module!r} out, or give it a weight of its own in the model"
    )


def test_weights_shared_inside_or_beside_what_is_trained_are_fine():
    lora.attach(Tied(), LoraOptions(1, ("body",)))
    model = nn.ModuleDict({"body": nn.Linear(2, 2), "tied": Tied()})
    lora.attach(model, LoraOptions(1, r"body", modules_to_save=("tied",)))


class Heads(nn.Module):
    def __init__(self, *names):
        super().__init__()
        self.linear = nn.Linear(2, 2)
        for name in names:
            *folders, last = name.split(".")
            parent = self
            for folder in folders:
                if not hasattr(parent, folder):
                    parent.add_module(folder, nn.Module())
                parent = getattr(parent, folder)
            parent.add_module(last, nn.Linear(2, 2))


def trained_whole(model):
    names = {n for n, p in model.named_parameters() if p.requires_grad}
    return {n.partition(".modules_to_save.")[0] for n in names if ".lora_" not in n}


@pytest.mark.parametrize(
    ("names", "end", "others", "instead", "tell"),
    [
        (
            ["vla.head", "vla.action_head"],
            "head",
            "vla.action_head",
            ["vla.head"],
            "write 'vla.head' instead, or name those too",
        ),
        (
            ["a.0.out", "a.10.out"],
            "out",
            "peft's own lora_dropout",
            ["a.0.out", "10.out"],
            "write 'a.0.out', '10.out' instead",
        ),
        (
            ["vla.layer"],
            "layer",
            "peft's own base_layer",
            ["vla.layer"],
            "write 'vla.layer' instead",
        ),
        (
            ["head", "action_head"],
            "head",
            "action_head",
            [],
            "'head' has no ending that is its own: rename it in the model, or name those too",
        ),
    ],
)
def test_a_name_that_hits_the_middle_of_another(names, end, others, instead, tell):
    with pytest.raises(ConfigError) as caught:
        lora.attach(Heads(*names), LoraOptions(1, ("linear",), modules_to_save=(end,)))
    assert str(caught.value) == (
        f"lora.modules_to_save: {end!r} would also hit {others}\n"
        "  likely cause: peft trains every module whose name ends in these letters\n"
        f"  next: {tell}"
    )
    for name in instead:
        model = Heads(*names)
        lora.attach(model, LoraOptions(1, ("linear",), modules_to_save=(name,)))
        assert trained_whole(model) == {n for n in names if n.endswith(name)}
        assert len(trained_whole(model)) == 1


def test_a_name_may_hit_what_is_named_too():
    model = Heads("head", "action_head")
    lora.attach(model, LoraOptions(1, ("linear",), modules_to_save=("head", "action_head")))
    assert trained_whole(model) == {"head", "action_head"}


def test_a_checkpoint_that_was_trained_with_such_a_name_still_loads():
    options = LoraOptions(1, ("linear",), modules_to_save=("head",))
    model = Heads("head", "action_head")
    lora.attach(model, options, trained=True)
    assert "action_head.modules_to_save.default.bias" in lora.adapter_names(model)


class Nested(nn.Module):
    """Its projector is a module with a projector inside."""

    def __init__(self, whole=True):
        super().__init__()
        self.linear, self.projector = nn.Linear(3, 3), nn.Module()
        self.projector.projector = nn.Linear(3, 3)
        if not whole:
            self.projector.norm = nn.LayerNorm(3)

    def forward(self, x):
        return self.projector.projector(self.linear(x))


NESTED = LoraOptions(2, ("linear",), modules_to_save=("projector",))


def test_a_module_with_one_of_its_name_inside_is_trained():
    """peft wraps both, and its outer copy, which is used, stays as it is."""
    model = Nested()
    options = NESTED.for_model(model)
    assert options.modules_to_save == ("projector.projector",)
    assert options.for_model(model) == options
    lora.attach(model, NESTED)
    model(torch.ones(2, 3)).sum().backward()
    trained = {n: p.grad for n, p in model.named_parameters() if p.requires_grad}
    assert {n for n in trained if "projector" in n} == {
        f"projector.projector.modules_to_save.default.{name}" for name in ("weight", "bias")
    }
    assert all(grad is not None for grad in trained.values())


def test_a_module_that_is_more_than_the_one_inside_is_refused():
    words = "'projector' hits 'projector' and, inside it, projector.projector"
    with pytest.raises(ConfigError, match=words):
        lora.attach(Nested(whole=False), NESTED)
