"""Seeds, and the state of all random generators: python, numpy, torch, CUDA."""

from __future__ import annotations

import random
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from fluxvla_core.contracts.training import Dataset
from fluxvla_core.data.sampler import order_rng


def seed_all(seed: int) -> None:
    """Seed python, numpy, torch and, where there is one, the GPU."""
    random.seed(seed)
    np.random.seed(seed % 2**32)
    torch.manual_seed(seed)


def take_seed(dataset: Any, seed: int) -> None:
    """Let ``dataset`` draw by ``seed``, unless it has one of its own or knows of none."""
    Dataset.adapt(dataset).use_seed(seed)


def seeds_of(dataset: Any) -> list[int | None]:
    """Seeds of ``dataset`` and then of the datasets that it is made of; None if unknown."""
    described = Dataset.adapt(dataset)
    seed, parts = described.seed, described.datasets
    below = [s for part in parts for s in seeds_of(part)] if isinstance(parts, list) else []
    return [seed if isinstance(seed, int) else None, *below]


def rank_seed(seed: int, rank: int, step: int = 0) -> int:
    """A seed for what a rank's own layers draw (dropout), different for every rank and step."""
    # The order itself takes numbers from the head of this stream; ranks are a jump away.
    stream = cast(np.random.Philox, order_rng(seed, step).bit_generator)
    return int(stream.jumped(rank + 1).random_raw()) >> 1


def rng_state() -> dict[str, Tensor]:
    """Everything needed to continue drawing where this process is; sizes are equal on all ranks."""
    version, words, gauss = random.getstate()
    _, key, position, has_gauss, cached = np.random.get_state(legacy=True)
    state = {
        "python": torch.tensor([version, *words], dtype=torch.int64),
        "python_gauss": torch.tensor(
            [gauss is not None, gauss if gauss is not None else 0.0], dtype=torch.float64
        ),
        "numpy": torch.from_numpy(np.asarray(key).astype(np.int64)),
        "numpy_position": torch.tensor([position, has_gauss], dtype=torch.int64),
        "numpy_gauss": torch.tensor([cached], dtype=torch.float64),
        "torch": torch.get_rng_state(),
    }
    if torch.cuda.is_available():
        state["cuda"] = torch.cuda.get_rng_state()
    return state


def set_rng_state(state: dict[str, Tensor]) -> None:
    """The inverse of :func:`rng_state`."""
    version, *words = state["python"].tolist()
    has, gauss = state["python_gauss"].tolist()
    random.setstate((version, tuple(words), gauss if has else None))
    position, has_gauss = state["numpy_position"].tolist()
    key = state["numpy"].numpy().astype(np.uint32)
    cached = state["numpy_gauss"].item()
    np.random.set_state(("MT19937", key, position, has_gauss, cached))
    torch.set_rng_state(state["torch"].clone())
    if "cuda" in state and torch.cuda.is_available():
        torch.cuda.set_rng_state(state["cuda"].clone())
