"""Execution of a policy's model: ``eager``, ``compiled`` or as a CUDA ``graph``.

All three give the same actions, up to the rounding of sums in another order. A model that divides
its answer (``VLA.observe``, ``VLA.denoise``) is timed in two parts, and can be captured: all of its
denoising steps are then one graph, and what comes before them is another one where the model says
that it may be. Copies between host and device go through pinned memory that is kept, and nobody
waits for them; clocks take the seconds of an answer's parts without waiting either.

A step of a denoising loop is a hundred and more small kernels, each of which takes a GPU less time
than it takes the host to launch it. A graph launches them all at once. After torch's notes on CUDA
graphs:

- memory is fixed: inputs are copied into buffers that the graph reads, outputs lie in memory that
  it writes, until the next replay;
- before the capture the function runs on a side stream, so that libraries have allocated their
  workspaces and chosen their algorithms;
- the graph's memory is a pool of its own;
- what runs in other threads of the process (cameras, recording) does not spoil the capture:
  ``thread_local``;
- nothing in the function may wait for the device, or depend on a value; nothing in it draws random
  numbers (the noise is an input), so that there is no generator state to register.

What captures and what does not is tested on CPUs by ``fluxvla_core.testing.execution.Tape``, which
has the same interface and replays operation by operation.
"""

from __future__ import annotations

import inspect
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from fluxvla_core.contracts.contract import implements
from fluxvla_core.contracts.training import VLA
from fluxvla_core.errors import ConfigError
from fluxvla_core.training.model import compile_units

EXECUTIONS = ("eager", "compiled", "graph")
KEPT_SHAPES = 4
"""Recordings that are kept, one for each set of shapes; transforms pad, so that one is usual."""
Batch = Mapping[str, Any]
Tensors = Mapping[str, Tensor]
Function = Callable[[Tensors], Tensors]
WARM_UP = 3


class CapturedFunction(Protocol):
    """A function that was recorded with fixed memory."""

    @property
    def inputs(self) -> Tensors:
        """The memory that it reads."""

    @property
    def outputs(self) -> Tensors:
        """The memory that it writes."""

    def __call__(self, inputs: Tensors) -> Tensors:
        """Run it on ``inputs``, of the names, shapes and dtypes of the recording.

        The answer is ``outputs``, which the next call overwrites.
        """


Record = Callable[[Function, Tensors], CapturedFunction]
"""Records a function with inputs as :func:`static` gives them, or another recording's outputs."""


class CudaGraph:
    """``function`` as it was recorded with ``inputs``.

    Args:
        function: launches operations on its inputs and on tensors that stay where they are.
        inputs: the memory that it reads in every replay: see :func:`static`. What another graph
            writes may be among it.

    Raises:
        ConfigError: there is no GPU.
    """

    def __init__(self, function: Function, inputs: Tensors) -> None:
        check_gpu()
        self.inputs = dict(inputs)
        device = next(iter(self.inputs.values())).device
        with torch.cuda.device(device):
            side = torch.cuda.Stream()  # type: ignore[no-untyped-call]
            side.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(side):
                for _ in range(WARM_UP):
                    function(self.inputs)
            torch.cuda.current_stream().wait_stream(side)
            self._graph = torch.cuda.CUDAGraph()
            # ``torch.cuda.graph`` waits for the device and captures on a side stream of its own.
            with torch.cuda.graph(self._graph, capture_error_mode="thread_local"):
                self.outputs = dict(function(self.inputs))

    def __call__(self, inputs: Tensors) -> Tensors:
        copy_into(self.inputs, inputs)
        self._graph.replay()
        return self.outputs


def static(inputs: Tensors) -> dict[str, Tensor]:
    """Copies of ``inputs``, in memory for recordings; they can be written to in any mode."""
    with torch.inference_mode(False), torch.no_grad():
        return {name: value.detach().clone() for name, value in inputs.items()}


def copy_into(memory: Tensors, values: Tensors) -> None:
    """Copy ``values`` to ``memory`` of the same names in few launches; equal tensors are skipped.

    Raises:
        ValueError: other names, shapes or dtypes.
    """
    if memory.keys() != values.keys():
        raise ValueError(f"recorded with {sorted(memory)}, called with {sorted(values)}")
    moved = [name for name in memory if values[name] is not memory[name]]
    for name in moved:
        have, given = memory[name], values[name]
        if have.shape != given.shape or have.dtype != given.dtype:
            raise ValueError(
                f"{name} was recorded as {tuple(have.shape)} {have.dtype}, and is "
                f"{tuple(given.shape)} {given.dtype}"
            )
    if moved:
        torch._foreach_copy_(
            [memory[name] for name in moved], [values[name] for name in moved], non_blocking=True
        )


