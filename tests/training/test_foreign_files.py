"""Weights of another project's checkpoint: in several files, or on the hub."""

from __future__ import annotations

import json

import pytest
import torch
from safetensors.torch import load_file, save_file

from fluxvla_core.errors import CheckpointError
from fluxvla_core.models import safetensors_in
from fluxvla_core.training.export import import_checkpoint

from .reach import plugin, published, weights

__all__ = ["plugin"]


def in_parts(folder, weight_map=None):
    folder.mkdir()
    (folder / "reach.json").write_text("{}")
    named = {}
    for place, (name, tensor) in enumerate(weights().items(), 1):
        file = f"model-{place:05d}-of-00003.safetensors"
        save_file({name: tensor}, folder / file)
        named[name] = file
    index = {"metadata": {}, "weight_map": {**named, **(weight_map or {})}}
    (folder / "model.safetensors.index.json").write_text(json.dumps(index))
    return folder


def test_weights_in_several_files(tmp_path):
    out, found = import_checkpoint(in_parts(tmp_path / "theirs"), tmp_path / "ours")
    whole, _ = import_checkpoint(published(tmp_path / "one", hz=None), tmp_path / "other")
    assert found.action_rate_hz is None
    first, second = (load_file(p / "model.safetensors") for p in (out, whole))
    assert all(torch.equal(first[name], second[name]) for name in first.keys() | second.keys())


@pytest.mark.parametrize(
    ("weight_map", "words"),
    [
        ({"net.x": "model-00001-of-00003.safetensors"}, "no file has 'net.x', which is listed"),
        ({"net.x": "../secret.safetensors"}, "'../secret.safetensors' is not a file next to it"),
        ({"net.x": 3}, "weight_map: no table of file names"),
        ({"net.x": "gone.safetensors"}, "gone.safetensors cannot be read"),
    ],
)
def test_an_index_that_lies(tmp_path, weight_map, words):
    with pytest.raises(CheckpointError, match=words):
        safetensors_in(in_parts(tmp_path / "theirs", weight_map))


def hub_cache(folder, monkeypatch):
    """The hub's cache with one model in it, and no way to the hub."""
    pytest.importorskip("huggingface_hub")
    from huggingface_hub import constants

    revision = "0123456789abcdef0123456789abcdef01234567"
    repository = folder / "models--acme--reach"
    (repository / "refs").mkdir(parents=True)
    (repository / "refs" / "main").write_text(revision)
    (repository / "snapshots").mkdir()
    published(repository / "snapshots" / revision)
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(folder))
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)


def test_one_on_the_hub(tmp_path, monkeypatch):
    hub_cache(tmp_path / "cache", monkeypatch)
    out, _ = import_checkpoint("hf:acme/reach", tmp_path / "ours")
    assert torch.equal(load_file(out / "model.safetensors")["scale"], weights()["s"])
    with pytest.raises(CheckpointError, match="hf:acme/other cannot be fetched"):
        import_checkpoint("hf:acme/other", tmp_path / "more")
    with pytest.raises(CheckpointError, match="hf:a/b/c cannot be fetched"):
        import_checkpoint("hf:a/b/c", tmp_path / "more")


def test_a_typo_never_asks_the_hub(tmp_path):
    with pytest.raises(CheckpointError, match="acme/reach does not exist") as caught:
        import_checkpoint("acme/reach", tmp_path / "ours")
    assert "hf:OWNER/NAME" in str(caught.value)
