"""Memory and FLOPs of a training, counted on the meta device; peak memory.

The model is built on torch's meta device, and runs its forward pass with fake tensors, which have
shapes and dtypes only: a model of seven billion parameters is counted on a laptop. Weights,
gradients and optimizer state are exact. Activations are what autograd keeps for the backward pass
on a CPU, each storage once; other kernels of a GPU keep a little more or less.

Model FLOPs utilisation (MFU) is the share of what a device could compute that training makes use
of, as defined in Chowdhery et al. 2022 (PaLM, arXiv 2204.02311, appendix B): the model's own
forward and backward pass count, recomputing activations does not.
"""

from __future__ import annotations

import copy
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from fluxvla_core.training.model import (
    Layout,
    autocast,
    blocks_of,
    has_values,
    loss_of,
    nbytes,
    trainable,
)
from fluxvla_core.training.state import rng_state, set_rng_state

GB = 1e9
LEFT_OUT = (
    "fragmentation of the allocator",
    "the CUDA context",
    "NCCL's buffers",
    "workspaces of kernels",
    "temporaries inside an operation",
)
"""Memory that an estimate leaves out."""
_VALUE = torch.ops.aten._local_scalar_dense.default
_CAST = torch.ops.aten._to_copy.default


@dataclass(frozen=True)
class SavedActivations:
    """Bytes that a forward pass leaves for the backward pass.

    Args:
        activations: storages that autograd keeps, without weights, buffers and the batch.
        recomputed: those that stay where the model's units are computed again: the inputs of units,
            and all outside of units.
        largest_unit: those inside the largest unit, which are there again while it is recomputed.
        weight_copies: trained weights in the dtype that is computed in, which autocast makes.
        batch: the inputs.
    """

    activations: int
    recomputed: int
    largest_unit: int
    weight_copies: int
    batch: int


