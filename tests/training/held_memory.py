"""What a dry run says of a process's memory, and what the process then holds: for any model."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from fluxvla_core.build import RunContext, build_runner_from_cfg, build_vla_from_cfg
from fluxvla_core.training.cost import optimizer_bytes
from fluxvla_core.training.dry_run import activations_of
from fluxvla_core.training.model import ForwardArguments


def check_held(work_dir: Path, config: Mapping[str, Any], samples: Any, per_process: int) -> None:
    """Compare them after one step in float32; called in each of two processes.

    Args:
        config: ``model``, ``train_dataloader`` and ``runner`` of ``FSDPTrainRunner``.
        samples: the dataset; each process takes the first ``per_process``.
    """
    torch.distributed.init_process_group("gloo")
    context = RunContext(config=config, section="runner", work_dir=work_dir)
    runner = build_runner_from_cfg(config["runner"], context)
    with torch.device("meta"):
        bare = build_vla_from_cfg(config["model"])
    said = runner.memory_layout(bare, 2, "cpu")
    runner.run_setup(len(samples))
    runner.vla.train()
    model, optimizer = runner.model, runner.optimizer
    runner.forward_arguments = ForwardArguments(model)
    batch = runner.collator([samples.get_sample(i, 0) for i in range(per_process)])
    told = activations_of(bare, said, runner, batch)

    kept: dict[int, int] = {}
    held: list[Any] = []  # so that no other storage gets the place of one counted
    given = _storages(v for v in batch.values() if isinstance(v, Tensor))

    def pack(tensor: Tensor) -> Tensor:
        # While a unit computes, its parameters are the gathered ones.
        own = _storages((*model.parameters(), *model.buffers()))
        storage = tensor.untyped_storage()
        if storage._cdata not in own | given:
            held.append(storage)
            kept[storage._cdata] = storage.nbytes()
        return tensor

    with runner.sync_gradients(last=True):
        with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
            loss = runner._training_step(batch)
        runner.backward(loss)
    assert sum(kept.values()) == told.activations
    parameters = list(model.parameters())
    assert sum(_storages([*parameters, *model.buffers()]).values()) == said.parameters
    gradients = _storages(p.grad for p in parameters if p.grad is not None)
    assert sum(gradients.values()) == said.gradients
    runner.optimizer_step()
    states = [_local(v) for state in optimizer.state.values() for v in state.values()]
    size = sum(t.numel() * t.element_size() for t in states)
    most = optimizer_bytes(runner.optimizer_settings.build, said.optimized)
    # The last process may have a smaller part of a weight.
    assert size == most if runner.world.rank == 0 else 0 < size <= most
    torch.distributed.destroy_process_group()


def _local(tensor: Any) -> Tensor:
    found: Tensor = tensor.to_local() if hasattr(tensor, "to_local") else tensor
    return found


def _storages(tensors: Iterable[Any]) -> dict[int, int]:
    """Storage -> its bytes, of this process's parts."""
    found = [_local(t).untyped_storage() for t in tensors]
    return {storage._cdata: storage.nbytes() for storage in found}
