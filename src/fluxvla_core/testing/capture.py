"""Whether a model's denoising can be captured in a CUDA graph, found out without a GPU.

``Tape`` records what a function does operation by operation, into fixed memory, and replays it. It
refuses what a capture refuses: reading a value back to the host, a shape that depends on values,
and constants that are copied from the host. A replay only repeats operations on memory, as a graph
does, so that a number which the function worked out in Python is that of the recording.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from fluxvla_core.policies.execution import Function, Tensors, copy_into

_aten = torch.ops.aten
# What waits for the device, by the value that it gives to the host or to the size of its result.
_WAITING = {
    _aten._local_scalar_dense,
    _aten.item,
    _aten.is_nonzero,
    _aten.equal,
    _aten.nonzero,
    _aten.masked_select,
    _aten._unique2,
    _aten.unique_consecutive,
    _aten.unique_dim,
    _aten.bincount,
}
_INDEXING = {_aten.index, _aten.index_put, _aten.index_put_, _aten._index_put_impl_}
# A tensor of Python numbers: on a GPU a copy from memory that is not pinned.
_FROM_HOST = {_aten.lift_fresh, _aten.lift, _aten._to_cpu}


class Refused(AssertionError):
    """An operation that a capture does not allow."""


class NoWaiting(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Refuses operations that would wait for a GPU, or copy from the host.

    Raises:
        Refused: naming the operation.
    """

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        packet = func.overloadpacket
        if packet in _WAITING:
            raise Refused(f"{func} gives a value to the host: a GPU would be waited for")
        if packet in _INDEXING and any(t.dtype is torch.bool for t in _indices(args)):
            raise Refused(f"{func} by a mask: the size of the result depends on values")
        if packet in _FROM_HOST:
            raise Refused(f"{func} makes a tensor of numbers of the host: compute it beforehand")
        found = func(*args, **(kwargs or {}))
        devices = {t.device.type for t in tree_leaves((args, kwargs, found)) if _sized(t)}
        if len(devices) > 1:
            raise Refused(f"{func} copies between {' and '.join(sorted(devices))}")
        return found


class Tape:
    """``function`` as it was recorded with ``inputs``: the interface of ``CudaGraph``.

    Raises:
        Refused: the function could not be captured.
    """

    def __init__(self, function: Function, inputs: Tensors) -> None:
        self.inputs = dict(inputs)
        recorder = _Recorder()
        with recorder:
            self.outputs = dict(function(self.inputs))
        self._steps = recorder.steps

    @property
    def operations(self) -> int:
        """How many are replayed."""
        return len(self._steps)

    def __call__(self, inputs: Tensors) -> Tensors:
        copy_into(self.inputs, inputs)
        for func, args, kwargs, found in self._steps:
            again = func(*args, **kwargs)
            for old, new in zip(tree_leaves(found), tree_leaves(again), strict=True):
                if isinstance(old, Tensor) and old.data_ptr() != new.data_ptr():
                    old.copy_(new)
        return self.outputs


@contextmanager
def count_calls(model: torch.nn.Module) -> Iterator[Counter[str]]:
    """How often each of the model's modules is called inside, by name; those that are."""
    calls: Counter[str] = Counter()

    def note(name: str) -> Callable[..., None]:
        def add(*_: Any) -> None:
            calls[name] += 1

        return add

    handles = [m.register_forward_hook(note(name)) for name, m in model.named_modules()]
    try:
        yield calls
    finally:
        for handle in handles:
            handle.remove()


def check_capturable(function: Callable[[], Any]) -> Any:
    """What ``function`` gives, run while nothing may wait for a device.

    Raises:
        Refused: an operation of it would.
    """
    with NoWaiting():  # type: ignore[no-untyped-call]
        return function()


class _Recorder(NoWaiting):  # type: ignore[no-untyped-call]
    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.steps: list[tuple[Any, Any, Any, Any]] = []

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        found = super().__torch_dispatch__(func, types, args, kwargs)
        self.steps.append((func, args, dict(kwargs or {}), found))
        return found


def _indices(args: Any) -> list[Tensor]:
    return [part for part in args[1] if isinstance(part, Tensor)]


def _sized(value: Any) -> bool:
    """Whether ``value`` is a tensor with dimensions; a scalar is handed to a kernel by value."""
    return isinstance(value, Tensor) and value.dim() > 0
