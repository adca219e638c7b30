"""The kit for models that divide their answer (``VLA.observe`` and ``VLA.denoise``).

Whether the denoising can be captured in a CUDA graph is found out without a GPU: ``Tape`` records
what a function does operation by operation, into fixed memory, and replays it. It refuses what a
capture refuses: reading a value back to the host, a shape that depends on values, and constants
that are copied from the host. A replay only repeats operations on memory, as a graph does, so that
a number which the function computed in Python is that of the recording.
"""

from __future__ import annotations

from abc import abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from fluxvla_core.policies.cuda_graph import Function, Tensors, copy_into
from fluxvla_core.policies.execution import Compiled, Eager, Graphed, HostClock, Parts
from fluxvla_core.policies.inference_weights import store_in_bf16
from fluxvla_core.training.model import blocks_of, compile_units

CLOSE = 1e-5
"""Relative: sums in another order, in float32."""
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


class ExecutionConformance:
    """However it is executed, a model gives the same actions; and its steps can be captured.

    Subclass it and define :meth:`model` and :meth:`batches`. Nothing here needs a GPU: a capture is
    played by :class:`Tape`.
    """

    kinds = 8
    """The largest number of graphs: kinds of blocks, not blocks. torch gives up on a method that it
    has compiled eight times."""

    @abstractmethod
    def model(self) -> Any:
        """A small model in evaluation mode."""

    @abstractmethod
    def batches(self) -> Sequence[Mapping[str, Any]]:
        """Two or more different batches of the same shapes, as ``predict_action`` takes them."""

    def test_its_two_parts_are_its_answer(self) -> None:
        model, batch = self.model(), self.batches()[0]
        clock = HostClock()
        with torch.inference_mode():
            _same(Eager(model).answer(batch, clock), model.predict_action(**batch))
        assert list(clock.seconds()) == ["prefix", "denoise"]

    def test_a_recording_gives_each_batch_its_own_answer(self) -> None:
        model, batches = self.model(), self.batches()
        execution = Graphed(model, Tape)
        with torch.inference_mode():
            expected = [model.predict_action(**batch) for batch in batches]
            for number in (0, 1, 0):
                found = execution.answer(batches[number], HostClock())
                _same(found, expected[number])
        gap = float((expected[0] - expected[1]).abs().max())
        assert gap > CLOSE, f"the batches' answers are only {gap:.2g} apart"

    def test_the_steps_wait_for_nothing(self) -> None:
        """No value is read back, no shape depends on one, nothing is copied from the host."""
        model, batch = self.model(), self.batches()[0]
        parts = Parts.of(model)
        assert parts is not None
        observation = parts.observation(batch)
        with torch.inference_mode():
            seen, tables = model.observe(**observation), model.step_tables()
            check_capturable(lambda: model.denoise(seen, batch["noise"], tables))
            if model.observe_is_capturable:
                check_capturable(lambda: model.observe(**observation))

    def test_the_steps_meet_nothing_of_the_host(self) -> None:
        """On the meta device, where a tensor of the host's is another device's, as on a GPU."""
        model, batch = self.model(), self.batches()[0]
        parts = Parts.of(model)
        assert parts is not None
        observation = parts.observation(batch)
        with torch.inference_mode():
            seen, tables = model.observe(**observation), model.step_tables()
            bare = model.to("meta")
            there = [_bare(group) for group in (seen, tables, observation)]
            noise = batch["noise"].to("meta")
            found = check_capturable(lambda: bare.denoise(there[0], noise, there[1]))
            if model.observe_is_capturable:
                again = check_capturable(lambda: bare.observe(**there[2]))
                shapes = {name: (t.shape, t.dtype) for name, t in again.items()}
                assert shapes == {name: (t.shape, t.dtype) for name, t in seen.items()}
        assert found.shape == batch["noise"].shape

    def test_a_model_s_memory_is_computed_once(self) -> None:
        """Blocks that do not see the noise run once an answer, whatever the number of steps."""
        model, batch = self.model(), self.batches()[0]
        parts = Parts.of(model)
        assert parts is not None
        with torch.inference_mode():
            with count_calls(model) as early:
                seen = model.observe(**parts.observation(batch))
            with count_calls(model) as late:
                model.denoise(seen, batch["noise"], model.step_tables())
        blocks = {id(block) for block in blocks_of(model)}
        names = [name for name, module in model.named_modules() if id(module) in blocks]
        again = [name for name in names if early[name] > 1 or (early[name] and late[name])]
        assert not again, f"computed more than once an answer: {', '.join(again)}"

    def test_bf16_weights_are_what_autocast_makes_of_them(self) -> None:
        model, batch = self.model(), self.batches()[0]
        with torch.inference_mode(), torch.autocast("cpu", torch.bfloat16):
            expected = model.predict_action(**batch).clone()
            store_in_bf16(model)
            found = model.predict_action(**batch)
        kept = {p.dtype for module in model.exact_modules() for p in module.parameters()}
        assert kept <= {torch.float32}, f"exact_modules() were stored as {kept}"
        assert torch.equal(found, expected), f"{float((found - expected).abs().max()):.3g} apart"

    def test_its_blocks_are_compiled_once_by_kind(self) -> None:
        """And not again for the next batch. The code is not translated, which takes a minute."""
        model, batches = self.model(), self.batches()
        execution, counts = Compiled(model), []
        with _forgotten(), torch.inference_mode():
            expected = [model.predict_action(**batch) for batch in batches]
            compile_units(model, dynamic=False, backend="eager")
            for number in (0, 1):
                found = execution.answer(batches[number], HostClock())
                _same(found, expected[number])
                counts.append(torch._dynamo.utils.counters["stats"]["unique_graphs"])
        blocks = len(blocks_of(model))
        assert counts[0] > 0, "nothing was compiled: does predict_action() call its blocks?"
        assert counts[1] == counts[0], f"the second answer compiled {counts[1] - counts[0]} more"
        assert counts[0] <= self.kinds, (
            f"{blocks} blocks were compiled as {counts[0]} graphs, {self.kinds} kinds are expected"
        )


def _same(found: Tensor, expected: Tensor) -> None:
    gap = float((found - expected).abs().max()) / float(expected.abs().max())
    assert gap < CLOSE, f"{gap:.3g} apart, of the largest number"


def _bare(tensors: Mapping[str, Any]) -> dict[str, Any]:
    return {n: t.to("meta") if isinstance(t, Tensor) else t for n, t in tensors.items()}


@contextmanager
def _forgotten() -> Iterator[None]:
    """Discard everything that was compiled before, and is compiled inside."""
    torch._dynamo.reset()
    torch._dynamo.utils.counters.clear()
    try:
        yield
    finally:
        torch._dynamo.reset()


# -- captures -------------------------------------------------------------------------------------


class Refused(AssertionError):
    """An operation that a capture does not allow."""


class NoWaiting(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Refuses operations that would wait for a GPU or copy from the host.

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
    """Count the calls of the model's modules inside, by name."""
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
    """Run ``function`` while nothing may wait for a device.

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
