"""The model in training: its blocks, its forward arguments and its loss."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn

from fluxvla_core.checkpoints.tensors import full_tensor
from fluxvla_core.contracts.training import VLA
from fluxvla_core.data.loader import IDS
from fluxvla_core.errors import ConfigError

# -- what a model declares -------------------------------------------------------------------


def units_of(model: nn.Module) -> list[tuple[nn.Module, ...]]:
    """The model's units, each as the modules that belong together; none if it names none."""
    named: Sequence[nn.Module | tuple[nn.Module, ...]] = VLA.adapt(model).fsdp_units()
    return [unit if isinstance(unit, tuple) else (unit,) for unit in named]


def blocks_of(model: nn.Module) -> list[nn.Module]:
    """All modules of all units, in their order."""
    return [module for unit in units_of(model) for module in unit]


def frozen_sources(model: nn.Module) -> dict[str, str]:
    """Name of each module that declares a ``frozen_source`` -> that source; ``""`` is the model."""
    found = ((name, getattr(m, "frozen_source", None)) for name, m in model.named_modules())
    return {name: str(source) for name, source in found if source is not None}


def set_frozen_source(model: nn.Module, source: str | None) -> None:
    """Declare where all of the model's frozen weights come from; None takes that back."""
    if source is None:
        model.__dict__.pop("frozen_source", None)
    else:
        model.__dict__["frozen_source"] = source


def observations_of(model: nn.Module) -> dict[str, int | None]:
    """``n_obs_steps`` and ``past_actions`` of a model, for ``check_observations``."""
    described = VLA.adapt(model)
    return {name: getattr(described, name) for name in ("n_obs_steps", "past_actions")}


# -- how its blocks and its forward pass compute ---------------------------------------------


def checkpoint_activations(model: nn.Module) -> None:
    """Recompute the model's ``fsdp_units`` in the backward pass instead of keeping their insides.

    Raises:
        ConfigError: the model names no units.
    """
    from torch.utils.checkpoint import checkpoint

    for unit in _named_blocks(model, "enable_gradient_checkpointing", "units to recompute"):
        unit.__dict__["forward"] = _recomputed(unit.forward, checkpoint)


def compile_units(model: nn.Module, dynamic: bool | None = None, backend: str = "inductor") -> None:
    """Compile each of the model's ``fsdp_units`` by itself; names and state stay as they are.

    Only what is inside a unit's ``forward``: what sharding does before and after it, and drawing
    noise and time, stay outside.

    Args:
        dynamic: as of ``torch.compile``; False compiles for each size, and None for any once a
            second one is met.
        backend: as of ``torch.compile``.

    Raises:
        ConfigError: the model names no units.
    """
    units = _named_blocks(model, "compile_blocks", "blocks to compile")
    # torch compiles a method for so many sizes only, and blocks of one class share it; it would not
    # compile the blocks of further sizes.
    limits = torch._dynamo.config
    limits.recompile_limit = max(limits.recompile_limit, len(units))
    for unit in units:
        unit.__dict__["forward"] = torch.compile(unit.forward, dynamic=dynamic, backend=backend)


def _named_blocks(model: nn.Module, option: str, purpose: str) -> list[nn.Module]:
    blocks = blocks_of(model)
    if not blocks:
        raise ConfigError(
            f"{option}: {type(model).__name__} names no {purpose}", cause="it has no fsdp_units()"
        )
    return blocks


def _recomputed(forward: Any, checkpoint: Any) -> Any:
    def run(*args: Any, **kwargs: Any) -> Any:
        return checkpoint(forward, *args, use_reentrant=False, **kwargs)

    return run


def autocast(device: torch.device, dtype: torch.dtype | None) -> AbstractContextManager[object]:
    """Compute in ``dtype`` inside; inputs, targets and reductions stay fp32."""
    if dtype is None:
        return nullcontext()
    return torch.autocast(device.type, dtype)


# -- on the meta device ----------------------------------------------------------------------


def has_values(tensor: Tensor) -> bool:
    """Whether a tensor has numbers, and not only a shape: for what looks at its inputs."""
    if type(tensor) is Tensor and not tensor.is_meta:
        return True
    from torch._subclasses.fake_tensor import FakeTensor

    return not (tensor.is_meta or isinstance(tensor, FakeTensor))


def built_without_memory() -> bool:
    """Whether models are built on the meta device now: then there are no weights to load."""
    return torch.get_default_device().type == "meta"


_FOLLOW: ContextVar[bool] = ContextVar("weights_follow", default=False)


def weights_follow() -> bool:
    """Whether the model that is built now gets a checkpoint's weights, or is on the meta device.

    Weights that it would start a training from need not be read then, nor be there.
    """
    return _FOLLOW.get() or built_without_memory()


@contextmanager
def before_its_weights() -> Iterator[None]:
    """Inside, :func:`weights_follow` is True: all weights are loaded into what is built here."""
    token = _FOLLOW.set(True)
    try:
        yield
    finally:
        _FOLLOW.reset(token)


# -- from a batch to a loss ------------------------------------------------------------------


