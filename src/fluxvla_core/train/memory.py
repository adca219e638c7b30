"""How much memory training took, and what to say when there was not enough."""

from __future__ import annotations

import sys

from fluxvla_core.errors import RunFailed

GB = 1e9
_DEVICE = ("cuda error: out of memory", "cublas_status_alloc_failed", "cuda out of memory")
_HOST = ("can't allocate memory", "not enough memory: you tried to allocate")


def explain(error: BaseException, step: int | None = None) -> RunFailed | None:
    """What ``error`` means if memory ran out; None if it is about something else."""
    text = str(error).strip()
    lower = text.lower()
    # By name: the class is torch's, and moved between its versions.
    device = type(error).__name__ == "OutOfMemoryError" or any(s in lower for s in _DEVICE)
    host = isinstance(error, MemoryError) or any(s in lower for s in _HOST)
    if not (device or host):
        return None
    what = "the GPU ran" if device else "this machine ran"
    when = "" if step is None else f" at step {step}"
    cause = text.splitlines()[0][:300] if text else None
    if device:
        advice = (
            "lower train_dataloader.per_device_batch_size and raise runner.grad_accumulation_steps "
            "by as much (the result stays the same), or set enable_gradient_checkpointing or "
            "enable_mixed_precision_training, or split the model with FSDPTrainRunner"
        )
    else:
        advice = (
            "lower train_dataloader.per_device_num_workers or per_device_batch_size, or set "
            "cache_frames=False in the dataset"
        )
    return RunFailed(
        f"{what} out of memory{when}",
        cause=cause,
        next=f"{advice}; then go on with --resume auto: checkpoints are as they were",
    )


def peak_bytes(cuda: bool) -> int:
    """The most that this process has held so far: on its GPU, else in all."""
    if cuda:
        import torch

        return int(torch.cuda.max_memory_allocated())
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024  # getrusage(2): kilobytes on Linux
