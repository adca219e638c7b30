"""What a dry run says of a process's memory is what DeepSpeed then holds."""

from __future__ import annotations

from importlib.util import find_spec

import pytest
import torch
from fluxvla_deepspeed.layout import partitioned

from fluxvla_core import build_runner_from_cfg, build_vla_from_cfg
from fluxvla_core.build import RunContext
from fluxvla_core.testing.training import TinyDataset, run_ranks, tiny_config
from fluxvla_core.training.cost import optimizer_bytes, state_bytes
from fluxvla_core.training.model import ForwardArguments

# Odd widths: parts are filled up.
MODEL = {"width": 7, "assorted": True, "dropout": 0.0}


def size(tensors):
    found = {t.untyped_storage()._cdata: t.untyped_storage().nbytes() for t in tensors}
    return sum(found.values())


def held_flat(runner, said):
    zero, parameters = runner.vla.optimizer, list(runner.model.parameters())
    flats = [*zero.bit16_groups_flat, *zero.single_partition_of_fp32_groups]
    frozen = [p for p in parameters if not p.requires_grad]
    assert size([*flats, *frozen, *runner.model.buffers()]) == said.parameters
    owned = {p.untyped_storage()._cdata for p in parameters if p.requires_grad}
    assert owned == {t.untyped_storage()._cdata for t in zero.bit16_groups_flat}


def held_split(runner, said):
    zero, parameters = runner.vla.optimizer, list(runner.model.parameters())
    parts = [p.ds_tensor for p in parameters]
    copies = zero.fp32_partitioned_groups_flat
    assert size([*parts, *copies, *runner.model.buffers()]) == said.parameters
    # The weights are nowhere else: those that are trained lie in flat groups.
    owned = {p.ds_tensor.untyped_storage()._cdata for p in parameters if p.requires_grad}
    assert owned == {t.untyped_storage()._cdata for t in zero.fp16_partitioned_groups_flat}
    gradients = [part for group in zero.averaged_gradients.values() for part in group]
    assert size([zero.grad_partitions_flat_buffer, *gradients]) == said.gradients


def held(work_dir, stage):
    torch.distributed.init_process_group("gloo")
    table = {"type": "DeepSpeedTrainRunner", "zero_stage": stage, "max_steps": 1}
    config = tiny_config(table, **MODEL)
    context = RunContext(config=config, section="runner", work_dir=work_dir)
    runner = build_runner_from_cfg(config["runner"], context)
    with torch.device("meta"):
        bare = build_vla_from_cfg(config["model"])
    said = runner.memory_layout(bare, 2, "cpu")

    runner.run_setup(37)
    runner.vla.train()
    runner.forward_arguments = ForwardArguments(runner.model)
    batch = runner.collator([TinyDataset().get_sample(i, 0) for i in range(4)])
    with runner.sync_gradients(last=True):
        runner.backward(runner._training_step(batch))
    (held_split if stage == 3 else held_flat)(runner, said)
    runner.optimizer_step()
    told = optimizer_bytes(runner.optimizer_settings.build, said.optimized)
    assert told == state_bytes(runner.optimizer)


@pytest.mark.slow
@pytest.mark.skipif(find_spec("deepspeed") is None, reason="DeepSpeed is not installed")
@pytest.mark.parametrize("stage", [1, 2, 3])
def test_the_parts_of_two_processes(tmp_path, stage):
    assert run_ranks(2, held, tmp_path, stage) == [0, 0]


def test_each_stage_divides_more():
    with torch.device("meta"):
        model = build_vla_from_cfg({"type": "TinyVLA", "width": 64})
    one, two, three = (partitioned(model, stage, 8) for stage in (1, 2, 3))
    assert one.gradients > 7 * two.gradients
    # Of a process's part there are two, besides the whole weights of stages 1 and 2.
    assert one.parameters == two.parameters > 4 * three.parameters
    parts = [sum(t.numel() for g in found.optimized for t in g) for found in (one, two, three)]
    trained = sum(p.numel() for p in model.parameters() if p.requires_grad)
    assert all(trained / 8 <= part < trained / 8 + 64 for part in parts)
