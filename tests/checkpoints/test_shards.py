"""Parts of tensors in several files: any block of a whole is read back from them."""

from __future__ import annotations

import json

import pytest
import torch
import torch.distributed.checkpoint as dcp
from safetensors.torch import save_file
from torch.distributed.checkpoint.hf_storage import HuggingFaceStorageReader

from fluxvla_core.checkpoints.shards import (
    PLACES,
    SHAPES,
    Block,
    StoredTensors,
    is_sharded,
    local_shards,
)
from fluxvla_core.checkpoints.tensors import TensorFile
from fluxvla_core.checkpoints.writer import CheckpointWriter
from fluxvla_core.errors import CheckpointError

WHOLE = {
    "a": torch.arange(35, dtype=torch.float32).reshape(7, 5),
    "b": torch.arange(3, dtype=torch.int64),
    "step": torch.tensor(4.0),
}


def save(folder, cuts):
    """One file for each pair of row numbers in ``cuts``; ``step`` is in the first."""
    paths = []
    for number, (begin, end) in enumerate(cuts):
        found, places = {}, {}
        for name in ("a", "b"):
            part = WHOLE[name][begin:end]
            if len(part):
                found[name] = part.clone()
                places[name] = {"saved_offsets": [begin] + [0] * (part.ndim - 1)}
        if number == 0:
            found["step"], places["step"] = WHOLE["step"], {"saved_offsets": []}
        header = {
            PLACES: json.dumps(places),
            SHAPES: json.dumps({name: list(WHOLE[name].shape) for name in found}),
        }
        paths.append(folder / f"rank-{number}.safetensors")
        save_file(found, paths[-1], header)
    return paths


def everything(stored):
    return {n: t[tuple(slice(0, k) for k in t.shape)] for n, t in stored.items()}


@pytest.mark.parametrize("cuts", [[(0, 7)], [(0, 4), (4, 7)], [(0, 3), (3, 6), (6, 7)]])
def test_any_block_comes_back(tmp_path, cuts):
    stored = StoredTensors(save(tmp_path, cuts))
    assert set(stored) == set(WHOLE)
    assert len(stored) == 3
    for name, tensor in everything(stored).items():
        assert torch.equal(tensor, WHOLE[name])
    for begin in range(7):
        for end in range(begin, 8):
            block = stored["a"][begin:end, 1:4]
            assert torch.equal(block, WHOLE["a"][begin:end, 1:4])
            assert block.dtype == torch.float32


def test_torchs_reader_takes_the_same_files(tmp_path):
    save(tmp_path, [(0, 4), (4, 7)])
    state = {n: torch.full_like(WHOLE[n], -7) for n in ("a", "b")}
    reader = HuggingFaceStorageReader(str(tmp_path))
    dcp.load(state, storage_reader=reader, no_dist=True)
    assert all(torch.equal(state[n], WHOLE[n]) for n in state)


def test_a_missing_part_is_named(tmp_path):
    stored = StoredTensors(save(tmp_path, [(0, 4), (4, 7)])[:1])
    assert torch.equal(stored["a"][0:4, 0:5], WHOLE["a"][:4])
    with pytest.raises(CheckpointError, match="parts of a are in no file of the checkpoint"):
        everything(stored)


def test_a_file_of_another_kind_is_named(tmp_path):
    (tmp_path / "x.safetensors").write_bytes(b"no such format")
    with pytest.raises(CheckpointError, match=r"x\.safetensors cannot be read"):
        StoredTensors([tmp_path / "x.safetensors"])


def test_a_plain_file_is_its_own_only_part(tmp_path):
    with CheckpointWriter(tmp_path, 1, 0) as writer:
        TensorFile.full("o.safetensors", WHOLE, True).write(writer)
        TensorFile.shards("p.safetensors", local_shards(WHOLE, True)).write(writer)
        path = writer.commit()
    assert local_shards(WHOLE, False) == {}
    for name in ("o", "p"):
        found = everything(StoredTensors([path / f"{name}.safetensors"]))
        assert all(torch.equal(found[n], WHOLE[n]) for n in WHOLE)


def test_regions():
    whole = Block.of(WHOLE["a"])
    assert whole == Block((0, 0), (7, 5))
    assert Block((2, 1), (3, 4)).intersection(Block((4, 0), (3, 2))) == Block((4, 1), (1, 1))
    assert Block((0, 0), (2, 5)).intersection(Block((2, 0), (5, 5))) is None
    assert Block((4, 1), (1, 1)).relative_to(Block((3, 0), (4, 5))) == (slice(1, 2), slice(1, 2))
    assert not is_sharded(WHOLE["a"])