NO_ACTIVATIONS = SavedActivations(0, 0, 0, 0, 0)
"""The footprint if the batch is not known."""


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
        activations: kept by autograd; with recomputation the rest of them.
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
    layout: Layout, kept: SavedActivations, optimizer: int, averaged: bool, recompute: bool
) -> Footprint:
    """Add up the counted parts.

    Args:
        optimizer: bytes, of :func:`optimizer_bytes`.
        averaged: whether averaged weights are kept.
        recompute: whether the model's units are computed again in the backward pass.
    """
    return Footprint(
        parameters=layout.parameters,
        gradients=layout.gradients,
        optimizer=optimizer,
        averages=nbytes(t for group in layout.optimized for t in group) if averaged else 0,
        gathered=layout.gathered,
        weight_copies=kept.weight_copies,
        activations=kept.recomputed if recompute else kept.activations,
        recomputed=kept.largest_unit if recompute else 0,
        batch=kept.batch,
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
    from torch._subclasses.fake_tensor import FakeTensorMode

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
    from torch._subclasses.fake_tensor import FakeTensorMode

    dtypes, mode = gathered_as or {}, FakeTensorMode(allow_non_fake_inputs=True)

    def empty(name: str, tensor: Tensor) -> Tensor:
        with mode:
            return torch.empty(tensor.shape, dtype=dtypes.get(name, tensor.dtype))

    made = _copied(model, empty)
    made.__dict__["_fake_mode"] = mode
    return made


def on_meta(model: nn.Module) -> nn.Module:
    """A copy of ``model`` whose tensors have shapes and no memory."""
    return _copied(model, lambda name, tensor: tensor.detach().to("meta"))


def _copied(model: nn.Module, make: Callable[[str, Tensor], Tensor]) -> nn.Module:
    """A copy of ``model`` with other tensors: ``make(name, tensor)`` of each of its own."""
    known: dict[int, Any] = {}
    for name, parameter in model.named_parameters():
        known[id(parameter)] = nn.Parameter(make(name, parameter), parameter.requires_grad)
    for name, buffer in model.named_buffers():
        known[id(buffer)] = make(name, buffer)
    return copy.deepcopy(model, known)


def fake_activations(
    model: nn.Module, batch: Mapping[str, Any], dtype: torch.dtype | None
) -> SavedActivations:
    """:func:`saved_activations` of a model that :func:`fake` made; ``batch`` has tensors on a CPU.

    Raises:
        Exception: what a model raises that decides by the values of its inputs, or of its weights.
    """
    mode: Any = model.__dict__["_fake_mode"]
    inputs = {k: mode.from_tensor(v) if isinstance(v, Tensor) else v for k, v in batch.items()}
    with mode:
        return saved_activations(model, inputs, dtype)


def saved_activations(
    model: nn.Module, arguments: Mapping[str, Any], dtype: torch.dtype | None
) -> SavedActivations:
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
    with counter.in_units(model), counter, counter.hooks(), autocast(device, dtype):
        loss_of(model(**arguments), type(model).__name__)
    inside = {key: size for unit in counter.inside.values() for key, size in unit.items()}
    left = counter.outside | counter.entering
    units = (
        sum(size for key, size in unit.items() if key not in left)
        for unit in counter.inside.values()
    )
    return SavedActivations(
        activations=sum((counter.outside | inside).values()),
        recomputed=sum(left.values()),
        largest_unit=max(units, default=0),
        weight_copies=sum(counter.copies.values()),
        batch=nbytes(given),
    )


class _Counter(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Counts storages that autograd keeps; answers checks of values that fake tensors lack.

    Each of its tables is from a storage to its bytes: ``outside`` of the model's units, ``inside``
    of each of them, ``entering`` them, and ``copies`` of weights.
    """

    def __init__(self, model: nn.Module, given: Sequence[Tensor]) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self._own = {_key(t) for t in (*model.parameters(), *model.buffers(), *given)}
        self._trained = {id(p) for p in trainable(model).values()}
        self._held: list[Any] = []  # so that no other storage gets the place of one counted
        self._unit: int | None = None
        self.outside: dict[int, int] = {}
        self.inside: dict[int, dict[int, int]] = {}
        self.entering: dict[int, int] = {}
        self.copies: dict[int, int] = {}

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func is _VALUE and args[0].dtype is torch.bool and not has_values(args[0]):
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
    def in_units(self, model: nn.Module) -> Iterator[None]:
        """Context manager: records inputs and saved tensors of each of the model's units."""
        blocks = blocks_of(model)
        before = [block.__dict__.get("forward") for block in blocks]
        for number, block in enumerate(blocks):
            block.__dict__["forward"] = self._watched(number, block.forward)
        try:
            yield
        finally:
            for block, forward in zip(blocks, before, strict=True):
                block.__dict__.pop("forward")
                if forward is not None:
                    block.__dict__["forward"] = forward

    def _watched(self, number: int, forward: Callable[..., Any]) -> Callable[..., Any]:
        def run(*args: Any, **kwargs: Any) -> Any:
            if torch.is_grad_enabled():
                for value in tree_leaves((args, kwargs)):
                    if isinstance(value, Tensor) and _key(value) not in self._own:
                        self._hold(value, self.entering)
            around, self._unit = self._unit, number
            try:
                return forward(*args, **kwargs)
            finally:
                self._unit = around

        return run

    def _pack(self, tensor: Tensor) -> Tensor:
        key = _key(tensor)
        if key not in self._own and key not in self.copies:
            found = self.outside if self._unit is None else self.inside.setdefault(self._unit, {})
            self._hold(tensor, found)
        return tensor

    def _hold(self, tensor: Tensor, found: dict[int, int]) -> None:
        storage = tensor.untyped_storage()
        self._held.append(storage)
        found[_key(tensor)] = storage.nbytes()


def _key(tensor: Tensor) -> int:
    return int(tensor.untyped_storage()._cdata)


PEAK_TFLOPS: tuple[tuple[str, float], ...] = (
    ("B200", 2250.0),  # NVIDIA DGX B200 datasheet: 36 PFLOPS for eight, with sparsity
    ("H200 NVL", 835.5),  # NVIDIA H200 datasheet: 1671, with sparsity
    ("H200", 989.5),  # the same: 1979, with sparsity
    ("H100 NVL", 835.5),  # NVIDIA H100 datasheet: 1671, with sparsity
    ("H100 PCIe", 756.0),  # NVIDIA H100 datasheet of 2022: 1513, with sparsity
    ("H100", 989.5),  # NVIDIA H100 datasheet, SXM: 1979, with sparsity
    ("A100", 312.0),  # NVIDIA A100 datasheet
    ("L40S", 362.05),  # NVIDIA L40S datasheet
    ("L4", 121.0),  # NVIDIA L4 datasheet: 242, with sparsity
    ("RTX 4090", 165.2),  # NVIDIA Ada architecture whitepaper, table 2: with FP32 accumulation
)
"""Part of a device's name -> dense bf16 TFLOP/s by its maker; the first that fits counts.
Makers state twice as much for matrices with a fixed pattern of zeros, which training has not."""


def known_peak(name: str, dtype: torch.dtype | None) -> float | None:
    """TFLOP/s of the device called ``name`` computing in ``dtype``; None if nobody says."""
    if dtype is not torch.bfloat16:
        return None
    words = f" {name.replace('-', ' ')} "
    return next((peak for part, peak in PEAK_TFLOPS if f" {part} " in words), None)


def training_flops(skeleton: nn.Module, arguments: Mapping[str, Any]) -> int:
    """Operations of one forward and backward pass; ``arguments`` are a batch's, on any device."""
    from torch.utils.flop_counter import FlopCounterMode

    bare = {k: v.to("meta") if isinstance(v, Tensor) else v for k, v in arguments.items()}
    drawn = rng_state()
    try:
        with FlopCounterMode(display=False) as counter:
            torch.autograd.backward(loss_of(skeleton(**bare), type(skeleton).__name__))
    finally:
        set_rng_state(drawn)
    return int(counter.get_total_flops())


class Meter:
    """Computes the MFU of steps, once it has counted the operations of a batch.

    Args:
        skeleton: the model as :func:`on_meta` gives it.
        peak_tflops: what one device can do.
    """

    def __init__(self, skeleton: nn.Module, peak_tflops: float) -> None:
        self._skeleton: nn.Module | None = skeleton
        self.peak = peak_tflops * 1e12
        self.per_batch: int | None = None

    @classmethod
    def of(
        cls,
        model: nn.Module,
        device: torch.device,
        dtype: torch.dtype | None,
        peak_tflops: float | None,
    ) -> Meter | None:
        """A meter for ``model``; None on CPUs and on GPUs whose peak FLOP/s are not known."""
        if peak_tflops is None and device.type == "cuda":
            peak_tflops = known_peak(torch.cuda.get_device_name(device), dtype)
        return None if peak_tflops is None else cls(on_meta(model), peak_tflops)

    def count(self, arguments: Mapping[str, Any]) -> str | None:
        """Count with the arguments of one batch; why that cannot be done, None if it can.

        A model that decides by the values of its inputs cannot run on the meta device.
        """
        skeleton, self._skeleton = self._skeleton, None
        if skeleton is None:
            return None
        try:
            self.per_batch = training_flops(skeleton, arguments)
        except Exception as error:  # noqa: BLE001 - a number for people must not end the run
            return f"{type(error).__name__}: {error}".splitlines()[0]
        return None

    def mfu(self, batches: int, seconds: float) -> float | None:
        """Share of the peak in 0..1 that ``batches`` of one device in ``seconds`` make use of."""
        if self.per_batch is None or seconds <= 0:
            return None
        return self.per_batch * batches / seconds / self.peak


def peak_bytes(cuda: bool) -> int:
    """The most that this process has held so far: on its GPU, else in all."""
    if cuda:
        return int(torch.cuda.max_memory_allocated())
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024  # getrusage(2): kilobytes on Linux
