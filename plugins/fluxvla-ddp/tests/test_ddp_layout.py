"""What a dry run says of a process's memory is what the process then holds."""

from __future__ import annotations

import torch

from fluxvla_core import build_runner_from_cfg, build_vla_from_cfg
from fluxvla_core.build import RunContext
from fluxvla_core.testing.training import TinyDataset, run_ranks, tiny_config
from fluxvla_core.training.cost import (
    fake,
    fake_activations,
    optimizer_bytes,
    saved_activations,
    state_bytes,
)
from fluxvla_core.training.model import ForwardArguments


def size(tensors):
    found = {t.untyped_storage()._cdata: t.untyped_storage().nbytes() for t in tensors}
    return sum(found.values())


def held(work_dir):
    config = tiny_config({"type": "DDPTrainRunner", "max_steps": 1}, width=7, assorted=True)
    context = RunContext(config=config, section="runner", work_dir=work_dir)
    runner = build_runner_from_cfg(config["runner"], context)
    with torch.device("meta"):
        bare = build_vla_from_cfg(config["model"])
    said = runner.memory_layout(bare, 2, "cpu")

    runner.run_setup(37)
    runner.vla.train()
    runner.forward_arguments = ForwardArguments(runner.model)
    batch = runner.collator([TinyDataset().get_sample(i, 0) for i in range(4)])
    runner.backward(runner._training_step(batch))
    parameters = list(runner.model.parameters())
    assert said.parameters == size([*parameters, *runner.model.buffers()])
    assert said.gradients == size(p.grad for p in parameters if p.grad is not None)
    runner.optimizer_step()
    state = state_bytes(runner.optimizer)
    assert optimizer_bytes(runner.optimizer_settings.build, said.optimized) == state

    counted = fake_activations(fake(bare), batch, None)
    assert counted == saved_activations(runner.model, batch, None)
    torch.distributed.destroy_process_group()


def test_both_of_two_processes_hold_everything(tmp_path):
    assert run_ranks(2, held, tmp_path) == [0, 0]
