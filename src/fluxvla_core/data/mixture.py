"""Mixture of datasets: sampling weights, and statistics that datasets of one robot share."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import copy
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.build import RunContext, build_dataset_from_cfg
from fluxvla_core.contracts.frame import Sample
from fluxvla_core.contracts.runner import Reporter
from fluxvla_core.contracts.training import Dataset
from fluxvla_core.data.columns import check_compatible, naming_warnings
from fluxvla_core.data.dataset import ParquetDataset, pooled_statistics
from fluxvla_core.data.sampler import DEFAULT_SEED, SampleKey, mixture_rng
from fluxvla_core.data.transforms.pipeline import deferring
from fluxvla_core.errors import ConfigError
from fluxvla_core.spec import EmbodimentSpec, check_match

Ints = npt.NDArray[np.int64]


class DistributedRepeatingDataset(Dataset):
    """A mixture: map style, every sample a function of (seed, epoch, index).

    An epoch is ``samples_per_epoch`` places; each dataset has its share of them, exactly. Epoch
    after epoch a dataset is gone through in rounds: each of its samples once, in an order of its
    own, before any of them a second time. A sample that comes twice in an epoch is augmented
    differently each time. Ranks and workers do not matter: ``EpochSampler`` shares places out.

    Datasets with the same ``statistic_name`` are of one robot and share statistics: those of all
    their frames together, exactly. Datasets of another robot need another ``statistic_name``.

    What a checkpoint says about its robot and its rate is the first dataset's.

    Args:
        datasets: tables (or objects) of one dataset or several; or name -> one or several, the
            name then being their ``statistic_name`` where they do not give one.
        weights: relative frequencies, one for each dataset in their order; by default their
            lengths, so that each sample is seen once an epoch.
        samples_per_epoch: by default as many as all datasets have.
        seed: of the choice of samples, where an epoch does not take all; None takes the
            training's (``runner.seed``), as do the datasets that set none.
        context: for the constructors of the datasets.

    Raises:
        ConfigError: no datasets, weights that are not positive or not one a dataset, a share of
            no sample; datasets with one ``statistic_name`` that take actions differently.
        SpecMismatch, DataError: datasets with one ``statistic_name`` of different robots, rates
            or widths.
    """

    def __init__(
        self,
        datasets: Any,
        weights: Sequence[float] | None = None,
        samples_per_epoch: int | None = None,
        seed: int | None = None,
        context: RunContext | None = None,
    ) -> None:
        self.datasets: list[Dataset] = _build(datasets, context)
        self.seed = DEFAULT_SEED if seed is None else seed
        self._own_seed = seed is not None
        self.lengths = np.array([len(d) for d in self.datasets], np.int64)
        total = int(self.lengths.sum()) if samples_per_epoch is None else samples_per_epoch
        self.shares = shares(total, self.lengths if weights is None else weights, len(self.lengths))
        self._places = np.cumsum(self.shares)
        self._first_id = np.cumsum(self.lengths) - self.lengths
        self._drawn: dict[tuple[int, int], Ints] = {}
        self._share_statistics()

    def __len__(self) -> int:
        return int(self._places[-1])

    @property
    def statistics(self) -> dict[str, Any]:
        """``{statistic_name: {"proprio": {...}, "action": {...}}}``, one entry a robot."""
        return {name: entry for d in self.datasets for name, entry in d.statistics.items()}

    @property
    def embodiment(self) -> EmbodimentSpec | None:
        """The first dataset's robot."""
        return self.datasets[0].embodiment

    @property
    def fps(self) -> float | None:
        """The first dataset's."""
        return self.datasets[0].fps

    @property
    def action_window_size(self) -> int | None:
        """The first dataset's."""
        return self.datasets[0].action_window_size

    @property
    def n_obs_steps(self) -> int:
        """The first dataset's."""
        return self.datasets[0].n_obs_steps

    @property
    def past_actions(self) -> int:
        """The first dataset's."""
        return self.datasets[0].past_actions

    @property
    def pipeline(self) -> Any:
        """The first dataset's."""
        return self.datasets[0].pipeline

    @property
    def parts(self) -> dict[str, int]:
        """The datasets by name, each with the number of its sample ids, in the order of these.

        A dataset is called by its folder (its ``statistic_name`` if it has none), with its place
        in the mixture behind it where several are called alike.
        """
        names = [_name_of(dataset) for dataset in self.datasets]
        unique = [n if names.count(n) == 1 else f"{n}-{i}" for i, n in enumerate(names)]
        return dict(zip(unique, self.lengths.tolist(), strict=True))

    @property
    def tasks(self) -> tuple[str, ...]:
        """The instructions of all datasets."""
        return tuple(dict.fromkeys(t for d in self.datasets for t in d.tasks))

    def warnings(self) -> list[str]:
        """Warnings before training begins; those that several datasets give are listed once.

        Raises:
            ConfigError: see ``ParquetDataset.warnings``.
        """
        found = [warning for dataset in self.datasets for warning in dataset.warnings()]
        for group in self._groups().values():
            loaded = [one for d in group if isinstance(d, ParquetDataset) for one in d.loaded]
            found += naming_warnings(loaded) if loaded else []
        return list(dict.fromkeys(found))

    def use_seed(self, seed: int) -> None:
        """Use the run's seed from now on, here and in every dataset, except where one was given."""
        if not self._own_seed:
            self.seed, self._drawn = seed, {}
        for dataset in self.datasets:
            dataset.use_seed(seed)

    def deferring(self) -> DistributedRepeatingDataset | None:
        """The same samples with images to be normalised on the device; None if impossible."""
        parts = [deferring(dataset) for dataset in self.datasets]
        if any(part is None for part in parts):
            return None
        other = copy(self)
        other.datasets = [Dataset.adapt(part) for part in parts]
        return other

    def prepare(self, reporter: Reporter | None = None) -> None:
        """Let every dataset decode what it keeps in memory."""
        for dataset in self.datasets:
            dataset.prepare(reporter)

    def get_sample(self, index: int, epoch: int) -> Sample:
        """Sample ``index`` as ``epoch`` sees it."""
        return self.get_samples([SampleKey(epoch, index)])[0]

    def get_samples(self, keys: Sequence[SampleKey]) -> list[Sample]:
        """Several samples at once; each dataset reads its own in the order of its files."""
        places = [self.place(key) for key in keys]
        found: list[Any] = [None] * len(keys)
        for part, dataset in enumerate(self.datasets):
            mine = [i for i, (which, _) in enumerate(places) if which == part]
            samples = dataset.get_samples([places[i][1] for i in mine])
            for i, sample in zip(mine, samples, strict=True):
                if "sample_ids" in sample:
                    sample["sample_ids"] = sample["sample_ids"] + self._first_id[part]
                found[i] = sample
        return found

    def place(self, key: SampleKey) -> tuple[int, SampleKey]:
        """The dataset that place ``key`` shows, and the key to ask it for."""
        if not 0 <= key.index < len(self):
            raise IndexError(f"sample {key.index} of {len(self)}")
        part = int(np.searchsorted(self._places, key.index, side="right"))
        share, length = int(self.shares[part]), int(self.lengths[part])
        within = key.index - (int(self._places[part]) - share)
        turn, sample = divmod(key.epoch * share + within, length)
        if share % length:
            sample = int(self._order(part, turn)[sample])
        # Every turn of every dataset has an epoch number of its own: two samples of one number in
        # two datasets with one seed would otherwise draw the same noise.
        return part, SampleKey(turn * len(self.datasets) + part, sample)

    def _order(self, part: int, turn: int) -> Ints:
        """The order in which a dataset's samples come in its ``turn``-th round."""
        order = self._drawn.get((part, turn))
        if order is None:
            # Shares that span many rounds are of small datasets; of large ones two are kept.
            keep = 1 + int(self.shares[part] // self.lengths[part])
            old = [k for k in self._drawn if k[0] == part and abs(k[1] - turn) > keep]
            for stale in old:
                del self._drawn[stale]
            order = mixture_rng(self.seed, part, turn).permutation(int(self.lengths[part]))
            self._drawn[part, turn] = order
        return order

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_drawn": {}}

    def _groups(self) -> dict[str, list[Any]]:
        """The datasets by their ``statistic_name``."""
        groups: dict[str, list[Any]] = {}
        for dataset in self.datasets:
            # Asking for its statistics would compute them, only to replace them below.
            names: Iterable[str] = (
                [dataset.statistic_name]
                if isinstance(dataset, ParquetDataset)
                else dataset.statistics
            )
            for name in names:
                groups.setdefault(name, []).append(dataset)
        return groups

    def _share_statistics(self) -> None:
        for name, group in self._groups().items():
            if len(group) > 1:
                _check_group(name, group)
                entry = pooled_statistics(group)
                for dataset in group:
                    dataset.use_statistics(entry)


def shares(total: int, weights: Sequence[float] | Ints, count: int) -> Ints:
    """Divide ``total`` by ``weights``: whole numbers, exact in sum, each within 1 of its share.

    Raises:
        ConfigError: a weight is not positive and finite, there are not ``count`` of them, or one
            would get nothing.
    """
    due = np.asarray(weights, np.float64)
    if due.shape != (count,):
        raise ConfigError(
            f"DistributedRepeatingDataset: {due.size} weights for {count} datasets",
            next="give one weight for each dataset",
        )
    if not np.isfinite(due).all() or (due <= 0).any():
        raise ConfigError(
            f"DistributedRepeatingDataset: weights must be positive, got {due.tolist()}",
            next="leave out a dataset that is not to be seen",
        )
    due = due / due.sum() * total
    counts: Ints = np.floor(due).astype(np.int64)
    rest = np.argsort(counts - due, kind="stable")[: total - int(counts.sum())]
    counts[rest] += 1
    if (counts < 1).any():
        raise ConfigError(
            f"DistributedRepeatingDataset: of an epoch of {total} samples, dataset "
            f"{int(np.argmin(counts))} gets none",
            next="raise samples_per_epoch, or its weight",
        )
    return counts


def first_dataset(table: Mapping[str, Any]) -> dict[str, Any]:
    """The config of the dataset whose robot a checkpoint acts on that was trained on ``table``.

    ``table`` itself, unless it is a mixture's.
    """
    found, name = dict(table), None
    while "datasets" in found:
        inner: Any = found["datasets"]
        if isinstance(inner, Mapping) and "type" not in inner:
            name, inner = next(iter(inner.items()))
        inner = inner if isinstance(inner, Mapping) else inner[0]
        found = {**({} if name is None else {"statistic_name": name}), **inner}
    return found


def _build(datasets: Any, context: RunContext | None) -> list[Dataset]:
    named = isinstance(datasets, Mapping) and "type" not in datasets
    groups: Mapping[str | None, Any] = datasets if named else {None: datasets}
    built: list[Any] = []
    for name, group in groups.items():
        defaults = {} if name is None else {"statistic_name": name}
        tables = group if isinstance(group, list | tuple) else [group]
        built += [build_dataset_from_cfg(table, context, **defaults) for table in tables]
    if not built:
        raise ConfigError("DistributedRepeatingDataset: datasets names no dataset")
    return [Dataset.adapt(dataset) for dataset in built]


def _name_of(dataset: Dataset) -> str:
    if isinstance(dataset, ParquetDataset):
        return dataset.loaded[0].meta.root.name
    return str(dataset.statistic_name or type(dataset).__name__)


def _check_group(name: str, group: Sequence[Any]) -> None:
    where = f"DistributedRepeatingDataset: statistics {name!r}"
    others = [type(d).__name__ for d in group if not isinstance(d, ParquetDataset)]
    if others:
        raise ConfigError(
            f"{where} of several datasets are computed from their rows, and {others[0]} shows none",
            next="give each of them a statistic_name of its own",
        )
    check_compatible([one for dataset in group for one in dataset.loaded])
    first = group[0]
    root = str(first.loaded[0].meta.root)
    for other in group[1:]:
        its_root = str(other.loaded[0].meta.root)
        if first.embodiment is not None and other.embodiment is not None:
            check_match(first.embodiment, other.embodiment, root, its_root, ())
        for what, read in _MEANING.items():
            if read(first) != read(other):
                raise ConfigError(
                    f"{where}: {root} and {its_root} take actions differently: "
                    f"{what} {read(first)} / {read(other)}",
                    next="make them equal, or give one another statistic_name",
                )


_MEANING: Mapping[str, Callable[[ParquetDataset], Any]] = {
    "action_window_size": lambda d: d.action_window_size,
    "window_start_idx": lambda d: d.window_start_idx,
    "past_actions": lambda d: d.past_actions,
    "use_delta": lambda d: d.use_delta,
    "per_step_statistics": lambda d: d.per_step_statistics,
    "relative_actions": lambda d: None if d.relative is None else d.relative.tolist(),
}
