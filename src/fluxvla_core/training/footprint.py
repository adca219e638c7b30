"""How much memory a training needs, counted on a model that has none.

The model is built on torch's meta device, and runs its forward pass with fake tensors, which have
shapes and dtypes only: a model of seven billion parameters is counted on a laptop. Weights,
gradients and optimizer state are exact. Activations are what autograd keeps for the backward pass
on a CPU, each storage once; other kernels of a GPU keep a little more or less.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensor, FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode

from fluxvla_core.training.layout import Layout, nbytes
from fluxvla_core.training.model import autocast, loss_of, units_of
from fluxvla_core.training.parameters import trainable

LEFT_OUT = (
    "fragmentation of the allocator",
    "the CUDA context",
    "NCCL's buffers",
    "workspaces of kernels",
    "temporaries inside an operation",
)
"""What an estimate does not know of."""
_VALUE = torch.ops.aten._local_scalar_dense.default
_CAST = torch.ops.aten._to_copy.default


@dataclass(frozen=True)
class Kept:
    """Bytes that a forward pass leaves for the backward pass.

    Args:
        activations: storages that autograd keeps, without weights, buffers and the batch.
        weight_copies: trained weights in the dtype that is computed in, which autocast makes.
        largest_unit: of ``activations``, those of one of the model's units.
        batch: the inputs.
    """

    activations: int
    weight_copies: int
    largest_unit: int
    batch: int


@dataclass(frozen=True)
class Footprint:
    """Bytes that one process needs on its device, when a step needs most.

    Args:
        parameters: weights and buffers.
        gradients: when the backward pass ends.
        optimizer: the optimizer's state.
        averages: the averaged weights (``ema_decay``).
        gathered: weights gathered from other processes, and gradients that are exchanged.
        weight_copies: weights in the dtype that is computed in.
        activations: what autograd keeps; with recomputation what is left of it.
        recomputed: the activations of one block that is computed again.
        batch: the inputs.
    """

    parameters: int
    gradients: int
    optimizer: int
    averages: int
    gathered: int
    weight_copies: int
    activations: int
    recomputed: int
    batch: int

    @property
    def total(self) -> int:
        """The sum of all."""
        return sum(asdict(self).values())

    def to_dict(self) -> dict[str, int]:
        """JSON values, with ``total``."""
        return {**asdict(self), "total": self.total}


def footprint(
    layout: Layout, kept: Kept, optimizer: int, averaged: bool, recomputed: Kept | None = None
) -> Footprint:
    """Put together what was counted.

    Args:
        kept: of the model as it is.
        optimizer: bytes, of :func:`optimizer_bytes`.
        averaged: whether averaged weights are kept.
        recomputed: of the model that recomputes its units, if it does.
    """
    left = kept if recomputed is None else recomputed
    return Footprint(
        parameters=layout.parameters,
        gradients=layout.gradients,
        optimizer=optimizer,
        averages=nbytes(t for group in layout.optimized for t in group) if averaged else 0,
        gathered=layout.gathered,
        weight_copies=left.weight_copies,
        activations=left.activations,
        recomputed=0 if recomputed is None else kept.largest_unit,
        batch=left.batch,
    )


def optimizer_bytes(
    build: Callable[[list[dict[str, Any]], float], torch.optim.Optimizer],
    groups: Sequence[Sequence[Tensor]],
) -> int:
    """Bytes of the state that an optimizer has after its first step.

    Args:
        build: of the optimizer's settings: ``build(groups, learning_rate)``.
        groups: the parameters, on any device; of one of processes that share them.
    """
    with FakeTensorMode():
        made = [
            {"params": [nn.Parameter(torch.empty(t.shape, dtype=t.dtype)) for t in group]}
            for group in groups
        ]
        for group in made:
            for parameter in group["params"]:
                parameter.grad = torch.empty_like(parameter)
        optimizer = build([{**group, "weight_decay": 0.0} for group in made], 1e-3)
        optimizer.step()
    return state_bytes(optimizer)


def state_bytes(optimizer: torch.optim.Optimizer) -> int:
    """Bytes of the tensors in an optimizer's state."""
    states = optimizer.state.values()
    return nbytes(v for state in states for v in state.values() if isinstance(v, Tensor))