class ForwardArguments:
    """Chooses, from a batch, the arguments of ``model.forward``: see ``VLA.batch_keys``.

    Lists (``meta_keys``) and ``sample_ids`` that the model does not take are left out; a tensor
    that it does not take is an error, because a mask under a wrong name would train silently
    without it.

    Raises:
        ConfigError: the model takes no such tensor, or lacks one that it needs.
    """

    def __init__(self, model: nn.Module, where: str | None = None) -> None:
        self._where = where
        self.model_name = type(model).__name__
        keys = VLA.adapt(model).batch_keys()
        self._any = keys is None
        self._taken = frozenset(keys or ())
        self._needed = {key for key, needed in (keys or {}).items() if needed}

    def __call__(self, batch: Mapping[str, Any]) -> dict[str, Any]:
        if self._any:
            return dict(batch)
        if not self._needed <= batch.keys():
            missing = sorted(self._needed - batch.keys())
            raise ConfigError(
                f"{self.model_name}.forward needs {', '.join(map(repr, missing))}, which the batch "
                f"does not have; it has {', '.join(sorted(batch))}",
                where=self._where,
                next="let a transform of the dataset make it, and list it in the collator's keys",
            )
        taken = {key: value for key, value in batch.items() if key in self._taken}
        if len(taken) == len(batch):
            return taken
        extra = sorted(
            key
            for key, value in batch.items()
            if key not in self._taken and key != IDS and isinstance(value, Tensor)
        )
        if extra:
            raise ConfigError(
                f"{self.model_name}.forward takes no {', '.join(map(repr, extra))}; "
                f"it takes {', '.join(sorted(self._taken))}",
                where=self._where,
                next="move what only describes from the collator's keys to meta_keys",
            )
        return taken


def loss_of(output: Any, model_name: str) -> Tensor:
    """The scalar ``output["loss"]`` of a model of class ``model_name``.

    Raises:
        ConfigError: the model returned something else.
    """
    loss = output.get("loss") if isinstance(output, Mapping) else None
    if not (isinstance(loss, Tensor) and loss.ndim == 0):
        raise ConfigError(f"{model_name}.forward must return a mapping with a scalar tensor 'loss'")
    return loss


def sample_losses_of(output: Any) -> Tensor | None:
    """``output["sample_losses"]``, ``(B,)``, if the model returns it: for the records."""
    losses = output.get("sample_losses") if isinstance(output, Mapping) else None
    return losses.detach() if isinstance(losses, Tensor) else None


def trainable(model: nn.Module) -> dict[str, nn.Parameter]:
    """Parameters that are trained, by name; a tied one once, under its first name."""
    return {name: p for name, p in model.named_parameters() if p.requires_grad}


def refuse_scalars(parameters: Mapping[str, nn.Parameter], runner: str, where: str | None) -> None:
    """Refuse parameters without dimensions, for a strategy that cuts along one.

    Raises:
        ConfigError: names one of them.
    """
    for name, parameter in parameters.items():
        if parameter.ndim == 0:
            raise ConfigError(
                f"{name} is a parameter without dimensions, which {runner} cannot split",
                where=where,
                cause="a parameter is split over the processes along a dimension",
                next="give it one, as nn.Parameter(torch.ones(1)) has, or use DDPTrainRunner",
            )


def decay_groups(model: nn.Module, weight_decay: float) -> list[dict[str, Any]]:
    """Two groups: matrices with ``weight_decay``; biases, norms and other vectors without.

    Raises:
        ConfigError: nothing is trainable.
    """
    parameters = trainable(model)
    if not parameters:
        raise ConfigError(
            "the model has no trainable parameter", cause="all of its parts are frozen"
        )
    decayed = {n: p for n, p in parameters.items() if p.ndim > 1 and not n.endswith("bias")}
    rest = [p for n, p in parameters.items() if n not in decayed]
    groups = [
        {"params": list(decayed.values()), "weight_decay": weight_decay},
        {"params": rest, "weight_decay": 0.0},
    ]
    return [group for group in groups if group["params"]]


def gradient_norm(parameters: list[nn.Parameter]) -> Tensor:
    """The norm of all gradients over all ranks, a scalar on the device."""
    return full_tensor(
        torch.nn.utils.get_total_norm([p.grad for p in parameters if p.grad is not None])
    )


def clip_(parameters: list[nn.Parameter], max_norm: float) -> Tensor:
    """Scale gradients in place so that their norm over all ranks is at most ``max_norm``.

    Returns:
        The norm before, a scalar on the device.
    """
    # Gathered once, here: torch.nn.utils.clip_grad_norm_ would do it again for the caller.
    norm = gradient_norm(parameters)
    torch.nn.utils.clip_grads_with_norm_(parameters, max_norm, norm)
    return norm


@dataclass(frozen=True)
class Layout:
    """Memory layout of a model on one process; the fullest, where they differ.

    Args:
        parameters: bytes of weights and buffers.
        gradients: bytes of gradients when the backward pass ends.
        optimized: what the optimizer is given, a sequence for each of its groups: tensors without
            memory (torch's meta device).
        gathered: bytes of weights that are put together to compute with, and of what exchanging
            gradients needs, at most at a time.
        gathered_as: name of a weight -> the dtype that it is gathered in, where it is another.
    """

    parameters: int
    gradients: int
    optimized: Sequence[Sequence[Tensor]]
    gathered: int = 0
    gathered_as: Mapping[str, torch.dtype] = field(default_factory=dict)


def replicated_layout(model: nn.Module) -> Layout:
    """The layout of data parallelism, and of one process: everything on every process."""
    groups = decay_groups(model, 0.0)
    return Layout(
        parameters=nbytes([*model.parameters(), *model.buffers()]),
        gradients=nbytes(trainable(model).values()),
        optimized=[[bare(p.shape, p.dtype) for p in group["params"]] for group in groups],
    )


def bare(shape: Sequence[int], dtype: torch.dtype) -> Tensor:
    """A tensor without storage."""
    return torch.empty(tuple(shape), dtype=dtype, device="meta")


def nbytes(tensors: Iterable[Tensor]) -> int:
    """Bytes of all their elements."""
    return sum(t.numel() * t.element_size() for t in tensors)
