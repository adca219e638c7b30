"""Saving beside the training: the step loop waits for a copy in memory, not for the disk.

One checkpoint at a time is on its way. What a step changes anyhow is copied at once, and so is what
has to be gathered from several processes, one tensor after the other, because no device need have
room for all of it. Other weights, averages and optimizer state are copied in the saving thread
while the next forward and backward passes run, and the optimizer waits for that copy before it
changes them.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

from fluxvla_core.checkpoints.tensors import TensorFile
from fluxvla_core.train.distributed import World, agree


@dataclass
class _Job:
    """A checkpoint on its way: ``copied`` when nothing of the training is needed any more."""

    step: int
    copied: threading.Event = field(default_factory=threading.Event)
    warnings: list[str] = field(default_factory=list)
    path: Path | None = None
    error: BaseException | None = None
    thread: threading.Thread | None = None


@dataclass(frozen=True)
class Saved:
    """A checkpoint that has its name."""

    step: int
    path: Path
    warnings: tuple[str, ...]


class Saver:
    """Writes checkpoints of one run, in a thread of its own or at once.

    Args:
        world: the processes that save together.
        beside: use a thread.
        optimizer: waits, in its ``step``, for the copy; one without ``register_step_pre_hook``
            is copied before :meth:`start` returns.
    """

    def __init__(self, world: World, beside: bool, optimizer: Any = None) -> None:
        self.world, self.beside = world, beside
        self._threads = world
        if beside and world.size > 1:
            # The threads of all ranks talk while the training talks on the other groups.
            self._threads = replace(world, control=dist.new_group(backend="gloo"))
        self._job: _Job | None = None
        self._memory: dict[tuple[str, int], Tensor] = {}
        hook = getattr(optimizer, "register_step_pre_hook", None)
        self._waits = hook is not None
        if hook is not None and beside:
            hook(lambda *_: self.copied())

    def start(
        self,
        step: int,
        files: Sequence[TensorFile],
        write: Callable[[World, Iterable[TensorFile], Callable[[str], None]], Path],
    ) -> None:
        """Let ``write(world, files, warn)`` make the checkpoint of ``step``; all ranks call it.

        The one before must have been settled.
        """
        job = self._job = _Job(step)
        warn = job.warnings.append
        if not self.beside:
            self._run(job, lambda: write(self.world, files, warn))
            return
        gathered = [file.gathered(partial(self._copy_of, file.name)) for file in files]
        ready = _reached(self.world.device)
        job.thread = threading.Thread(
            target=self._run,
            args=(job, lambda: write(self._threads, self._held(job, gathered, ready), warn)),
            name=f"checkpoint-{step}",
            daemon=True,
        )
        job.thread.start()
        if not self._waits:
            self.copied()

    def copied(self) -> None:
        """Wait until weights and optimizer may change; needed before anything but a step does."""
        if self._job is not None and self._job.thread is not None:
            self._job.copied.wait()

    def settle(self, wait: bool) -> Saved | None:
        """What became of the checkpoint on its way; all ranks call it at the same step.

        Args:
            wait: for its end; otherwise None is returned while some rank still writes.

        Raises:
            RunFailed: it could not be saved.
        """
        job = self._job
        if job is None:
            return None
        if job.thread is not None:
            if not wait and agree(self.world, int(job.thread.is_alive())):
                return None
            job.thread.join()
        self._job = None
        if job.error is not None:
            raise job.error
        assert job.path is not None
        return Saved(job.step, job.path, tuple(job.warnings))

    def close(self) -> None:
        """Let the checkpoint on its way be finished, whatever becomes of it."""
        if self._job is not None and self._job.thread is not None:
            self._job.thread.join()

    def _run(self, job: _Job, work: Callable[[], Path]) -> None:
        try:
            job.path = work()
        except BaseException as error:  # noqa: BLE001 - raised by settle, in the training's thread
            job.error = error

    def _held(
        self, job: _Job, files: Sequence[TensorFile], ready: AbstractContextManager[object]
    ) -> Iterator[TensorFile]:
        """Copies of ``files``; all are made before the first is written."""
        try:
            with ready:
                held = [
                    replace(
                        file,
                        tensors=tuple(
                            self._copy_of(file.name, i, t) for i, t in enumerate(file.tensors)
                        ),
                    )
                    for file in files
                ]
        finally:
            job.copied.set()
        yield from held

    def _copy_of(self, file: str, index: int, tensor: Tensor) -> Tensor:
        return self._copy((file, index), tensor)

    def _copy(self, place: tuple[str, int], tensor: Tensor) -> Tensor:
        """``tensor`` in host memory that is kept from save to save, pinned if it is on a GPU."""
        kept = self._memory.get(place)
        if kept is None or kept.shape != tensor.shape or kept.dtype != tensor.dtype:
            kept = torch.empty(tensor.shape, dtype=tensor.dtype, pin_memory=tensor.is_cuda)
            self._memory[place] = kept
        if kept is tensor:
            return kept
        with torch.no_grad():
            return kept.copy_(tensor)


def _reached(device: torch.device) -> AbstractContextManager[object]:
    """Inside, a GPU copies beside the work that is enqueued later than now, and after the rest."""
    if device.type != "cuda":
        return nullcontext()
    stream = torch.cuda.Stream(device)  # type: ignore[no-untyped-call]
    stream.wait_stream(torch.cuda.current_stream(device))
    return torch.cuda.stream(stream)
