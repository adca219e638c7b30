"""Tensors to safetensors files and back."""

from __future__ import annotations

import json
import os
import struct
import time
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import nn

from fluxvla_core.checkpoints.shards import StoredTensors
from fluxvla_core.checkpoints.tensors import TensorFile, check_names, read_tensors
from fluxvla_core.checkpoints.writer import CheckpointWriter
from fluxvla_core.errors import CheckpointError


def saved(tmp_path, tensors):
    with CheckpointWriter(tmp_path, 1, 0) as writer:
        TensorFile.full("t.safetensors", tensors, True).write(writer)
        return writer.commit() / "t.safetensors"


EVERY = {
    "f64": torch.tensor([1.0, float("nan"), -0.0], dtype=torch.float64),
    "f32": torch.tensor([[1e-38, float("inf")], [3.0, -2.0]]),
    "f16": torch.tensor([0.5, -7.0], dtype=torch.float16),
    "bf16": torch.tensor([0.1, 3e38], dtype=torch.bfloat16),
    "i64": torch.tensor(-(2**62)),
    "i32": torch.tensor([[1], [2]], dtype=torch.int32),
    "i16": torch.tensor([-3], dtype=torch.int16),
    "i8": torch.tensor([-128, 127], dtype=torch.int8),
    "u8": torch.tensor([0, 255, 3], dtype=torch.uint8),
    "bool": torch.tensor([True, False, True]),
    "empty": torch.zeros(0, 3),
    "ümläut/name": torch.ones(1),
    "view": torch.arange(12).reshape(3, 4).T[1:],
}


def same_bits(a, b):
    return a.dtype == b.dtype and a.shape == b.shape and bytes_of(a) == bytes_of(b)


def bytes_of(t):
    return t.contiguous().reshape(-1).view(torch.uint8).numpy().tobytes() if t.numel() else b""


def test_every_dtype_comes_back_bit_for_bit(tmp_path):
    path = saved(tmp_path, EVERY)
    for found in (read_tensors(path), load_file(path)):
        assert set(found) == set(EVERY)
        assert all(same_bits(found[name], tensor) for name, tensor in EVERY.items())


def test_tied_weights_are_stored_once_and_come_back_under_both_names(tmp_path):
    """T9 of upstream's bugs: tied weights made saving fail."""
    net = nn.ModuleDict({"a": nn.Linear(50, 50, bias=False), "b": nn.Linear(50, 50, bias=False)})
    net["b"].weight = net["a"].weight
    path = saved(tmp_path, net.state_dict(keep_vars=True))
    assert path.stat().st_size < 1.5 * 50 * 50 * 4
    found = read_tensors(path)
    assert torch.equal(found["b.weight"], net["a"].weight)
    assert set(found) == {"a.weight", "b.weight"}
    with safe_open(path, "pt") as file:
        assert json.loads(file.metadata()["aliases"]) == {"b.weight": "a.weight"}


def test_reading_takes_no_memory_before_it_is_used(tmp_path):
    """T11 of upstream's bugs: every rank held the whole checkpoint in memory."""
    path = saved(tmp_path, {str(i): torch.ones(1 << 20) for i in range(20)})
    before = anonymous_kib()
    found = read_tensors(path)
    assert anonymous_kib() - before < 8_000  # of 80 MiB
    assert {tensor.device.type for tensor in found.values()} == {"cpu"}


def anonymous_kib():
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("RssAnon"))


def test_a_dtype_that_the_format_lacks_is_named(tmp_path):
    with pytest.raises(CheckpointError, match=r"tensor z has dtype torch\.complex64"):
        saved(tmp_path, {"z": torch.zeros(1, dtype=torch.complex64)})
    assert list((tmp_path / "checkpoints").iterdir()) == []


def test_a_file_that_is_no_safetensors_is_named(tmp_path):
    path = tmp_path / "x.safetensors"
    path.write_bytes(b"no such format")
    with pytest.raises(CheckpointError, match=r"x\.safetensors cannot be read"):
        read_tensors(path)


