"""Counting a model's operations, and what share of a device's peak they are."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from fluxvla_core.build import RunContext, build_runner_from_cfg
from fluxvla_core.checkpoints.checkpoint import folders
from fluxvla_core.testing.training import (
    Notes,
    TinyDataset,
    TinyVLA,
    checkpoint_differences,
    tiny_config,
    unflushed,
)
from fluxvla_core.training.cost import Meter, known_peak, on_meta, training_flops


def batch(n=4):
    samples = [TinyDataset().get_sample(i, 0) for i in range(n)]
    return {k: torch.stack([torch.as_tensor(s[k]) for s in samples]) for k in samples[0]}


def test_every_product_of_forward_and_backward_pass_counts():
    """Two operations for each weight and sample forward, four more backward; frozen ones none."""
    frozen, blocks, head = 6 * 8, 2 * 8 * 8, 8 * 6
    expected = 4 * 2 * (frozen + 3 * blocks + 3 * head)
    assert training_flops(on_meta(TinyVLA()), batch()) == expected
    assert training_flops(on_meta(TinyVLA()), batch(8)) == 2 * expected


def test_counting_takes_no_memory_and_draws_nothing():
    model = TinyVLA()
    before = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    bare = on_meta(model)
    assert {t.device.type for t in [*bare.parameters(), *bare.buffers()]} == {"meta"}
    state = torch.get_rng_state()
    training_flops(bare, batch())
    assert torch.equal(torch.get_rng_state(), state)
    assert all(torch.equal(t, before[name]) for name, t in model.state_dict().items())
    assert all(p.grad is None for p in model.parameters())


def test_tied_weights_stay_tied():
    model = torch.nn.Sequential(torch.nn.Linear(3, 3), torch.nn.Linear(3, 3))
    model[1].weight = model[0].weight
    bare = on_meta(model)
    assert bare[1].weight is bare[0].weight


@pytest.mark.parametrize(
    ("name", "peak"),
    [
        ("NVIDIA H200", 989.5),
        ("NVIDIA H200 NVL", 835.5),
        ("NVIDIA H100 80GB HBM3", 989.5),
        ("NVIDIA H100 PCIe", 756.0),
        ("NVIDIA A100-SXM4-80GB", 312.0),
        ("NVIDIA L40S", 362.05),
        ("NVIDIA L4", 121.0),
        ("NVIDIA GeForce RTX 4090", 165.2),
        ("NVIDIA GeForce RTX 3060", None),
        ("Tesla V100", None),
    ],
)
def test_peaks_by_name(name, peak):
    assert known_peak(name, torch.bfloat16) == peak
    assert known_peak(name, None) is None


def test_without_a_known_peak_there_is_nothing_to_tell():
    assert Meter.of(TinyVLA(), torch.device("cpu"), torch.bfloat16, None) is None


def test_the_share():
    meter = Meter.of(TinyVLA(), torch.device("cpu"), None, 2.0)
    assert meter.mfu(1, 1.0) is None
    assert meter.count(batch()) is None
    assert meter.count(batch()) is None
    assert meter.mfu(3, 0.5) == pytest.approx(meter.per_batch * 3 / 0.5 / 2e12)
    assert meter.mfu(3, 0.0) is None


def run(work_dir, **settings):
    config = tiny_config({"type": "OneProcessRunner", "max_steps": 3, **settings})
    context = RunContext(
        config=config, section="runner", work_dir=Path(work_dir), reporter=Notes(Path(work_dir))
    )
    runner = build_runner_from_cfg(config["runner"], context)
    with unflushed():
        runner.run_setup(37)
        runner.run(TinyDataset())
    return [json.loads(line) for line in (work_dir / "metrics.jsonl").open()]


def test_a_run_tells_it_and_is_the_same_run(tmp_path):
    settings = {"enable_gradient_checkpointing": True, "grad_accumulation_steps": 2}
    rows = run(tmp_path / "told", peak_tflops=0.001, **settings)
    flops = training_flops(on_meta(TinyVLA()), batch())
    for row in rows:
        assert row["mfu"] == pytest.approx(flops * 2 / row["step_time"] / 1e9)
    plain = run(tmp_path / "plain", **settings)
    assert all("mfu" not in row for row in plain)
    ends = [folders(tmp_path / d)[-1] for d in ("told", "plain")]
    assert checkpoint_differences(*ends) == [f"{ends[0].name}/config.resolved.json"]


def test_a_model_that_looks_at_its_inputs_is_not_counted_and_trains(tmp_path, monkeypatch):
    forward = TinyVLA.forward

    def looking(self, states, actions, noise, sample_ids):
        assert float(states.sum()) != 0.5
        return forward(self, states, actions, noise, sample_ids)

    monkeypatch.setattr(TinyVLA, "forward", looking)
    rows = run(tmp_path, peak_tflops=1.0)
    assert all("mfu" not in row for row in rows)
    assert (
        "warning: mfu is not reported: RuntimeError: Tensor.item()"
        in (tmp_path / "said.txt").read_text()
    )
