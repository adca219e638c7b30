"""Buffers that training changes are the first process's, everywhere, once a step is done."""

from __future__ import annotations

import torch
from torch import nn

from fluxvla_core import VLAS
from fluxvla_core.testing.training import TinyVLA, run_ranks, tiny_config, train


@VLAS.register_module()
class CountingVLA(TinyVLA):
    """Sums up what it saw, in buffers of several kinds and places."""

    def __init__(self):
        super().__init__(dropout=0.0, centred=True)
        self.blocks[0].register_buffer("ids", torch.zeros((), dtype=torch.int64))
        self.register_buffer("odd", torch.zeros(2, 3, dtype=torch.bool).t())
        self.register_buffer("own", torch.zeros(1), persistent=False)

    def forward(self, sample_ids, **batch):
        self.blocks[0].ids += sample_ids.sum()
        # Another tensor in the old one's place.
        self.odd = self.odd ^ (sample_ids.sum() % 2).bool()
        self.own += sample_ids.sum()
        return super().forward(sample_ids=sample_ids, **batch)


def of_all(tensor):
    found = [torch.empty_like(tensor) for _ in range(torch.distributed.get_world_size())]
    torch.distributed.all_gather(found, tensor.contiguous())
    return found


def counted(work_dir):
    torch.distributed.init_process_group("gloo")
    config = tiny_config({"type": "FSDPTrainRunner", "max_steps": 3}, batch=2)
    model = train({"config": {**config, "model": {"type": "CountingVLA"}}, "work_dir": work_dir})
    buffers = dict(model.model.named_buffers())
    assert set(buffers) == {"batches", "mean", "odd", "own", "blocks.0.ids"}
    first, second = of_all(buffers.pop("own"))
    assert first != second
    assert buffers["blocks.0.ids"] == first
    for name, buffer in buffers.items():
        ours, theirs = of_all(buffer.byte() if buffer.dtype == torch.bool else buffer)
        assert torch.equal(ours, theirs), name


def test_all_saved_buffers_are_the_first_ranks(tmp_path):
    assert run_ranks(2, counted, tmp_path) == [0, 0]


@VLAS.register_module()
class NoBuffersVLA(nn.Module):
    action_shape = (2, 3)

    def __init__(self):
        super().__init__()
        self.head = nn.Linear(6, 6)

    def forward(self, states, actions, noise, sample_ids):
        return {"loss": (self.head(states).unflatten(1, (2, 3)) - actions).square().mean()}


def counted_broadcasts(work_dir):
    """How many a run takes in which the model has buffers, and in which it has none."""
    torch.distributed.init_process_group("gloo")
    broadcast, calls = torch.distributed.broadcast, []

    def counting(tensor, src, group=None, **settings):
        if group is None:  # what the host decides with travels in a group of its own
            calls.append(tensor)
        return broadcast(tensor, src, group, **settings)

    torch.distributed.broadcast = counting
    for name, count in {"TinyVLA": 3, "NoBuffersVLA": 0}.items():
        table = {"type": "FSDPTrainRunner", "max_steps": 3, "grad_accumulation_steps": 2}
        config = {**tiny_config(table, batch=2), "model": {"type": name}}
        calls.clear()
        train({"config": config, "work_dir": work_dir / name})
        assert len(calls) == count


def test_once_a_step_and_not_without_buffers(tmp_path):
    assert run_ranks(2, counted_broadcasts, tmp_path) == [0, 0]
