"""The process group of a training: ranks and devices, values that ranks exchange, and its end.

Tensors of the model travel over NCCL on GPUs and gloo on CPUs. Everything small that the host
decides with (a stop, an error, a path) travels over a gloo group of its own, so that it never
waits for a device.
"""

from __future__ import annotations

import json
import os
import socket
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.distributed import PrefixStore, TCPStore  # type: ignore[attr-defined]
from torch.distributed.rendezvous import rendezvous

from fluxvla_core import errors
from fluxvla_core.errors import ConfigError, FluxError

LOOPBACK = "127.0.0.1"


@dataclass(frozen=True)
class World:
    """The rank of this process, and the size and device of its process group.

    Args:
        rank, size: global rank and number of processes.
        local_rank: rank on this machine, which is the index of its GPU.
        device: where the model lives.
        owned: whether :func:`start` made the process group, and :func:`stop` has to end it.
        control: gloo group for small host-side values; None for a single process.
    """

    rank: int
    size: int
    local_rank: int
    device: torch.device
    owned: bool = False
    control: Any = None

    @property
    def is_rank0(self) -> bool:
        """Whether this is global rank 0, which writes files and reports progress."""
        return self.rank == 0

    @property
    def first(self) -> bool:
        """Deprecated name of :attr:`is_rank0`."""
        message = "World.first is deprecated, use World.is_rank0"
        warnings.warn(message, DeprecationWarning, stacklevel=2)
        return self.is_rank0


def loopback_store() -> TCPStore:
    """A store by which ranks find each other, at a free port of the loopback interface alone.

    This process hosts it for as long as it keeps it. Anyone who reaches such a store can change
    where ranks connect to, and without a socket of ours torch listens on all interfaces. A port
    that is only found to be free may be another program's by the time somebody listens at it.
    """
    listener = socket.create_server((LOOPBACK, 0))
    port = listener.getsockname()[1]
    return TCPStore(
        LOOPBACK, port, 1, is_master=True, multi_tenant=True, master_listen_fd=listener.detach()
    )


def start(device: str = "auto", group_of_one: bool = False) -> World:
    """Join the process group that torchrun's environment describes; one process needs none.

    Args:
        device: ``auto`` (this rank's GPU if there is one), ``cpu`` or ``cuda``.
        group_of_one: make a process group for a single process too, as sharding needs.

    Raises:
        ConfigError: ``cuda`` without a GPU, more processes than GPUs, or an unknown device.
    """
    rank, size = int(os.environ.get("RANK", "0")), int(os.environ.get("WORLD_SIZE", "1"))
    local_rank = int(os.environ.get("LOCAL_RANK", "0"))
    place = _device(device, local_rank)
    owned = False
    if not dist.is_initialized() and (size > 1 or group_of_one):
        if size == int(os.environ.get("LOCAL_WORLD_SIZE", "1")):
            _stay_inside()
        backend = "nccl" if place.type == "cuda" else "gloo"
        store = _attempts_store() if size > 1 else dist.HashStore()  # type: ignore[attr-defined]
        dist.init_process_group(backend, store=store, rank=rank, world_size=size)
        owned = True
    if dist.is_initialized():
        rank, size = dist.get_rank(), dist.get_world_size()
    control = dist.new_group(backend="gloo") if size > 1 else None
    return World(rank, size, local_rank, place, owned, control)


def _stay_inside() -> None:
    """Let gloo and NCCL listen on the loopback alone: all processes are on this machine.

    Both accept any connection as a rank. NCCL still moves tensors over NVLink, PCIe or shared
    memory. Who names an interface gets that one.
    """
    loopback = next((name for _, name in socket.if_nameindex() if name in ("lo", "lo0")), None)
    for name in ("GLOO_SOCKET_IFNAME", "NCCL_SOCKET_IFNAME"):
        if loopback is not None:
            os.environ.setdefault(name, loopback)


def _attempts_store() -> Any:
    """The rendezvous store, with a prefix that no earlier attempt has used.

    torchrun keeps one store over all restarts of a job; by the names of the last attempt ranks
    would find addresses of processes that have ended.
    """
    store, _, _ = next(iter(rendezvous("env://")))
    attempt = os.environ.get("TORCHELASTIC_RESTART_COUNT", "0")
    return PrefixStore(f"attempt-{attempt}", store)


