"""Validation: the loss on samples that are not trained on."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

import torch
from torch import Tensor, nn

from fluxvla_core.build import RunContext, build_dataset_from_cfg
from fluxvla_core.contracts.contract import implements
from fluxvla_core.contracts.training import Dataset
from fluxvla_core.data.loader import loader_source, make_loader, to_device
from fluxvla_core.data.sampler import StepPlan, StepSampler
from fluxvla_core.errors import ConfigError, RunFailed, located
from fluxvla_core.training.distributed import World, all_reduce_sum
from fluxvla_core.training.options import LoaderOptions
from fluxvla_core.training.state import Ema, rank_seed, rng_state, seed_all, set_rng_state
from fluxvla_core.training.stop import StopRequest


class NotFinite(RunFailed):
    """A validation loss that is not a number; every rank raises it at the same place."""


class Validation:
    """The loss on a run's ``val_dataloader``.

    Its samples are those of epoch 0 in their order: the same ones, with the same noise, every
    time. The ranks share them; as in training, the last batch is filled up with the first samples.
    What the model itself draws is the same every time too: it follows from ``seed`` and the rank.

    Args:
        dataset: see :func:`validation_dataset`.
        collator: the run's.
        options: batch size and workers.
        world: the processes that share the samples.
        seed: the run's.
        stop: asked after every batch.
    """

    def __init__(
        self,
        dataset: Any,
        collator: Any,
        options: LoaderOptions,
        world: World,
        seed: int,
        stop: StopRequest,
    ) -> None:
        self._world, self._seed, self._stop = world, seed, stop
        size = options.per_device_batch_size
        plan = StepPlan(len(dataset), size, world=world.size, shuffle=False)
        batches = list(StepSampler(plan, world.rank).epoch(0))
        self._loader = make_loader(
            loader_source(dataset, collator, world.device),
            collator,
            batches,
            options.per_device_num_workers,
            pin_memory=world.device.type == "cuda",
            seed=seed,
        )

    def loss(
        self,
        model: nn.Module,
        loss_of_batch: Callable[[dict[str, Any]], Tensor],
        ema: Ema | None,
        step: int,
    ) -> float | None:
        """Mean loss over the samples and all ranks, of the averaged weights if they are kept.

        None if a stop was asked for meanwhile. Leaves weights and random generators as they were,
        also when it fails.

        Args:
            model: as it trains, which ``loss_of_batch`` calls.
            loss_of_batch: a batch on the device -> its loss, a scalar.
            ema: the averaged weights.
            step: after which this is, for messages.

        Raises:
            NotFinite: it is not finite.
        """
        losses = []
        with evaluating(model, ema, rank_seed(self._seed, self._world.rank)):
            # Every rank has as many batches, so all ask equally often.
            for batch in self._loader:
                losses.append(loss_of_batch(to_device(batch, self._world.device)))
                if self._stop.poll_now():
                    return None
            found = torch.stack(losses).double().cpu()
        summed = all_reduce_sum(
            self._world, torch.stack([found.sum(), torch.tensor(float(len(found)))])
        )
        mean = float(summed[0] / summed[1])
        if not torch.isfinite(summed).all():
            raise NotFinite(
                f"the validation loss is {mean} at step {step}",
                cause="a sample of val_dataloader with wrong or huge values, or a learning rate "
                "that is too high",
            )
        return mean


@contextmanager
def evaluating(model: nn.Module, ema: Ema | None, seed: int) -> Iterator[None]:
    """Context manager: the model in eval mode, with EMA weights if kept and a fixed seed."""
    drawn = rng_state()
    seed_all(seed)
    model.eval()
    try:
        with ema.in_place() if ema is not None else nullcontext(), torch.no_grad():
            yield
            reshard(model)
    finally:
        model.train()
        set_rng_state(drawn)


def reshard(model: nn.Module) -> None:
    """Release weights that sharding has gathered for a forward pass without a backward pass."""
    for module in model.modules():
        again = getattr(module, "reshard", None)
        if callable(again):
            again()


def validation_dataset(context: RunContext, train: Any, seed: int) -> Any:
    """The dataset of ``val_dataloader``, normalised by the statistics of the dataset ``train``."""
    with located(context.where("val_dataloader.dataset")):
        dataset = build_dataset_from_cfg(context.config["val_dataloader"]["dataset"], context)
        share_statistics(train, dataset)
    Dataset.adapt(dataset).use_seed(seed)
    return dataset


def share_statistics(train: Any, val: Any) -> None:
    """Normalise the ``val`` dataset by the statistics of ``train``.

    Raises:
        ConfigError: it is of a robot for which the training data have no statistics.
    """
    for dataset in Dataset.adapt(val).datasets or [val]:
        if not implements(dataset, Dataset, "use_statistics"):
            continue
        name = dataset.statistic_name
        if name not in train.statistics:
            raise ConfigError(
                f"val_dataloader: its statistic_name {name!r} is not one of the training data's, "
                f"{', '.join(train.statistics)}"
            )
        dataset.use_statistics(train.statistics[name])
