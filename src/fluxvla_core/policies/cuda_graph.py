"""A function of tensors as one CUDA graph: its kernels are launched by a single call.

A step of a denoising loop is a hundred and more small kernels, each of which takes a GPU less time
than it takes the host to launch it. A graph removes that. After torch's notes on CUDA graphs:

- memory is fixed: inputs are copied into buffers that the graph reads, outputs lie in memory that
  it writes, until the next replay;
- before the capture the function runs on a side stream, so that libraries have allocated their
  workspaces and chosen their algorithms;
- the graph's memory is a pool of its own;
- what runs in other threads of the process (cameras, recording) does not spoil the capture:
  ``thread_local``;
- nothing in the function may wait for the device, or depend on a value; nothing in it draws random
  numbers (the noise is an input), so that there is no generator state to register.

It needs a GPU. What captures and what does not is tested on CPUs by
``fluxvla_core.testing.execution.Tape``, which has the same interface and replays operation by
operation.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

import torch
from torch import Tensor

from fluxvla_core.errors import ConfigError

Tensors = Mapping[str, Tensor]
Function = Callable[[Tensors], Tensors]
WARM_UP = 3


class Recorded(Protocol):
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


Record = Callable[[Function, Tensors], Recorded]
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
    """Copy ``values`` to ``memory`` of the same names in few launches; what is there already stays.

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
