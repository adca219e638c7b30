"""Peak memory, and messages for errors of a GPU, a host or data workers out of memory."""

from __future__ import annotations

import errno
import re
import sys

from fluxvla_core.errors import RunFailed

GB = 1e9
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
_LESS_HOST = (
    "lower --set train_dataloader.per_device_num_workers=… or --set "
    "train_dataloader.per_device_batch_size=…, or --set "
    "train_dataloader.dataset.cache_frames=false"
)
_GO_ON = "then resume with --resume auto: checkpoints are as they were"


def explain(error: BaseException, step: int | None = None) -> RunFailed | None:
    """Explain ``error`` if memory ran out here or in a loader worker; None for other errors."""
    text = str(error).strip()
    lower = text.lower()
    when = "" if step is None else f" at step {step}"
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
    what = "the GPU ran" if device else "this machine ran"
    if device:
        advice = (
            "lower --set train_dataloader.per_device_batch_size=… and raise --set "
            "runner.grad_accumulation_steps=… by as much (the result stays the same), or --set "
            "runner.enable_gradient_checkpointing=true, --set "
            "runner.enable_mixed_precision_training=true, or split the model: --set "
            "runner.type=FSDPTrainRunner"
        )
    else:
        advice = _LESS_HOST
    return RunFailed(
        f"{what} out of memory{when}",
        cause=_telling_line(text),
        next=f"{advice}; {_GO_ON}",
    )


def _of_host(error: BaseException, lower: str) -> bool:
    # The system refuses a fork, or to map a file, with an errno.
    refused = isinstance(error, OSError) and error.errno == errno.ENOMEM
    said = any(s in lower.replace(_NOT_HOST, "") for s in _HOST)
    return refused or said or isinstance(error, MemoryError)


def _telling_line(text: str) -> str | None:
    """The line of an error that says what there was no room for: a worker's ends with it."""
    lines = text.splitlines()
    found = [line for line in lines if any(s in line.lower() for s in (*_DEVICE, *_HOST))]
    return (found[-1:] or lines[:1] or [""])[0].strip()[:300] or None


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


def peak_bytes(cuda: bool) -> int:
    """The most that this process has held so far: on its GPU, else in all."""
    if cuda:
        import torch

        return int(torch.cuda.max_memory_allocated())
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024  # getrusage(2): kilobytes on Linux
