"""Explain errors that end a training: a GPU, a host or a data worker out of memory, a lost rank.

They are torch's, and known by their text; nothing here needs torch itself.
"""

from __future__ import annotations

import errno
import re
from typing import TYPE_CHECKING

from fluxvla_core.errors import RunFailed

if TYPE_CHECKING:
    from fluxvla_core.training.distributed import World

_DEVICE = (
    "cuda error: out of memory",
    "cuda out of memory",
    "cuda failure 2 'out of memory'",  # NCCL
    "cuda failure 'out of memory'",  # NCCL of old
    "cublas_status_alloc_failed",
    "cudnn_status_alloc_failed",
    "cudnn_status_internal_error_device_allocation_failed",  # cuDNN 9
)
_HOST = (
    "can't allocate memory",
    "cannot allocate memory",
    "not enough memory: you tried to allocate",
    "caught memoryerror",  # a loader worker's
    "unable to allocate",  # numpy, whose error torch cannot make again in the trainer
)
# The loader's of shared libraries, about a space of its own.
_NOT_HOST = "cannot allocate memory in static tls block"
# torch's words for a loader worker that is gone; signals as strsignal(3) has them.
_WORKER = re.compile(
    r"dataloader worker \(pid(?:\(s\))? ([\d, ]+)\) "
    r"(?:is killed by signal: ([\w ]+)|exited unexpectedly)"
)
_SHARED = (
    "killed by signal: bus error",
    "out of shared memory",
    "unable to write to file </torch",
    "unable to allocate shared memory(shm)",
)
# As gloo, c10d's store and NCCL's process group word it; the system's own words come through them.
_LOST = (
    "connection closed by peer",
    "connection was likely closed",
    "connection reset by peer",
    "connection refused",
    "connection timed out",
    "broken pipe",
    "socket closed",
    "socket unexpectedly closed",
    "socket timeout",
    "client socket has timed out",
    "client socket has failed to connect",
    "timed out waiting",
    "operation timed out",
    "seconds waiting for clients",
    "wait timeout after",
    "application timeout caused pair closure",
    "collective operation timeout",
    "nccl communicator was aborted",
    "nccl error",
)
_LESS_DEVICE = (
    "lower --set train_dataloader.per_device_batch_size=… and raise --set "
    "<section>.grad_accumulation_steps=… by as much (the result stays the same), or --set "
    "<section>.enable_gradient_checkpointing=true, --set "
    "<section>.enable_mixed_precision_training=true, or split the model: --set "
    "<section>.type=FSDPTrainRunner"
)
_LESS_HOST = (
    "lower --set train_dataloader.per_device_num_workers=… or --set "
    "train_dataloader.per_device_batch_size=…, or --set "
    "train_dataloader.dataset.cache_frames=false"
)
_GO_ON = "then resume with --resume auto: checkpoints are as they were"


def explain(
    error: BaseException, step: int | None = None, world: World | None = None
) -> RunFailed | None:
    """The error to raise for ``error``; None where nothing here explains it.

    Args:
        step: in which it happened.
        world: the processes that trained together.
    """
    known = _out_of_memory(error, "" if step is None else f" at step {step}")
    if known is None and world is not None and world.size > 1:
        known = _lost_rank(error, step, world)
    return known


def _out_of_memory(error: BaseException, when: str) -> RunFailed | None:
    """Memory ran out here or in a data worker."""
    text = str(error).strip()
    lower = text.lower()
    # torch may say that one is gone from an error that says how.
    origin = f"{lower}\n{error.__cause__ or ''}".lower()
    shared = any(s in origin for s in _SHARED)
    worker = max(_WORKER.finditer(origin), key=lambda m: bool(m[2]), default=None)
    if shared or worker is not None:
        return _worker_gone(worker, shared, when)
    # By name: the class is torch's, and moved between its versions.
    device = type(error).__name__ == "OutOfMemoryError" or any(s in lower for s in _DEVICE)
    if not (device or _of_host(error, lower)):
        return None
    lines = text.splitlines()
    # A worker's error ends with the line that says what there was no room for.
    found = [line for line in lines if any(s in line.lower() for s in (*_DEVICE, *_HOST))]
    return RunFailed(
        f"{'the GPU' if device else 'this machine'} ran out of memory{when}",
        cause=(found[-1:] or lines[:1] or [""])[0].strip()[:300] or None,
        next=f"{_LESS_DEVICE if device else _LESS_HOST}; {_GO_ON}",
    )


def _of_host(error: BaseException, lower: str) -> bool:
    # The system refuses a fork, or to map a file, with an errno.
    refused = isinstance(error, OSError) and error.errno == errno.ENOMEM
    said = any(s in lower.replace(_NOT_HOST, "") for s in _HOST)
    return refused or said or isinstance(error, MemoryError)


def _worker_gone(found: re.Match[str] | None, shared: bool, when: str) -> RunFailed:
    """A process that loads data has ended: of shared memory, by the system, or of a crash."""
    pid = "" if found is None else f" (pid {found[1]})"
    ending = None if found is None else found[2]
    if shared:
        what = f"a data worker{pid} ran out of shared memory{when}"
        cause = "/dev/shm is full, through which workers pass batches: a container has 64 MB of it"
        advice = (
            "make it larger (docker run --shm-size=8g; on Kubernetes an emptyDir with medium: "
            "Memory there), or --set train_dataloader.per_device_num_workers=0"
        )
    elif ending == "killed":
        what = f"a data worker{pid} was killed{when}"
        cause = "this machine, or its container, ran out of memory (see dmesg)"
        advice = _LESS_HOST
    else:
        how = f"ended: {ending}" if ending else "ended without an error message"
        what = f"a data worker{pid} {how}{when}"
        cause = "a crash below Python, as in a video decoder, or it was killed from outside"
        advice = (
            "run with --set train_dataloader.per_device_num_workers=0 and python -X faulthandler "
            "to see where it happens"
        )
    return RunFailed(what, cause=cause, next=f"{advice}; {_GO_ON}")


def _lost_rank(error: BaseException, step: int | None, world: World) -> RunFailed | None:
    """A collective operation broke because another process of the run is gone."""
    text = str(error).strip()
    # A loader worker's error comes with its traceback; an OSError is of this machine's own.
    elsewhere = text.lower().startswith("caught ") or isinstance(error, OSError)
    if elsewhere or not any(sign in text.lower() for sign in _LOST):
        return None
    return RunFailed(
        f"rank {world.rank} of {world.size} lost another rank during step {step}",
        cause="another process of this run ended; its own message says why ("
        f"{text.splitlines()[0][:200]})",
        next="fix what that message names, then run the same command with --resume auto",
        reason="rank lost",
    )