def _device(name: str, local_rank: int) -> torch.device:
    if name not in ("auto", "cpu", "cuda"):
        raise ConfigError(f"device {name!r} is not one of 'auto', 'cpu', 'cuda'")
    if name == "cuda" and not torch.cuda.is_available():
        raise ConfigError(
            "device is 'cuda', but torch finds no GPU here",
            cause=_why_no_gpu(),
            next="--set <section>.device=auto takes the CPU where there is no GPU",
        )
    if name == "cpu" or not torch.cuda.is_available():
        return torch.device("cpu")
    if local_rank >= torch.cuda.device_count():
        raise ConfigError(
            f"process {local_rank + 1} on this machine finds no GPU of its own: torch sees "
            f"{torch.cuda.device_count()}",
            cause="--nproc (or torchrun's --nproc-per-node) is larger than the number of GPUs",
            next=f"--nproc {torch.cuda.device_count()}, or --set <section>.device=cpu",
        )
    torch.cuda.set_device(local_rank)
    return torch.device("cuda", local_rank)


def _why_no_gpu() -> str:
    if torch.version.cuda is None:
        return f"torch {torch.__version__} was built for CPUs alone"
    return "no NVIDIA driver that torch can use, or CUDA_VISIBLE_DEVICES hides the GPUs"


def stop(world: World, failed: bool = False) -> None:
    """Leave the process group.

    After success all ranks wait for each other, so that none closes connections that another
    still reads from. After a failure waiting would hang.
    """
    if not (world.owned and dist.is_initialized()):
        return
    if not failed:
        dist.barrier(group=world.control)
    dist.destroy_process_group()


def all_reduce_max(world: World, value: int) -> int:
    """The largest ``value`` of all ranks, on every rank (all-reduce with MAX)."""
    if world.size == 1:
        return value
    box = torch.tensor([value], dtype=torch.int64)
    dist.all_reduce(box, dist.ReduceOp.MAX, group=world.control)
    return int(box)


def all_reduce_sum(world: World, values: Tensor) -> Tensor:
    """Sum of CPU ``values`` over all ranks, in place (all-reduce with SUM)."""
    if world.size > 1:
        dist.all_reduce(values, group=world.control)
    return values


def broadcast_text(world: World, text: str) -> str:
    """Rank 0's ``text`` on every rank (broadcast)."""
    if world.size == 1:
        return text
    data = torch.frombuffer(bytearray(text.encode()), dtype=torch.uint8) if text else None
    length = torch.tensor([0 if data is None else len(data)])
    dist.broadcast(length, 0, group=world.control)
    box = (
        data if world.is_rank0 and data is not None else torch.empty(int(length), dtype=torch.uint8)
    )
    if length:
        dist.broadcast(box, 0, group=world.control)
    return bytes(box.tolist()).decode()


def all_gather_text(world: World, text: str) -> list[str]:
    """Every rank's ``text`` on every rank, in the order of ranks (all-gather)."""
    if world.size == 1:
        return [text]
    data = text.encode()
    lengths = [torch.zeros(1, dtype=torch.int64) for _ in range(world.size)]
    dist.all_gather(lengths, torch.tensor([len(data)]), group=world.control)
    longest = max(int(length) for length in lengths)
    mine = torch.zeros(max(longest, 1), dtype=torch.uint8)
    if data:
        mine[: len(data)] = torch.frombuffer(bytearray(data), dtype=torch.uint8)
    boxes = [torch.empty_like(mine) for _ in range(world.size)]
    dist.all_gather(boxes, mine, group=world.control)
    return [bytes(box[: int(n)].tolist()).decode() for box, n in zip(boxes, lengths, strict=True)]


def run_on_rank0(world: World, work: Callable[[], str]) -> str:
    """Call ``work`` on rank 0 only; every rank gets its result, or raises its error.

    Without this a rank whose peer failed would wait for it in the next collective operation.
    """
    failure: FluxError | None = None
    answer = ""
    if world.is_rank0:
        try:
            answer = json.dumps({"answer": work()})
        except FluxError as error:
            failure = error
            fields = [error.what, error.where, error.cause, error.next]
            answer = json.dumps({"error": type(error).__name__, "fields": fields})
    reply = json.loads(broadcast_text(world, answer))
    if failure is not None:
        raise failure
    if "error" in reply:
        what, where, cause, advice = reply["fields"]
        raise getattr(errors, reply["error"], FluxError)(
            what, where=where, cause=cause, next=advice
        )
    return str(reply["answer"])


def broadcast_buffers(world: World, model: nn.Module) -> None:
    """Broadcast rank 0's saved buffers to all; a strategy's ``optimizer_step`` ends with it.

    Each rank changes them by its own batches (batch-norm statistics, a running normaliser), and a
    run continues with rank 0's. So they are equal on all ranks in what may come next: another
    step, a validation, a checkpoint. DDP does so by itself.
    """
    if world.size == 1:
        return
    # By name each time: a model may put another tensor in a buffer's place.
    buffers = [
        buffer.detach()
        for module in model.modules()
        for name, buffer in module.named_buffers(recurse=False)
        if name not in module._non_persistent_buffers_set
    ]
    for buffer in buffers:
        sent = buffer.contiguous()
        dist.broadcast(sent, 0)
        if sent is not buffer:
            buffer.copy_(sent)
