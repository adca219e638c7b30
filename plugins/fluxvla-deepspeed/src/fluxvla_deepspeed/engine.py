"""DeepSpeed's engine around a model and its optimizer, and their state by parameter name.

ZeRO trains flat fp32 copies, partitioned over the processes. The names, shapes and values of
the parameters that they are made of are put together again for checkpoints, which are therefore
those of any other strategy.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
from torch import Tensor, nn

from fluxvla_core.training import Stored, World


def start(
    model: nn.Module,
    optimizer: torch.optim.Optimizer,
    stage: int,
    max_grad_norm: float | None,
    compute_dtype: torch.dtype | None,
    world: World,
) -> Any:
    """DeepSpeed's engine for ``model``, with ``optimizer`` inside its ZeRO ``stage``.

    Args:
        max_grad_norm: gradients are scaled down to this norm; None leaves them.
        compute_dtype: of matrix products; None for fp32.
    """
    if world.device.type == "cpu":
        os.environ.setdefault("DS_ACCELERATOR", "cpu")
    # DeepSpeed insists on it, and a process that nobody launched has none.
    os.environ.setdefault("LOCAL_RANK", str(world.local_rank))
    import deepspeed

    if world.device.type == "cpu":
        # Its shared-memory kernels would be compiled on first use, and gloo is there already.
        deepspeed.ops.__compatible_ops__["deepspeed_shm_comm"] = False
    config: dict[str, Any] = {
        # Batches are counted, accumulated and divided by the core's loop.
        "train_micro_batch_size_per_gpu": 1,
        "gradient_accumulation_steps": 1,
        "gradient_clipping": max_grad_norm or 0.0,
        "zero_optimization": {"stage": stage},
        "zero_allow_untested_optimizer": True,
    }
    if compute_dtype is not None:
        # Weights and gradients stay fp32 on the wire, as with the other strategies.
        config["torch_autocast"] = {
            "enabled": True,
            "dtype": str(compute_dtype).removeprefix("torch."),
            "lower_precision_safe_modules": [],
        }
    engine, *_ = deepspeed.initialize(
        model=model, optimizer=optimizer, config=config, dist_init_required=False
    )
    return engine


def gathered(parameters: Iterable[nn.Parameter], stage: int) -> AbstractContextManager[object]:
    """Context manager: gathers the parameters; what rank 0 changes is then scattered to all."""
    if stage < 3:
        return nullcontext()
    import deepspeed

    context: AbstractContextManager[object] = deepspeed.zero.GatheredParameters(
        list(parameters), modifier_rank=0
    )
    return context


def put_master_weights(
    parameters: Mapping[str, nn.Parameter], values: Mapping[str, Tensor]
) -> None:
    """Let ZeRO's fp32 copies of ``parameters`` be the full ``values`` of the same names."""
    from deepspeed.utils import safe_set_full_fp32_param, safe_set_local_fp32_param

    for name, parameter in parameters.items():
        if name not in values:
            continue
        value = values[name].to(parameter.device, torch.float32)
        if _split(parameter):
            safe_set_local_fp32_param(parameter, _own_part(parameter, value))
        else:
            safe_set_full_fp32_param(parameter, value)


def on_host(tensor: Tensor, first: bool) -> Tensor:
    """A copy of a full tensor in host memory; an empty one but on the first rank."""
    return tensor.detach().to("cpu", copy=True) if first else tensor.new_empty(0)


def read_state(
    engine: Any,
    inner: torch.optim.Optimizer,
    parameters: Mapping[str, nn.Parameter],
    first: bool,
) -> dict[str, Tensor]:
    """The state of ``inner`` as full tensors ``<parameter>/<key>``; all ranks call it.

    They are in host memory, of the first rank; the others have empty ones.
    """
    from deepspeed.utils import safe_get_full_optimizer_state

    flats = [flat for flat in _flats(engine) if flat in inner.state]
    if not flats:
        return {}
    _link(engine, inner)
    found: dict[str, Tensor] = {}
    state = inner.state[flats[0]]
    for name, parameter in parameters.items():
        for key, value in state.items():
            if value.shape == flats[0].shape:
                value = safe_get_full_optimizer_state(parameter, key)
            # Else a count of steps: the same for all.
            found[f"{name}/{key}"] = on_host(value, first)
    return found


