"""What a dry run says of a process's memory is what the process then holds."""

from __future__ import annotations

import pytest
import torch

from fluxvla_core import build_runner_from_cfg, build_vla_from_cfg
from fluxvla_core.build import RunContext
from fluxvla_core.testing.training import KEYS, TinyDataset, run_ranks, tiny_config
from fluxvla_core.training.cost import optimizer_bytes
from fluxvla_core.training.model import ForwardArguments

# Odd widths, of which the second process has less; a parameter of one element, tied weights.
MODEL = {"width": 7, "assorted": True, "centred": True, "batch_norm": True}


def storages(tensors):
    """Bytes of the storages behind this process's parts of ``tensors``, each once."""
    local = [t.to_local() if hasattr(t, "to_local") else t for t in tensors]
    found = {t.untyped_storage()._cdata: t.untyped_storage().nbytes() for t in local}
    return sum(found.values())


def elements(tensors):
    local = [t.to_local() if hasattr(t, "to_local") else t for t in tensors]
    return sum(t.numel() * t.element_size() for t in local)


def held(work_dir, strategy, mixed, parts):
    config = tiny_config(
        {
            "type": "FSDPTrainRunner",
            "sharding_strategy": strategy,
            "enable_mixed_precision_training": mixed,
            "grad_accumulation_steps": parts,
            "max_steps": 1,
        },
        **MODEL,
    )
    context = RunContext(config=config, section="runner", work_dir=work_dir)
    runner = build_runner_from_cfg(config["runner"], context)
    with torch.device("meta"):
        bare = build_vla_from_cfg(config["model"])
    said = runner.memory_layout(bare, 2, "cpu")

    runner.run_setup(37)
    runner.vla.train()
    runner.forward_arguments = ForwardArguments(runner.model)
    dataset = TinyDataset()
    batch = runner.collator([dataset.get_sample(i, 0) for i in range(4)])
    assert set(batch) == set(KEYS)
    for part in range(parts):
        with runner.sync_gradients(part == parts - 1):
            loss = runner._training_step(batch)
            runner.backward(loss)
    parameters = list(runner.model.parameters())
    gradients = [p.grad for p in parameters if p.grad is not None]
    runner.optimizer_step()
    state = [v for s in runner.optimizer.state.values() for v in s.values()]
    if runner.world.rank == 0:
        assert said.parameters == storages([*parameters, *runner.model.buffers()])
        if parts == 1:
            assert said.gradients == storages(gradients)
        assert optimizer_bytes(runner.optimizer_settings.build, said.optimized) == elements(state)
    else:
        assert said.parameters == storages([*parameters, *runner.model.buffers()])
        assert optimizer_bytes(runner.optimizer_settings.build, said.optimized) > elements(state)
    names = dict(runner.model.named_parameters())
    assert set(said.gathered_as) <= set(names)
    torch.distributed.destroy_process_group()


@pytest.mark.parametrize("mixed", [False, True], ids=["float32", "bfloat16"])
@pytest.mark.parametrize("strategy", ["full-shard", "shard-grad-op", "hybrid-shard"])
def test_the_shards_of_two_processes(tmp_path, strategy, mixed):
    assert run_ranks(2, held, tmp_path, strategy, mixed, 1) == [0, 0]


def layout_of(processes, strategy="full-shard", **settings):
    config = tiny_config(
        {"type": "FSDPTrainRunner", "sharding_strategy": strategy, "max_steps": 1, **settings},
        width=64,
    )
    runner = build_runner_from_cfg(config["runner"], RunContext(config=config, section="runner"))
    with torch.device("meta"):
        bare = build_vla_from_cfg(config["model"])
    return runner.memory_layout(bare, processes, "cuda"), bare


def test_what_is_gathered_and_in_which_dtype():
    whole, model = layout_of(1)
    block = sum(p.numel() for p in model.blocks[0].parameters())
    head = sum(p.numel() for p in model.head.parameters())
    # The head stays, two blocks pass; gradients of the largest group are on their way.
    assert whole.gathered == 4 * (head + 2 * block) + 8 * block
    assert not whole.gathered_as
    lowered, _ = layout_of(1, enable_mixed_precision_training=True)
    assert lowered.gathered == 2 * (head + 2 * block) + 6 * block
    assert set(lowered.gathered_as) == {
        name for name, p in model.named_parameters() if p.requires_grad
    }
    assert set(lowered.gathered_as.values()) == {torch.bfloat16}


def test_more_processes_hold_less_and_accumulated_gradients_are_whole():
    one, model = layout_of(1)
    eight, _ = layout_of(8)
    frozen = sum(p.numel() * 4 for p in model.encoder.parameters()) + 8  # and the buffer
    assert eight.parameters - frozen < (one.parameters - frozen) / 7
    accumulating, _ = layout_of(8, grad_accumulation_steps=2)
    assert accumulating.gradients == one.gradients
    unsplit, _ = layout_of(8, "no-shard")
    assert unsplit.parameters == one.parameters
