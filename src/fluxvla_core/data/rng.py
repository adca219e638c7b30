"""Random numbers as a function of what they are for, never of who happened to draw them.

A sample's noise follows from (seed, epoch, index) and an epoch's order from (seed, epoch), so
neither the number of ranks, nor the number of workers, nor a restart changes either. Philox is a
counter-based generator: the counter's high words say what the numbers are for, which keeps the
streams of two samples apart for 2^64 draws each.
Source: Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011.
"""

from __future__ import annotations

import random
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

DEFAULT_SEED = 42
"""Of datasets that have none and were told none by a run."""
_SAMPLE, _ORDER, _MIXTURE, _BATCH = 1, 2, 3, 4


def sample_rng(seed: int, epoch: int, index: int) -> np.random.Generator:
    """The generator of sample ``index`` in ``epoch``."""
    return _generator(seed, _SAMPLE, epoch, index)


def order_rng(seed: int, epoch: int) -> np.random.Generator:
    """The generator that shuffles ``epoch``."""
    return _generator(seed, _ORDER, epoch, 0)


def mixture_rng(seed: int, dataset: int, turn: int) -> np.random.Generator:
    """The generator that orders the ``turn``-th round through a mixture's ``dataset``."""
    return _generator(seed, _MIXTURE, turn, dataset)


@contextmanager
def global_generators(seed: int, epoch: int, index: int) -> Iterator[None]:
    """Seed python's, numpy's and torch's for the batch that begins with sample ``index``.

    Afterwards they are where they were. GPUs' are not touched: batches are made on CPUs.
    """
    import torch

    word = int(_generator(seed, _BATCH, epoch, index).bit_generator.random_raw())
    before = random.getstate(), np.random.get_state(legacy=False), torch.get_rng_state()
    random.seed(word)
    np.random.seed([word >> 32, word % 2**32])
    torch.default_generator.manual_seed(word)
    try:
        yield
    finally:
        random.setstate(before[0])
        np.random.set_state(before[1])
        torch.set_rng_state(before[2])


def _generator(seed: int, purpose: int, epoch: int, index: int) -> np.random.Generator:
    key = np.array([seed, purpose], dtype=np.uint64)
    counter = np.array([0, 0, index, epoch], dtype=np.uint64)
    return np.random.Generator(np.random.Philox(key=key, counter=counter))
