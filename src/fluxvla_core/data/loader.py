"""A torch ``DataLoader`` whose batches do not depend on the number of its workers."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import wait
from typing import Any

from fluxvla_core.contracts.reporter import Reporter, SilentReporter
from fluxvla_core.data.rng import DEFAULT_SEED, global_generators
from fluxvla_core.data.sampler import EpochSampler, SampleKey
from fluxvla_core.errors import ConfigError, FluxError

# Of malloc.h, and bytes: the largest piece that comes from the heap, and what the heap may keep.
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
_LARGE, _KEPT = 32 << 20, 1 << 30
_END_S = 1.0  # between the end of a connection and that of the process that had it


class Loader:
    """Batches without end, from ``sampler.start`` on; ``make_loader`` builds it.

    Prefetching runs ahead of training, so a position counts batches that were *used*:
    ``sampler.advance(start, used)``.
    """

    def __init__(self, inner: Any, sampler: EpochSampler) -> None:
        self.inner = inner
        self.sampler = sampler

    def __iter__(self) -> Iterator[Any]:
        batches = iter(self.inner)
        try:
            for batch in batches:
                if isinstance(batch, _Failed):
                    raise batch.error
                yield batch
        except (OSError, EOFError, RuntimeError) as error:
            # Seen first may be that a connection to it broke, or that it is not there.
            words = _killed(getattr(batches, "_workers", ()))
            if words is None:
                raise
            raise RuntimeError(words) from error
        finally:
            # One that was killed is told by torch at every child that ends, in the middle of
            # whatever is being done, for as long as a traceback keeps the others alive.
            end = getattr(batches, "_shutdown_workers", None)
            if end is not None:
                end()


def make_loader(
    dataset: Any,
    collator: Callable[[Sequence[Any]], Any],
    sampler: EpochSampler,
    num_workers: int = 0,
    pin_memory: bool = False,
    prefetch_factor: int = 2,
    multiprocessing_context: str | None = None,
    reporter: Reporter | None = None,
    seed: int = DEFAULT_SEED,
) -> Loader:
    """Load batches of ``dataset`` in the order of ``sampler``.

    Args:
        dataset: has ``get_sample(index, epoch)``, or ``get_samples(keys)`` for grouped reads;
            ``prepare(reporter)`` is called first where there is one.
        num_workers: 0 loads in this process. Workers inherit decoded frames by forking.
        pin_memory: for a GPU.
        multiprocessing_context: ``fork``, ``forkserver`` or ``spawn``; torch's default if None.
        reporter: is told how far ``prepare`` is.
        seed: with a batch's first sample, all that the global generators draw by while it is made.

    Raises:
        ConfigError: ``num_workers`` is negative.
    """
    import torch
    from torch.utils.data import DataLoader

    if num_workers < 0:
        raise ConfigError(f"per_device_num_workers must be at least 0, got {num_workers}")
    prepare = getattr(dataset, "prepare", None)
    if prepare is not None:
        prepare(reporter or SilentReporter())
    keyed: Any = _Keyed(dataset, collator, seed)
    inner: DataLoader[Any] = DataLoader(
        keyed,
        batch_sampler=sampler,
        collate_fn=_as_it_is,
        num_workers=num_workers,
        pin_memory=pin_memory,
        prefetch_factor=prefetch_factor if num_workers else None,
        multiprocessing_context=multiprocessing_context if num_workers else None,
        worker_init_fn=_begin_worker if num_workers else None,
        # The loader draws a base seed for its workers; from the global generator that draw
        # would make a resumed run differ from an uninterrupted one.
        generator=torch.Generator().manual_seed(0),
    )
    return Loader(inner, sampler)


def _begin_worker(worker: int) -> None:
    _keep_memory()
    _end_with_trainer()


def _keep_memory() -> None:
    """Let a worker use the memory of one batch's pictures for the next one's.

    A batch is freed as a whole once it was sent, and glibc then gives the pages back; to get them
    anew, zeroed, took a third of a worker's time. See mallopt(3).
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, _LARGE)
        mallopt(_M_TRIM_THRESHOLD, _KEPT)


def _end_with_trainer() -> None:
    """End a worker whose trainer was killed.

    torch's own watch looks at the parent process. With ``forkserver``, Python 3.14's default, that
    is the server, which in turn lives as long as its children: they would stay for good.
    """
    parent = multiprocessing.parent_process()
    assert parent is not None, "runs in a worker"

    def watch() -> None:
        wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=watch, name="fluxvla-trainer-watch", daemon=True).start()


def _killed(workers: Sequence[Any]) -> str | None:
    """What torch says of a worker that was killed, as one was that ends by a signal; else None."""
    until = time.monotonic() + _END_S
    for worker in workers:
        worker.join(max(0.0, until - time.monotonic()))
        if worker.exitcode is not None and worker.exitcode < 0:
            name = signal.strsignal(-worker.exitcode)
            return f"DataLoader worker (pid {worker.pid}) is killed by signal: {name}"
    return None


class _Failed:
    """An error on its way out of a worker: torch would rebuild it from its text alone."""

    def __init__(self, error: FluxError) -> None:
        self.error = error


class _Keyed:
    """What torch's fetcher sees: a dataset that is asked for a whole batch of keys.

    Workers begin with equal global generators on every rank and after every restart; so these are
    seeded for each batch, which then is the same whoever makes it, and left as they were.
    """

    def __init__(self, dataset: Any, collator: Callable[[Sequence[Any]], Any], seed: int) -> None:
        self.dataset = dataset
        self.collator = collator
        self.seed = seed

    def __getitems__(self, keys: list[SampleKey]) -> Any:
        try:
            with global_generators(self.seed, keys[0].epoch, keys[0].index):
                return self.collator(self._samples(keys))
        except FluxError as error:
            return _Failed(error)

    def _samples(self, keys: list[SampleKey]) -> Any:
        if hasattr(self.dataset, "get_samples"):
            return self.dataset.get_samples(keys)
        return [self.dataset.get_sample(key.index, key.epoch) for key in keys]


def _as_it_is(batch: Any) -> Any:
    return batch
