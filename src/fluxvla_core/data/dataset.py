"""``ParquetDataset``: training samples from LeRobot datasets, with action windows."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.frame import Sample
from fluxvla_core.contracts.runner import Reporter, SilentReporter
from fluxvla_core.contracts.training import Dataset
from fluxvla_core.data.columns import (
    LoadedDataset,
    check_compatible,
    find_embodiment,
    load_dataset,
    naming_warnings,
)
from fluxvla_core.data.frames import Frames, Place
from fluxvla_core.data.sampler import DEFAULT_SEED, SampleKey, sample_rng
from fluxvla_core.data.statistics import Stats, as_lists, column_statistics, joined_statistics
from fluxvla_core.data.transforms.images import join_planes, split_images, stack_steps
from fluxvla_core.data.transforms.pipeline import Pipeline
from fluxvla_core.errors import ConfigError
from fluxvla_core.spec import VELOCITY, EmbodimentSpec

Floats = npt.NDArray[np.float32]


class ParquetDataset(Dataset):
    """Frames of LeRobot datasets as training samples: map style, random access.

    Versions 2.0, 2.1 and 3.0; each dataset's ``meta/info.json`` says which it is.

    A sample begins as ``images`` (a list of ``(3, H, W)`` uint8, one a camera), ``img_masks``
    ``(N,)`` bool, ``states`` ``(D,)`` float32, ``actions`` ``(T, D)`` float32, ``action_masks``
    ``(T,)`` float32 (0 beyond the episode's end, where the last action is repeated),
    ``task_description``, ``timestamp`` (seconds in the episode), ``sample_ids`` int64, ``info``
    and ``stats``, and ends as the transforms leave it, without ``stats``; images that are still a
    list are stacked to ``(3N, H, W)`` if they can be. What transforms draw follows from (``seed``,
    epoch, index) alone.

    Args:
        data_root_path: one dataset's folder, or several, one after the other.
        transforms: tables of ``fluxvla.transforms``, or callables.
        img_keys: cameras, by feature (``observation.images.top``) or short name (``top``);
            with none, samples have no images.
        action_window_size: T.
        action_key, state_key: features; ``action_key`` may be the state, see
            ``window_start_idx``.
        window_start_idx: frames from the present one to the window's first action.
        n_obs_steps: observations of a sample, the present one last, for a model that takes several.
            ``images`` are then ``(n_obs_steps, 3N, H, W)`` and ``states`` ``(n_obs_steps, D)``.
            Transforms see one observation at a time, and draw the same for all of a sample. Before
            an episode's beginning its first frame is repeated.
        past_actions: actions of the window before the one that ``window_start_idx`` says, as the
            model's ``past_actions``. Before an episode's beginning the first one is repeated, with
            ``action_masks`` 0.
        use_delta: actions are differences to the frame before.
        relative_actions: normalisation counts actions from the present state: True for every
            joint that is not a gripper, or one truth value a joint. The statistics then say so
            (``relative``), which is what ``NormalizeStatesAndActions`` and its inverse go by.
        per_step_statistics: the action's statistics are ``(T, D)``, one row a step.
        statistic_name: the key of :attr:`statistics`.
        embodiment_id: added to every sample as ``embodiment_ids``, int64, if given.
        cache_frames: decode everything once and keep it in memory as uint8.
        seed: of everything random in a sample; None takes the training's (``runner.seed``).
        episodes: the ones to use, for one dataset a list, for several one list each.
        processors: a checkpoint's ``processors`` folder.
        embodiment: the robot (a table as ``EmbodimentSpec.to_dict`` gives it, or the path of one
            as JSON), for datasets that do not say: LeRobot's own.

    Raises:
        DataError: a dataset is missing, empty, of another version, damaged, or lacks a feature or
            an episode. Files are checked here, before training begins.
        SpecMismatch: the datasets were made with different robots, or with another than
            ``embodiment``.
        ConfigError: parameters that make no sense.
    """

    action_window_size: int
    n_obs_steps: int
    past_actions: int
    pipeline: Pipeline
    statistic_name: str

    def __init__(
        self,
        data_root_path: str | Sequence[str],
        transforms: Sequence[Mapping[str, Any] | Callable[..., Sample]],
        img_keys: Sequence[str],
        action_window_size: int = 9,
        action_key: str = "action",
        state_key: str = "observation.state",
        window_start_idx: int = 0,
        use_delta: bool = False,
        relative_actions: bool | Sequence[bool] = False,
        per_step_statistics: bool = False,
        statistic_name: str = "private",
        embodiment_id: int | None = None,
        cache_frames: bool = False,
        seed: int | None = None,
        episodes: Sequence[Any] | None = None,
        processors: str | None = None,
        embodiment: Mapping[str, Any] | str | None = None,
        n_obs_steps: int = 1,
        past_actions: int = 0,
    ) -> None:
        if action_window_size < 1 or window_start_idx < 0:
            raise ConfigError(
                f"ParquetDataset: action_window_size {action_window_size} must be at least 1, "
                f"window_start_idx {window_start_idx} at least 0"
            )
        if n_obs_steps < 1 or not 0 <= past_actions < action_window_size:
            raise ConfigError(
                f"ParquetDataset: n_obs_steps {n_obs_steps} must be at least 1, past_actions "
                f"{past_actions} from 0 to {action_window_size - 1}, below action_window_size"
            )
        roots = _roots(data_root_path)
        chosen = _episode_lists(episodes, len(roots))
        self.pipeline = Pipeline(transforms, processors)
        self.loaded = [
            load_dataset(root, img_keys, state_key, action_key, window_start_idx, which)
            for root, which in zip(roots, chosen, strict=True)
        ]
        check_compatible(self.loaded)
        self._embodiment = find_embodiment(self.loaded, embodiment)
        if use_delta:
            self.loaded = [differences(r) for r in self.loaded]
        self.state_key, self.action_key = state_key, action_key
        self.action_window_size = action_window_size
        self.window_start_idx = window_start_idx
        self.n_obs_steps, self.past_actions = n_obs_steps, past_actions
        self.use_delta = use_delta
        self.per_step_statistics = per_step_statistics
        self.statistic_name = statistic_name
        self.embodiment_id = embodiment_id
        self.seed = DEFAULT_SEED if seed is None else seed
        self._own_seed = seed is not None
        self.relative = _relative(relative_actions, self)
        self._frames = Frames(self.loaded, cache_frames)
        self._ends = np.cumsum([len(r.rows) for r in self.loaded])

    def __len__(self) -> int:
        return int(self._ends[-1])

    @property
    def fps(self) -> float:
        """Frames, and so actions of a window, per second."""
        return self.loaded[0].meta.fps

    @property
    def embodiment(self) -> EmbodimentSpec | None:
        """The robot, None if unknown; with ``use_delta`` its actions are deltas."""
        if self._embodiment is not None and self.use_delta:
            return replace(self._embodiment, action_mode="delta")
        return self._embodiment

    @property
    def episode_ends(self) -> npt.NDArray[np.int64]:
        """``(E,)`` for each episode in use the index after its last sample."""
        before = np.concatenate([[0], self._ends[:-1]])
        parts = []
        for one, offset in zip(self.loaded, before, strict=True):
            of_episode = one.episode[one.rows]
            last = np.flatnonzero(of_episode[1:] != of_episode[:-1]) + 1
            parts.append(np.append(last, len(of_episode)) + offset)
        return np.concatenate(parts)

    @property
    def tasks(self) -> tuple[str, ...]:
        """The instructions of the frames in use."""
        texts = [r.meta.tasks[i] for r in self.loaded for i in np.unique(r.task[r.rows])]
        return tuple(dict.fromkeys(texts))

    @cached_property
    def statistics(self) -> dict[str, Any]:
        """``{statistic_name: {"proprio": {...}, "action": {...}}}``: exact, of the frames in use.

        Each has mean, std, min, max, q01, q10, q50, q90, q99 and count, as lists.
        """
        return {self.statistic_name: pooled_statistics([self])}

    def warnings(self) -> list[str]:
        """Warnings before training begins: of datasets that differ, and of the statistics.

        Raises:
            ConfigError: numbers would be normalised to what nothing can be learnt from.
        """
        first, stats = self.loaded[0], self.statistics[self.statistic_name]
        names = first.state_names, first.action_names
        return [*naming_warnings(self.loaded), *self.pipeline.warnings(stats, *names)]

    def use_statistics(self, entry: Mapping[str, Any]) -> None:
        """Normalise by these instead of the dataset's own: ``{"proprio": …, "action": …}``."""
        self.statistics = {self.statistic_name: dict(entry)}

    def use_seed(self, seed: int) -> None:
        """Use the run's seed from now on, unless the config gave the dataset its own."""
        if not self._own_seed:
            self.seed = seed

    def deferring(self) -> ParquetDataset | None:
        """The same samples with images to be normalised on the device; None if impossible.

        It shares frames and settings with this one, and is for reading only.
        """
        pipeline = self.pipeline.deferring()
        if pipeline is None:
            return None
        other = copy(self)
        other.pipeline, other.statistics = pipeline, self.statistics
        return other

    def uncached(self) -> ParquetDataset:
        """The same samples, decoded when they are asked for; for reading a few only."""
        other = copy(self)
        other.statistics, other._frames = self.statistics, Frames(self.loaded, cache=False)
        return other

    def prepare(self, reporter: Reporter | None = None) -> None:
        """Decode into memory, if ``cache_frames`` asks for it; workers then inherit it."""
        self._frames.prepare(reporter or SilentReporter())

    def get_sample(self, index: int, epoch: int) -> Sample:
        """Sample ``index`` as ``epoch`` sees it."""
        return self.get_samples([SampleKey(epoch, index)])[0]

    def get_samples(self, keys: Sequence[SampleKey]) -> list[Sample]:
        """Several samples at once; their images are read in the order of the files."""
        self.prepare()
        places = [self._place(key.index) for key in keys]
        steps = [self._steps(place) for place in places]
        frames = iter(self._frames.read([step for each in steps for step in each]))
        return [
            stack_steps([self._seen(key, place, row, next(frames)) for _, row in each])
            for key, place, each in zip(keys, places, steps, strict=True)
        ]

    def _place(self, index: int) -> Place:
        if not 0 <= index < len(self):
            raise IndexError(f"sample {index} of {len(self)}")
        part = int(np.searchsorted(self._ends, index, side="right"))
        before = int(self._ends[part - 1]) if part else 0
        return part, int(self.loaded[part].rows[index - before])

    def _steps(self, place: Place) -> list[Place]:
        """The frames that a sample shows, the present one last."""
        part, row = place
        first = int(self.loaded[part].start[row])
        return [(part, max(row - back, first)) for back in reversed(range(self.n_obs_steps))]

    def _seen(
        self, key: SampleKey, place: Place, seen: int, images: list[npt.NDArray[np.uint8]]
    ) -> Sample:
        """What the transforms make of the sample at ``place`` as it looks at row ``seen``."""
        loaded, row = self.loaded[place[0]], place[1]
        first = row + self.window_start_idx - self.past_actions
        bounds = int(loaded.start[row]), int(loaded.end[row])
        actions, masks = window(loaded.actions, first, bounds, self.action_window_size)
        sample: Sample = {
            "states": loaded.states[seen].copy(),
            "actions": actions,
            "action_masks": masks,
            "task_description": loaded.meta.tasks[loaded.task[row]],
            "timestamp": np.asarray(loaded.timestamp[row], np.float32),
            "sample_ids": np.asarray(key.index, np.int64),
            "stats": self.statistics[self.statistic_name],
            "info": {
                "dataset": str(loaded.meta.root),
                "episode_index": int(loaded.episode[row]),
                "frame_index": row - int(loaded.start[row]),
            },
        }
        if images:
            sample["images"] = images
            sample["img_masks"] = np.ones(len(images), np.bool_)
        if self.embodiment_id is not None:
            sample["embodiment_ids"] = np.asarray(self.embodiment_id, np.int64)
        sample = self.pipeline(sample, sample_rng(self.seed, key.epoch, key.index))
        # The same for every sample, and with one row a step too much to send from workers.
        sample.pop("stats", None)
        left = sample.get("images")
        if isinstance(left, list) and len({image.shape for image in left}) == 1:
            sample["images"] = join_planes(split_images(left))
        return sample


def pooled_statistics(datasets: Sequence[ParquetDataset]) -> dict[str, Any]:
    """``{"proprio", "action"}`` of all frames in use of ``datasets``, as if they were one.

    The datasets take actions alike; every frame counts once.
    """
    first = datasets[0]
    loaded = [one for dataset in datasets for one in dataset.loaded]
    states = np.concatenate([r.states[r.chosen] for r in loaded])
    action = action_statistics(
        loaded,
        first.action_window_size,
        first.window_start_idx - first.past_actions,
        first.relative,
        first.per_step_statistics,
    )
    return {"proprio": as_lists(column_statistics(states)), "action": action}


def action_statistics(
    datasets: Sequence[LoadedDataset],
    size: int,
    first_action: int,
    relative: npt.NDArray[np.bool_] | None,
    per_step: bool,
) -> dict[str, Any]:
    """Statistics of the actions that samples show, as JSON values.

    Args:
        size, first_action: of the window.
        relative: ``(D,)``; where True, actions are counted from the state at the window's frame.
        per_step: give ``(size, D)`` statistics, one row for each step of the window.

    Plain actions are counted once a frame of the chosen episodes; relative or per-step ones once
    for each window that they occur in.
    """
    if relative is None and not per_step:
        rows = np.concatenate([r.actions[r.chosen] for r in datasets])
        return as_lists(column_statistics(rows))
    if per_step:
        # The last steps of a window longer than every episode occur nowhere.
        each: list[Stats] = []
        for j in range(size):
            rows = _step(datasets, first_action + j, relative, slice(None))
            if not len(rows):
                rows = _step(datasets, 0, relative, slice(None)) if not each else rows
            each.append(column_statistics(rows) if len(rows) else each[0])
        stats = {name: np.stack([s[name] for s in each]) for name in each[0]}
    else:
        stats = joined_statistics(
            lambda dims: (_step(datasets, first_action + j, relative, dims) for j in range(size))
        )
    found = as_lists(stats)
    if relative is not None:
        found["relative"] = relative.astype(int).tolist()
    return found


def _step(
    datasets: Sequence[LoadedDataset],
    ahead: int,
    relative: npt.NDArray[np.bool_] | None,
    dims: slice,
) -> npt.NDArray[np.float32]:
    """Actions ``ahead`` rows after each usable one, where they are within the episode."""
    parts = []
    for one in datasets:
        there = one.rows + ahead
        rows = one.rows[(one.start[one.rows] <= there) & (there < one.end[one.rows])]
        actions = one.actions[:, dims][rows + ahead]
        if relative is not None:
            actions = actions - one.states[:, : len(relative)][:, dims][rows] * relative[dims]
        parts.append(actions)
    return np.concatenate(parts)


def window(
    actions: Floats, first: int, episode: tuple[int, int], size: int
) -> tuple[Floats, Floats]:
    """``size`` rows of ``actions`` ``(N, D)`` from ``first`` on, and which of them are there.

    ``episode`` is the first row of an episode and the one behind its last. Rows before and after it
    repeat its first and its last, with the mask 0.

    Returns:
        ``(size, D)`` and ``(size,)`` float32, both fresh.
    """
    begin, end = episode
    rows = np.arange(first, first + size)
    chunk = np.asarray(actions[rows.clip(begin, end - 1)], np.float32)
    return chunk, ((begin <= rows) & (rows < end)).astype(np.float32)


def differences(loaded: LoadedDataset) -> LoadedDataset:
    """Actions as the difference to the frame before, 0 at an episode's first frame."""
    actions = np.zeros_like(loaded.actions)
    actions[1:] = np.diff(loaded.actions, axis=0)
    actions[loaded.meta.episodes.first_row] = 0
    return replace(loaded, actions=actions)


def _roots(given: str | Path | Sequence[str | Path]) -> list[Path]:
    paths = [given] if isinstance(given, str | Path) else list(given)
    if not paths:
        raise ConfigError("ParquetDataset: data_root_path names no dataset")
    return [Path(path).expanduser() for path in paths]


def _episode_lists(episodes: Sequence[Any] | None, count: int) -> list[Sequence[int] | None]:
    if episodes is None:
        return [None] * count
    if count == 1 and all(isinstance(e, int) for e in episodes):
        return [episodes]
    if len(episodes) != count or any(isinstance(e, int) for e in episodes):
        raise ConfigError(
            f"ParquetDataset: episodes must be one list for each of {count} datasets, "
            f"got {len(episodes)} entries"
        )
    return list(episodes)


def _relative(
    wanted: bool | Sequence[bool], dataset: ParquetDataset
) -> npt.NDArray[np.bool_] | None:
    """Which dimensions are counted from the state, ``(D,)``; None for none."""
    if wanted is False:
        return None
    first = dataset.loaded[0]
    width = first.actions.shape[1]
    if first.states.shape[1] < width:
        raise ConfigError("ParquetDataset: relative_actions need a state for every action")
    spec = dataset.embodiment
    if wanted is True:
        kinds = [j.kind for j in spec.joints] if spec is not None else ["revolute"] * width
        wanted = [kind not in ("gripper", VELOCITY) for kind in kinds]
    mask = np.asarray(wanted, np.bool_)
    if mask.shape != (width,):
        raise ConfigError(
            f"ParquetDataset: relative_actions has {mask.size} entries, actions have {width}"
        )
    return mask
