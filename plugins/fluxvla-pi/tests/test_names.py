"""Published names against the full-size models, both ways."""

from __future__ import annotations

import json
import re
from math import prod
from pathlib import Path

import pytest
import torch
from fluxvla_pi.names import LEROBOT, OPENPI, TRANSFORMERS, layout_of, published, sources
from fluxvla_pi.pi0 import PI0FlowMatching
from fluxvla_pi.pi0_fast import PI0FAST
from fluxvla_pi.pi05 import PI05FlowMatching

from fluxvla_core.errors import CheckpointError

KEYS = Path(__file__).parent / "keys"
FILES = {
    "pi0-openpi": (PI0FlowMatching, OPENPI),
    "pi05-openpi": (PI05FlowMatching, OPENPI),
    "pi0-lerobot061": (PI0FlowMatching, LEROBOT),
    "pi05-lerobot061": (PI05FlowMatching, LEROBOT),
    "pi0_fast-lerobot061": (PI0FAST, LEROBOT),
    "pi0-transformers5.23": (PI0FlowMatching, TRANSFORMERS),
}
HEAD = "paligemma_with_expert.paligemma.lm_head.weight"
EMBEDDING = "paligemma_with_expert.paligemma.model.language_model.embed_tokens.weight"


def listed(name):
    """The published list, layers written out: facts about it, and name -> shape."""
    facts = json.loads((KEYS / f"{name}.json").read_text())
    shapes = {}
    for key, shape in facts.pop("tensors").items():
        found = re.search(r"\{(\d+)\}", key)
        for i in range(int(found[1]) if found else 1):
            shapes[re.sub(r"\{\d+\}", str(i), key)] = tuple(shape)
    return facts, shapes


@pytest.fixture(scope="module")
def full():
    with torch.device("meta"):
        models = {kind: kind() for kind in (PI0FlowMatching, PI05FlowMatching)}
        models[PI0FAST] = PI0FAST({}, tied_head=False)
    return {
        kind: {name: tuple(p.shape) for name, p in model.state_dict().items()}
        for kind, model in models.items()
    }


@pytest.mark.parametrize("name", FILES)
def test_every_published_tensor_has_its_place_and_shape(full, name):
    kind, layout = FILES[name]
    ours, (_, shapes) = full[kind], listed(name)
    assert layout_of(shapes, "here") is layout
    found = sources(ours, shapes, "here")
    assert {key: shapes[theirs] for key, theirs in found.items()} == ours
    assert set(shapes) - set(found.values()) <= {*layout.unused, layout.head}


@pytest.mark.parametrize("name", FILES)
def test_parameters_are_as_many_as_published(full, name):
    kind, layout = FILES[name]
    facts, shapes = listed(name)
    tied = {twin for pair in facts["tied"] for twin in pair[1:]}
    assert sum(prod(s) for key, s in shapes.items() if key not in tied) == facts["parameters"]
    unused = sum(prod(shapes[key]) for key in layout.unused if key in shapes)
    untied = prod(shapes[layout.head]) if layout is LEROBOT and kind is not PI0FAST else 0
    assert sum(map(prod, full[kind].values())) + unused + untied == facts["parameters"]


def test_pi05_has_3_62_billion_parameters_with_the_vocabulary_that_the_expert_does_not_use(full):
    unused = 257152 * 1024
    assert round((sum(map(prod, full[PI05FlowMatching].values())) + unused) / 1e9, 2) == 3.62


@pytest.mark.parametrize("name", ["pi0-openpi", "pi05-openpi", "pi0-lerobot061", "pi05-lerobot061"])
def test_what_is_written_is_the_published_list(full, name):
    kind, layout = FILES[name]
    facts, shapes = listed(name)
    for twin in (pair[1] for pair in facts["tied"]):
        del shapes[twin]
    wanted = published(full[kind], layout)
    assert {*wanted, *layout.unused} == set(shapes)
    assert {key: full[kind][ours] for key, ours in wanted.items()} == {
        key: shapes[key] for key in wanted
    }