def fake(model: nn.Module, gathered_as: Mapping[str, torch.dtype] | None = None) -> nn.Module:
    """A copy of ``model`` (on the meta device, or on any) of fake tensors on a CPU.

    Args:
        gathered_as: name of a weight -> its dtype there; that of the model by default.
    """
    dtypes = gathered_as or {}
    known: dict[int, Any] = {}
    with FakeTensorMode(allow_non_fake_inputs=True) as mode:
        for name, parameter in model.named_parameters():
            values = torch.empty(parameter.shape, dtype=dtypes.get(name, parameter.dtype))
            known[id(parameter)] = nn.Parameter(values, parameter.requires_grad)
        for buffer in model.buffers():
            known[id(buffer)] = torch.empty(buffer.shape, dtype=buffer.dtype)
    made = copy.deepcopy(model, known)
    made.__dict__["_fake_mode"] = mode
    return made


def kept_by_fake(model: nn.Module, batch: Mapping[str, Any], dtype: torch.dtype | None) -> Kept:
    """:func:`kept` of a model that :func:`fake` made; ``batch`` has tensors on a CPU.

    Raises:
        Exception: what a model raises that decides by the values of its inputs, or of its weights.
    """
    mode: FakeTensorMode = model.__dict__["_fake_mode"]
    inputs = {k: mode.from_tensor(v) if isinstance(v, Tensor) else v for k, v in batch.items()}
    with mode:
        return kept(model, inputs, dtype)


def kept(model: nn.Module, arguments: Mapping[str, Any], dtype: torch.dtype | None) -> Kept:
    """Count what the forward pass of a batch leaves for the backward pass.

    Args:
        model: of real tensors, or of fake ones.
        arguments: of its ``forward``, on the same device.
        dtype: of matrix products (autocast); None for that of the weights.
    """
    given = [v for v in arguments.values() if isinstance(v, Tensor)]
    counter = _Counter(model, given)
    device = next(model.parameters()).device
    model.train()
    with counter.attributed(model), counter, counter.hooks(), autocast(device, dtype):
        loss = loss_of(model(**arguments), type(model).__name__)
    assert loss.requires_grad or not trainable(model)
    return Kept(
        activations=sum(counter.found.values()),
        weight_copies=sum(counter.copies.values()),
        largest_unit=max(counter.by_unit.values(), default=0),
        batch=nbytes(given),
    )


class _Counter(TorchDispatchMode):
    """Counts storages that autograd keeps; answers checks of values that fake tensors lack."""

    def __init__(self, model: nn.Module, given: Sequence[Tensor]) -> None:
        super().__init__()
        own = [*model.parameters(), *model.buffers(), *given]
        self._own = {_key(tensor) for tensor in own}
        self._trained = {id(p) for p in trainable(model).values()}
        self._held: list[Any] = []  # so that no other storage gets the place of one counted
        self._unit: int | None = None
        self.found: dict[int, int] = {}
        self.copies: dict[int, int] = {}
        self.by_unit: dict[int, int] = {}

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func is _VALUE and isinstance(args[0], FakeTensor) and args[0].dtype is torch.bool:
            return False  # models ask so whether an input is wrong
        result = func(*args, **(kwargs or {}))
        if func is _CAST and id(args[0]) in self._trained:
            self._hold(result, self.copies)
        return result

    @contextmanager
    def hooks(self) -> Iterator[None]:
        with torch.autograd.graph.saved_tensors_hooks(self._pack, lambda tensor: tensor):
            yield

    @contextmanager
    def attributed(self, model: nn.Module) -> Iterator[None]:
        """What is kept inside of one of the model's units is counted by unit, too."""
        handles = []
        for number, unit in enumerate(units_of(model)):
            for module in unit:
                handles.append(module.register_forward_pre_hook(self._enters(number)))
                handles.append(module.register_forward_hook(self._enters(None)))
        try:
            yield
        finally:
            for handle in handles:
                handle.remove()

    def _enters(self, number: int | None) -> Callable[..., None]:
        def hook(*_: Any) -> None:
            self._unit = number

        return hook

    def _pack(self, tensor: Tensor) -> Tensor:
        key = _key(tensor)
        if key not in self._own and key not in self.found and key not in self.copies:
            size = self._hold(tensor, self.found)
            if self._unit is not None:
                self.by_unit[self._unit] = self.by_unit.get(self._unit, 0) + size
        return tensor

    def _hold(self, tensor: Tensor, found: dict[int, int]) -> int:
        storage = tensor.untyped_storage()
        self._held.append(storage)
        found[_key(tensor)] = storage.nbytes()
        return storage.nbytes()


def _key(tensor: Tensor) -> int:
    return int(tensor.untyped_storage()._cdata)