def check_gpu() -> None:
    """Refuse where nothing can be captured.

    Raises:
        ConfigError: there is no GPU.
    """
    if not torch.cuda.is_available():
        raise ConfigError(
            "execution 'graph' needs a GPU, and torch finds none",
            cause="CUDA graphs are a property of NVIDIA's GPUs",
            next="execution='compiled' or 'eager', or device='cuda' on a machine that has one",
        )


class Eager:
    """Operation by operation.

    What follows from the weights alone is computed anew for each answer, so that they may change.
    """

    caches_casts = True
    """Whether autocast may keep the weights that it has cast, which no capture allows."""

    def __init__(self, model: Any) -> None:
        self.model = model
        self.parts = Parts.of(model)

    def answer(self, batch: Batch, clock: Clock) -> Tensor:
        """``predict_action(**batch)``: normalised actions ``(B, T, D)``, until the next call."""
        if self.parts is None or continues(batch):
            actions: Tensor = self.model.predict_action(**batch)
            clock.mark("forward")
            return actions
        seen = self.model.observe(**self.parts.observation(batch))
        clock.mark("prefix")
        actions = self.model.denoise(seen, batch["noise"], self.tables())
        clock.mark("denoise")
        return actions

    def tables(self) -> Mapping[str, Tensor]:
        """The model's ``step_tables``."""
        found: Mapping[str, Tensor] = VLA.adapt(self.model).step_tables()
        return found


class Compiled(Eager):
    """With blocks that :func:`execution_of` has compiled.

    The tables are computed once: the weights must stay.
    """

    def __init__(self, model: Any) -> None:
        super().__init__(model)
        self._tables: Mapping[str, Tensor] | None = None

    def tables(self) -> Mapping[str, Tensor]:
        if self._tables is None:
            self._tables = super().tables()
        return self._tables


class Graphed(Compiled):
    """Compiled blocks, and all denoising steps launched at once.

    A chunk that continues another one is guided by gradients, or holds other rows from call to
    call: it is computed as ``Compiled`` does.

    Args:
        model: has ``observe`` and ``denoise``.
        record: what records.

    Raises:
        ConfigError: the model does not divide its answer.
    """

    caches_casts = False

    def __init__(self, model: Any, record: Record = CudaGraph) -> None:
        if Parts.of(model) is None:
            raise ConfigError(
                f"execution 'graph': {type(model).__name__} has no observe() and denoise(), the "
                "second of which would be captured",
                next="execution='compiled' or 'eager'",
            )
        super().__init__(model)
        self._record = record
        self._recorded: OrderedDict[Any, tuple[CapturedFunction | None, CapturedFunction]] = (
            OrderedDict()
        )

    def answer(self, batch: Batch, clock: Clock) -> Tensor:
        assert self.parts is not None
        if continues(batch):
            return super().answer(batch, clock)
        observation, noise = self.parts.observation(batch), batch["noise"]
        key = tuple(
            (n, t.shape, t.dtype) for n, t in sorted(batch.items()) if isinstance(t, Tensor)
        )
        if key not in self._recorded:
            self._recorded[key] = self._new(observation, noise)
            if len(self._recorded) > KEPT_SHAPES:
                self._recorded.popitem(last=False)
        self._recorded.move_to_end(key)
        observe, denoise = self._recorded[key]
        seen = (observe or self._observe)(observation)
        clock.mark("prefix")
        actions = denoise({**seen, _NOISE: noise})[_NOISE]
        clock.mark("denoise")
        return actions

    def _observe(self, observation: Batch) -> Tensors:
        seen: Tensors = self.model.observe(**observation)
        return seen

    def _new(
        self, observation: Tensors, noise: Tensor
    ) -> tuple[CapturedFunction | None, CapturedFunction]:
        """Record ``observe``, if the model allows it, and ``denoise``, which reads its memory."""
        tables = self.tables()

        def denoise(inputs: Tensors) -> Tensors:
            seen = {name: value for name, value in inputs.items() if name != _NOISE}
            return {_NOISE: self.model.denoise(seen, inputs[_NOISE], tables)}

        observe = None
        if VLA.adapt(self.model).observe_is_capturable:
            observe = self._record(self._observe, static(observation))
            seen: Mapping[str, Tensor] = observe.outputs
        else:
            seen = static(self._observe(observation))
        return observe, self._record(denoise, {**seen, **static({_NOISE: noise})})


@dataclass(frozen=True)
class Parts:
    """The parameters of a model's ``observe``; None: it takes any."""

    names: frozenset[str]

    @classmethod
    def of(cls, model: Any) -> Parts | None:
        """The parameters of ``model.observe``; None if it has no ``observe`` and ``denoise``."""
        if not (implements(model, VLA, "observe") and implements(model, VLA, "denoise")):
            return None
        return cls(frozenset(inspect.signature(model.observe).parameters))

    def observation(self, batch: Batch) -> dict[str, Any]:
        """The part of ``batch`` that belongs to the observation."""
        return {name: value for name, value in batch.items() if name in self.names}


