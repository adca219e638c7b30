"""Validation: the loss on samples that are not trained on."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import TYPE_CHECKING, Any

import torch
from torch import nn

from fluxvla_core.build import build_dataset_from_cfg
from fluxvla_core.contracts.contract import implements
from fluxvla_core.contracts.training import Dataset
from fluxvla_core.data.loader import make_loader
from fluxvla_core.data.sampler import EpochSampler
from fluxvla_core.errors import ConfigError, RunFailed
from fluxvla_core.training.batches import loader_source, to_device
from fluxvla_core.training.distributed import total
from fluxvla_core.training.state import rank_seed, rng_state, seed_all, set_rng_state, take_seed
from fluxvla_core.training.stop import StopRequest

if TYPE_CHECKING:
    from fluxvla_core.training.base_runner import BaseTrainRunner


class NotFinite(RunFailed):
    """A validation loss that is no number; every rank raises it at the same place."""


class Validation:
    """The ``val_dataloader`` of a run.

    Its samples are those of epoch 0 in their order: the same ones, with the same noise, every
    time. They are normalised by the statistics of the training data. The ranks share them; as in
    training, the last batch is filled up with the first samples. What the model itself draws is
    the same every time too: it follows from the run's seed and the rank.

    Args:
        run: whose weights it is of.
        stop: asked after every batch.
    """

    def __init__(self, run: BaseTrainRunner, stop: StopRequest) -> None:
        options = run.val_options
        assert options is not None
        self._stop = stop
        table = run.context.config["val_dataloader"]["dataset"]
        self._dataset = build_dataset_from_cfg(table, run.context)
        share_statistics(run.dataset, self._dataset)
        take_seed(self._dataset, run.options.seed)
        world = run.world
        sampler = EpochSampler(
            len(self._dataset),
            options.per_device_batch_size,
            rank=world.rank,
            world=world.size,
            shuffle=False,
        )
        batches: Any = list(sampler.batches(0))
        self._loader = make_loader(
            loader_source(self._dataset, run.collator, world.device),
            run.collator,
            batches,
            options.per_device_num_workers,
            pin_memory=world.device.type == "cuda",
            seed=run.options.seed,
        )

    def loss(self, run: BaseTrainRunner) -> float | None:
        """Mean loss over the samples and all ranks, of the averaged weights if they are kept.

        None if a stop was asked for meanwhile. Leaves weights and random generators as they were,
        also when it fails.

        Raises:
            NotFinite: it is not finite.
        """
        losses = []
        with evaluating(run):
            # Every rank has as many batches, so all ask equally often.
            for batch in self._loader:
                losses.append(run._training_step(to_device(batch, run.world.device)))
                if self._stop.asked():
                    return None
            found = torch.stack(losses).double().cpu()
        summed = total(run.world, torch.stack([found.sum(), torch.tensor(float(len(found)))]))
        mean = float(summed[0] / summed[1])
        if not torch.isfinite(summed).all():
            raise NotFinite(
                f"the validation loss is {mean} at step {run.progress.step}",
                cause="a sample of val_dataloader with wrong or huge values, or a learning rate "
                "that is too high",
            )
        return mean


@contextmanager
def evaluating(run: BaseTrainRunner) -> Iterator[None]:
    """Inside, the model evaluates: with averaged weights if kept, and the same draws every time."""
    drawn = rng_state()
    seed_all(rank_seed(run.options.seed, run.world.rank))
    run.vla.eval()
    try:
        with run.ema.in_place() if run.ema is not None else nullcontext(), torch.no_grad():
            yield
            reshard(run.vla)
    finally:
        run.vla.train()
        set_rng_state(drawn)


def reshard(model: nn.Module) -> None:
    """Release weights that sharding has gathered for a forward pass without a backward pass."""
    for module in model.modules():
        again = getattr(module, "reshard", None)
        if callable(again):
            again()


def share_statistics(train: Any, val: Any) -> None:
    """Let the ``val`` dataset normalise as ``train`` does.

    Raises:
        ConfigError: it is of a robot for which the training data have no statistics.
    """
    parts = getattr(val, "datasets", None)
    for dataset in parts if isinstance(parts, list) else [val]:
        if not implements(dataset, Dataset, "use_statistics"):
            continue
        name = dataset.statistic_name
        if name not in train.statistics:
            raise ConfigError(
                f"val_dataloader: its statistic_name {name!r} is none of the training data's, "
                f"{', '.join(train.statistics)}"
            )
        dataset.use_statistics(train.statistics[name])