def test_check_names_lists_what_differs():
    ours = {n: torch.zeros(2) for n in "abcdefg"}
    theirs = {"a": torch.zeros(2), "b": torch.zeros(3), "x": torch.zeros(1)}
    with pytest.raises(CheckpointError) as caught:
        check_names(theirs, ours, "the weights", "/ckpt")
    assert str(caught.value) == (
        "/ckpt: the weights of the checkpoint are not this model's:\n"
        "    5 missing in the checkpoint: c; d; e; f …\n"
        "    1 unexpected in the checkpoint: x\n"
        "    1 of another size: b: (3,) in the checkpoint, (2,) here\n"
        "  likely cause: it was made by another model, or by another version of this one\n"
        "  next: resume with the config that made it: config.resolved.json in its folder"
    )
    check_names(ours, ours, "the weights", "/ckpt")


def with_header(path, header, length=None):
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    path.write_bytes(struct.pack("<Q", len(text) if length is None else length) + text)
    return path


def processor_s(work):
    """Seconds of this process that the quickest of three takes, whatever else the machine does."""
    found = []
    for _ in range(3):
        begin = time.process_time()
        work()
        found.append(time.process_time() - begin)
    return min(found)


def test_headers_larger_than_any_models_are_refused_before_they_are_parsed(tmp_path):
    entry = {"dtype": "F32", "shape": [0], "data_offsets": [0, 0]}
    many = with_header(tmp_path / "many", {f"{i:06d}": entry for i in range(600_000)})
    few = with_header(tmp_path / "few", {f"{i:06d}": entry for i in range(150_000)})
    stated = with_header(tmp_path / "stated", {}, 1 << 60)
    whole = processor_s(lambda: json.loads(few.read_bytes()[8:]))
    for path, fact in ((many, "16 MiB"), (few, "150000 tensors"), (stated, "16 MiB")):
        for read in (read_tensors, lambda path: StoredTensors([path])):

            def refused(path=path, fact=fact, read=read):
                with pytest.raises(CheckpointError, match=fact):
                    read(path)

            assert processor_s(refused) < whole / 4


@pytest.mark.parametrize(
    "header",
    [
        b"[" * 100_000,
        {"a": {"dtype": "F32", "shape": [1 << 62, 4], "data_offsets": [0, 0]}},
        {"a": {"dtype": "F32", "shape": "x", "data_offsets": [0, 0]}},
        {"__metadata__": {"aliases": "[1]"}},
        {"__metadata__": {"aliases": '{"a": "b"}'}},
        {"__metadata__": {"aliases": "[" * 10_000}},
    ],
)
def test_headers_of_other_types_are_named(tmp_path, header):
    path = with_header(tmp_path / "odd.safetensors", header)
    with pytest.raises(CheckpointError, match=r"odd\.safetensors"):
        read_tensors(path)


@pytest.mark.parametrize(
    "metadata",
    [
        {"DCP_SHARDING_INFO": "[]"},
        {"DCP_SHARDING_INFO": '{"a": {"saved_offsets": "x"}}'},
        {"DCP_SHARDING_INFO": '{"b": {"saved_offsets": [0]}}'},
        {"DCP_SHARDING_INFO": '{"a": {"saved_offsets": [0, 0]}}'},
        {"shapes": '{"a": [1, 2, 3]}'},
    ],
)
def test_places_of_parts_are_checked(tmp_path, metadata):
    entry = {"dtype": "F32", "shape": [0], "data_offsets": [0, 0]}
    path = with_header(tmp_path / "odd.safetensors", {"__metadata__": metadata, "a": entry})
    with pytest.raises(CheckpointError, match=r"odd\.safetensors"):
        StoredTensors([path])


def test_tensors_in_a_pipe_are_refused(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(CheckpointError, match="no regular file"):
        read_tensors(tmp_path / "pipe")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda c: c[:-8], "it has {} bytes instead of {}"),
        (lambda c: c[:20], "cannot be read"),
        (lambda c: b"", "cannot be read"),
        (lambda c: b"version https://git-lfs.github.com/spec/v1\n", "a pointer of Git LFS"),
    ],
)
def test_a_file_that_was_copied_in_part_says_so(tmp_path, change, words):
    path = tmp_path / "model.safetensors"
    save_file({"a": torch.zeros(16), "b": torch.ones(3, 2)}, path)
    content = path.read_bytes()
    path.write_bytes(change(content))
    with pytest.raises(CheckpointError) as error:
        StoredTensors([path])
    assert words.format(len(content) - 8, len(content)) in error.value.what
    assert error.value.next == "copy or download it again"