def execution_of(name: str, model: Any, compiled: bool) -> Eager:
    """The way ``name`` of :data:`EXECUTIONS` for ``model``.

    All but ``eager`` compile its blocks by ``torch.compile``, for the shapes that they meet.

    Args:
        compiled: its blocks are compiled already.

    Raises:
        ConfigError: there is no such way, no GPU for it, or the model cannot be run so.
    """
    check_execution(name)
    if name == "eager":
        return Eager(model)
    made = Compiled(model) if name == "compiled" else Graphed(model)
    if not compiled:
        compile_units(model, dynamic=False)
    return made


def check_execution(name: str) -> None:
    """Refuse a name that is unknown, and what cannot be done here, before anything is built.

    Raises:
        ConfigError: see :func:`execution_of`.
    """
    if name not in EXECUTIONS:
        raise ConfigError(f"execution {name!r} is unknown; choose one of {', '.join(EXECUTIONS)}")
    if name == "graph":
        check_gpu()


def continues(batch: Batch) -> bool:
    """Whether a chunk is asked for that continues another one."""
    return "prev_actions" in batch


_NOISE = "noise"


class HostClock:
    """Times the parts of an answer, where an operation is done when its call returns."""

    def __init__(self) -> None:
        self._last = time.perf_counter()
        self._seconds: dict[str, float] = {}

    def mark(self, part: str) -> None:
        """``part`` ends here, where the next one begins."""
        now = time.perf_counter()
        self._seconds[part] = now - self._last
        self._last = now

    def seconds(self) -> dict[str, float]:
        """Part -> seconds; once the device has done all that it was given."""
        return dict(self._seconds)


class CudaClock:
    """As ``HostClock``, by CUDA events: a part that waits for the host to launch operations takes
    as long as that does."""

    def __init__(self) -> None:
        self._marks: list[tuple[str, Any]] = [("", _event())]

    def mark(self, part: str) -> None:
        self._marks.append((part, _event()))

    def seconds(self) -> dict[str, float]:
        pairs = zip(self._marks, self._marks[1:], strict=False)
        return {part: begun.elapsed_time(ended) / 1e3 for (_, begun), (part, ended) in pairs}


Clock = HostClock | CudaClock


def clock_of(device: str) -> Clock:
    """A clock that starts now, for ``device``."""
    return CudaClock() if torch.device(device).type == "cuda" else HostClock()


def _event() -> Any:
    event = torch.cuda.Event(enable_timing=True)  # type: ignore[no-untyped-call]
    event.record()
    return event


class Transfer:
    """Brings batches to a device, and answers back.

    A copy from pageable memory makes the host wait, and allocating pinned memory takes longer than
    the copy, so that it is kept, by name, shape and dtype. ``fetch`` waits for the device; until
    then the pinned memory of a batch may still be read. On a CPU nothing is copied.

    Args:
        device: where batches go.
        pinned: whether host memory is pinned; by default on CUDA devices.
    """

    def __init__(self, device: str, pinned: bool | None = None) -> None:
        self.device = torch.device(device)
        self._pinned = self.device.type == "cuda" if pinned is None else pinned
        self._kept: dict[str, Tensor] = {}

    def to_device(self, batch: Mapping[str, Any]) -> dict[str, Any]:
        """The tensors of ``batch`` on the device; other values stay as they are."""
        return {
            key: self._sent(key, value) if isinstance(value, Tensor) else value
            for key, value in batch.items()
        }

    def fetch(self, answer: Tensor) -> npt.NDArray[np.float32]:
        """``answer`` as an array of its own, once the device is done."""
        wide = answer.detach().float()
        if self.device.type == "cpu":
            return np.array(wide.numpy())
        host = self._buffer("answer", wide)
        host.copy_(wide, non_blocking=self._pinned)
        if self.device.type == "cuda":
            torch.cuda.current_stream(self.device).synchronize()
        return np.array(host.numpy())

    def _sent(self, key: str, value: Tensor) -> Tensor:
        if value.device == self.device or self.device.type == "cpu":
            return value
        if not self._pinned:
            return value.to(self.device)
        buffer = self._buffer(f"batch.{key}", value)
        buffer.copy_(value)
        return buffer.to(self.device, non_blocking=True)

    def _buffer(self, key: str, like: Tensor) -> Tensor:
        """Host memory for ``like``; that of the last call where it fits."""
        buffer = self._kept.get(key)
        if buffer is None or buffer.shape != like.shape or buffer.dtype != like.dtype:
            # In inference mode it would be a tensor that no other mode may write to.
            with torch.inference_mode(False):
                buffer = torch.empty(like.shape, dtype=like.dtype, pin_memory=self._pinned)
            self._kept[key] = buffer
        return buffer
