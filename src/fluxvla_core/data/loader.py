"""``DictCollator``, and a torch ``DataLoader`` whose batches do not depend on its worker count."""

from __future__ import annotations

import atexit
import ctypes
import multiprocessing
import signal
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from fluxvla_core.contracts.runner import Reporter, SilentReporter
from fluxvla_core.contracts.training import Collator, Dataset
from fluxvla_core.data.sampler import (
    DEFAULT_SEED,
    SampleKey,
    drop_kept_normal,
    global_generators,
)
from fluxvla_core.data.transforms.images import SCALE
from fluxvla_core.errors import ConfigError, DataError, FluxError
from fluxvla_core.signals import held_back, leave_stopping_to_the_parent

# Of malloc.h, and bytes: the largest piece that comes from the heap, and what the heap may keep.
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
_LARGE, _KEPT = 32 << 20, 1 << 30
_END_S = 1.0  # between the end of a connection and that of the process that had it


class DictCollator(Collator):
    """Collate samples: stack the keys that a model computes with, list the others.

    Args:
        keys: stacked into tensors of shape ``(batch, ...)``; every sample needs equal shapes.
        meta_keys: kept as plain lists, one entry a sample.

    What is left of normalising images (``image_scale``) is stacked without being listed.

    Keys that are configured but that no sample has are left out: one list serves datasets with
    and without ``embodiment_ids``.

    Raises:
        DataError: a sample has a key in neither list or one that another sample lacks, or its
            value cannot be stacked.
    """

    def __init__(
        self, keys: Sequence[str] | None = None, meta_keys: Sequence[str] | None = None
    ) -> None:
        self.keys = tuple(keys or ())
        self.meta_keys = tuple(meta_keys or ())

    def __call__(self, samples: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        if not samples:
            raise DataError("there are no samples to make a batch of")
        batch: dict[str, Any] = {}
        for sample in samples:
            _check_keys(samples[0], sample)
        for key in samples[0]:
            if key in self.keys or key == SCALE:
                batch[key] = _stack(key, [sample[key] for sample in samples])
            elif key in self.meta_keys:
                batch[key] = [sample[key] for sample in samples]
            else:
                raise DataError(
                    f"sample key {key!r} is in neither keys nor meta_keys of the collator",
                    next=f"add {key!r} to the collator's keys (to stack) or meta_keys (to list)",
                )
        return batch


class Loader:
    """An iterable of batches, as many as the sampler has; ``make_loader`` builds it."""

    def __init__(self, inner: Any) -> None:
        self.inner = inner

    def __iter__(self) -> Iterator[Any]:
        context = getattr(self.inner, "multiprocessing_context", None) or multiprocessing
        with held_back(context.get_start_method()):
            batches = iter(self.inner)
        workers = getattr(batches, "_workers", ())
        end = partial(_shut_down, batches, workers)
        # For an iterator that nobody closes: torch would send its workers SIGTERM, and wait.
        atexit.register(end)
        try:
            for batch in batches:
                if isinstance(batch, _Failed):
                    raise batch.error
                drop_kept_normal()
                yield batch
        except (OSError, EOFError, RuntimeError) as error:
            # Of a killed worker, the broken connection to it may be noticed first.
            message = _killed_message(workers)
            if message is None:
                raise
            raise RuntimeError(message) from error
        finally:
            # As long as a traceback keeps the other workers alive, torch reports the killed one
            # whenever any child ends, in the middle of whatever is being done.
            end()
            atexit.unregister(end)


def make_loader(
    dataset: Any,
    collator: Callable[[Sequence[Any]], Any],
    sampler: Iterable[list[SampleKey]],
    num_workers: int = 0,
    pin_memory: bool = False,
    prefetch_factor: int = 2,
    multiprocessing_context: str | None = None,
    reporter: Reporter | None = None,
    seed: int = DEFAULT_SEED,
) -> Loader:
    """Build a loader of batches of ``dataset`` in the order of ``sampler``.

    Args:
        dataset: a ``Dataset``, or an object with its methods; ``prepare(reporter)`` is called
            first, then ``get_samples(keys)`` for each batch.
        sampler: the keys of each batch.
        num_workers: 0 loads in this process. Workers inherit decoded frames by forking.
        pin_memory: for a GPU.
        multiprocessing_context: ``fork``, ``forkserver`` or ``spawn``; torch's default if None.
        reporter: gets the progress of ``prepare``.
        seed: with a batch's first sample, seeds the global generators while the batch is made.

    Raises:
        ConfigError: ``num_workers`` is negative.
    """
    import torch
    from torch.utils.data import DataLoader

    if num_workers < 0:
        raise ConfigError(f"per_device_num_workers must be at least 0, got {num_workers}")
    dataset = Dataset.adapt(dataset)
    dataset.prepare(reporter or SilentReporter())
    keyed: Any = _Keyed(dataset, collator, seed)
    inner: DataLoader[Any] = DataLoader(
        keyed,
        batch_sampler=sampler,
        collate_fn=_identity,
        num_workers=num_workers,
        pin_memory=pin_memory,
        prefetch_factor=prefetch_factor if num_workers else None,
        multiprocessing_context=multiprocessing_context if num_workers else None,
        worker_init_fn=_init_worker if num_workers else None,
        # The loader draws a base seed for its workers; from the global generator that draw
        # would make a resumed run differ from an uninterrupted one.
        generator=torch.Generator().manual_seed(0),
    )
    return Loader(inner)


def _init_worker(worker: int) -> None:
    # torch watches the parent process. With ``forkserver``, Python 3.14's default, that is the
    # server, which lives as long as its children: they would never end.
    leave_stopping_to_the_parent()
    sys.excepthook = partial(_report_unless_orphaned, sys.excepthook)
    _reuse_memory()


def _report_unless_orphaned(
    hook: Callable[..., Any], kind: type[BaseException], error: BaseException, trace: Any
) -> None:
    """Report an error of the thread that sends batches, unless the trainer is gone.

    A trainer that is killed while it fetches one breaks that connection; multiprocessing's
    ``resource_sharer`` calls ``sys.excepthook``, whose traceback would come before the cause.
    """
    if not issubclass(kind, EOFError | ConnectionError):
        hook(kind, error, trace)


def _reuse_memory() -> None:
    """Let a worker reuse the memory of one batch's images for the next.

    A batch is freed as a whole once it was sent, and glibc then returns the pages to the system;
    getting new, zeroed ones took a third of a worker's time. See mallopt(3).
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, _LARGE)
        mallopt(_M_TRIM_THRESHOLD, _KEPT)


def _shut_down(batches: Any, workers: Sequence[Any]) -> None:
    """Shut down the workers of torch's iterator; those that hang are killed."""
    try:
        if workers:
            batches._shutdown_workers()
    finally:
        for worker in workers:
            worker.kill()
            worker.join()


def _killed_message(workers: Sequence[Any]) -> str | None:
    """Torch's message for a killed worker, if a worker was ended by a signal; else None."""
    until = time.monotonic() + _END_S
    for worker in workers:
        worker.join(max(0.0, until - time.monotonic()))
        if worker.exitcode is not None and worker.exitcode < 0:
            name = signal.strsignal(-worker.exitcode)
            return f"DataLoader worker (pid {worker.pid}) is killed by signal: {name}"
    return None


class _Failed:
    """An error to send from a worker as it is: torch would rebuild it from its text alone."""

    def __init__(self, error: FluxError) -> None:
        self.error = error


class _Keyed:
    """The dataset as torch's fetcher sees it, which asks for a whole batch of keys.

    Workers start with equal global generators on every rank and after every restart. They are
    therefore seeded for each batch, which then is the same in every worker, and restored.
    """

    def __init__(
        self, dataset: Dataset, collator: Callable[[Sequence[Any]], Any], seed: int
    ) -> None:
        self.dataset = dataset
        self.collator = collator
        self.seed = seed

    def __getitems__(self, keys: list[SampleKey]) -> Any:
        try:
            with global_generators(self.seed, keys[0].epoch, keys[0].index):
                return self.collator(self.dataset.get_samples(keys))
        except FluxError as error:
            return _Failed(error)


def _identity(batch: Any) -> Any:
    return batch


def _check_keys(one: Mapping[str, Any], other: Mapping[str, Any]) -> None:
    differing = sorted(one.keys() ^ other.keys())
    if differing:
        without = other if differing[0] in one else one
        raise DataError(
            f"sample key {differing[0]!r} is missing in one sample of the batch; it has "
            f"{sorted(without)}",
            cause="datasets of a mixture that do not give the same, embodiment_id for example",
        )


def _stack(key: str, values: list[Any]) -> Any:
    import torch

    first = values[0]
    try:
        if isinstance(first, torch.Tensor):
            return torch.stack(values)
        if isinstance(first, np.ndarray | np.generic):
            return torch.from_numpy(np.stack(values))
    except (TypeError, ValueError, RuntimeError) as error:
        shapes = sorted({str(tuple(np.shape(value))) for value in values})
        raise DataError(
            f"sample key {key!r} cannot be stacked: shapes {', '.join(shapes)} ({error})"
        ) from error
    if key == "images" and isinstance(first, list):
        shapes = sorted({str(tuple(np.shape(image))) for image in first})
        raise DataError(
            f"the images of a sample are still a list, of shapes {', '.join(shapes)}",
            next="put a transform that makes one array of them (ResizeImages, NormalizeImages, the "
            "model family's own) into the dataset's transforms",
        )
    raise DataError(
        f"sample key {key!r} is listed in keys, but {type(first).__name__} cannot be stacked",
        next=f"move {key!r} to the collator's meta_keys",
    )