def put_state(
    engine: Any,
    inner: torch.optim.Optimizer,
    parameters: Mapping[str, nn.Parameter],
    tensors: Mapping[str, Tensor | Stored],
) -> None:
    """The inverse of :func:`read_state`, before the first step.

    A parameter that never had a gradient may have no state yet: it begins with zeros.
    """
    from deepspeed.utils import safe_set_full_optimizer_state, safe_set_local_optimizer_state

    shapes = {name: _shape(parameter) for name, parameter in parameters.items()}
    # By key, then by parameter: what is of the parameters' shapes is split, a count is not.
    state: dict[str, dict[str, Tensor | Stored]] = {}
    for place in sorted(tensors):
        name, _, key = place.rpartition("/")
        state.setdefault(key, {})[name] = tensors[place]
    split = {
        key: found
        for key, found in state.items()
        if all(value.shape == shapes[name] for name, value in found.items())
    }
    for flat in _flats(engine):
        inner.state[flat] = {
            key: torch.zeros_like(flat)
            if key in split
            else _whole(next(iter(found.values()))).to(flat.device)
            for key, found in state.items()
        }
    _link(engine, inner)
    for name, parameter in parameters.items():
        for key in (key for key, found in split.items() if name in found):
            value = _whole(tensors[f"{name}/{key}"]).to(parameter.device)
            if _split(parameter):
                safe_set_local_optimizer_state(parameter, _own_part(parameter, value), key)
            else:
                safe_set_full_optimizer_state(parameter, value, key)


def _split(parameter: nn.Parameter) -> bool:
    """Whether each process holds a part of this parameter, as with stage 3."""
    return hasattr(parameter, "ds_tensor")


def _own_part(parameter: nn.Parameter, value: Tensor) -> Tensor:
    """This process's part of the full ``value``, filled up with zeros to the size that ZeRO gives
    every process.

    DeepSpeed's own functions for full values cut beyond the end of one that cannot be divided by
    the number of processes.
    """
    split: Any = parameter
    size = split.ds_tensor.ds_numel
    begin = size * torch.distributed.get_rank(split.ds_process_group)
    part = value.flatten()[begin : begin + size]
    return nn.functional.pad(part, (0, size - part.numel()))


def _link(engine: Any, inner: torch.optim.Optimizer) -> None:
    """Let parameters know where in the flat state theirs is.

    Stages 1 and 2 do so themselves after the step of their first group, when the other groups have
    no state yet.
    """
    from deepspeed.utils.mixed_precision_linkage import lazy_init_hp_params_optimizer_state

    zero = engine.optimizer
    if hasattr(zero, "single_partition_of_fp32_groups"):
        for group, flat in zip(zero.bit16_groups, _flats(engine), strict=True):
            lazy_init_hp_params_optimizer_state(group, flat, inner.state)


def _flats(engine: Any) -> list[Tensor]:
    """ZeRO's flat fp32 copies of this rank, which the inner optimizer steps."""
    zero = engine.optimizer
    stages_1_and_2 = getattr(zero, "single_partition_of_fp32_groups", None)
    return list(zero.fp32_partitioned_groups_flat if stages_1_and_2 is None else stages_1_and_2)


def _shape(parameter: nn.Parameter) -> torch.Size:
    return torch.Size(getattr(parameter, "ds_shape", parameter.shape))


def _whole(tensor: Tensor | Stored) -> Tensor:
    return tensor[tuple(slice(0, n) for n in tensor.shape)].clone()