@pytest.mark.parametrize("kind", [PI0FlowMatching, PI05FlowMatching])
def test_full_size_shapes_fit_together(kind):
    """Three cameras, two draws for each sample; nothing is computed."""
    with torch.device("meta"):
        model = kind()
        seen = {
            "images": torch.empty(2, 9, 224, 224),
            "lang_tokens": torch.zeros(2, 48, dtype=torch.int64),
            "lang_masks": torch.ones(2, 48, dtype=torch.bool),
            "states": torch.empty(2, 32),
        }
        drawn = {"noise": torch.empty(2, 2, 50, 32), "time": torch.empty(2, 2)}
        losses = model(**seen, **drawn, actions=torch.empty(2, 50, 32))
        chunk = model.predict_action(**seen, noise=torch.empty(2, 50, 32))
    assert losses["loss"].shape == ()
    assert losses["sample_losses"].shape == (2,)
    assert chunk.shape == (2, 50, 32)


def test_pi0_fast_has_paligemmas_parameters():
    """2.92 billion: 3.45 with a head of its own, as LeRobot trains it."""
    with torch.device("meta"):
        tied = PI0FAST({})
    count = sum(p.numel() for p in tied.parameters())
    assert count == listed("pi0_fast-lerobot061")[0]["parameters"] - 257152 * 2048
    assert round(count / 1e9, 2) == 2.92


def test_full_size_shapes_of_pi0_fast_fit_together():
    with torch.device("meta"):
        model = PI0FAST({}, n_action_steps=10)
        seen = {
            "images": torch.empty(2, 6, 224, 224),
            "lang_tokens": torch.zeros(2, 64, dtype=torch.int64),
            "lang_masks": torch.ones(2, 64, dtype=torch.bool),
        }
        tokens = torch.zeros(2, 96, dtype=torch.int64)
        losses = model(**seen, action_tokens=tokens, action_token_masks=tokens.bool())
        chunk = model.predict_action(**seen)
    assert losses["loss"].shape == ()
    assert losses["sample_losses"].shape == (2,)
    assert chunk.shape == (2, 10, 7)


def test_a_file_with_the_head_only_gives_the_embedding(full):
    _, shapes = listed("pi05-openpi")
    del shapes[EMBEDDING]
    found = sources(full[PI05FlowMatching], shapes, "here")
    assert found["llm_backbone.embed_tokens.weight"] == HEAD


def test_of_untied_weights_the_embedding_is_taken(full):
    _, shapes = listed("pi05-lerobot061")
    found = sources(full[PI05FlowMatching], shapes, "here")
    assert found["llm_backbone.embed_tokens.weight"] == f"model.{EMBEDDING}"


def test_a_tower_without_vision_model_in_its_names(full):
    _, shapes = listed("pi0-openpi")
    short = {
        key.replace("vision_tower.vision_model.", "vision_tower."): s for key, s in shapes.items()
    }
    assert len(short) == len(shapes)
    found = sources(full[PI0FlowMatching], short, "here")
    assert {key: short[theirs] for key, theirs in found.items()} == full[PI0FlowMatching]


def test_what_is_missing_or_of_no_use_is_listed(full):
    _, shapes = listed("pi05-openpi")
    del shapes["time_mlp_in.bias"]
    shapes["surprise.weight"] = (1,)
    with pytest.raises(CheckpointError) as caught:
        sources(full[PI05FlowMatching], shapes, "a/model.safetensors")
    text = str(caught.value)
    assert "1 missing (time_mlp_in.bias)" in text
    assert "1 of no use (surprise.weight)" in text
    assert "a/model.safetensors" in text


def test_a_file_of_the_other_family_is_refused(full):
    _, shapes = listed("pi0-openpi")
    with pytest.raises(CheckpointError, match=r"78 missing .* 43 of no use"):
        sources(full[PI05FlowMatching], shapes, "here")


def test_a_file_of_another_model_is_refused():
    with pytest.raises(CheckpointError, match=r"no tensor's name begins with .* there are a, b"):
        layout_of(["b", "a"], "here")
