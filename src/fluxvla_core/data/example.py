"""A sample as training sees it, also where the dataset is on another machine: for dry runs."""

from __future__ import annotations

import os
import re
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fluxvla_core.build import RunContext, build_dataset_from_cfg, build_tokenizer_from_cfg
from fluxvla_core.contracts.frame import Sample
from fluxvla_core.contracts.training import Dataset, Tokenizer
from fluxvla_core.data.lerobot import camera_name
from fluxvla_core.data.mixture import first_dataset
from fluxvla_core.data.transforms.images import join_planes, split_images, stack_steps
from fluxvla_core.data.transforms.pipeline import Pipeline
from fluxvla_core.errors import ConfigError, FluxError
from fluxvla_core.spec import EmbodimentSpec

HEIGHT, WIDTH = 480, 640
"""Size of an image, where neither the dataset nor the robot says."""
INSTRUCTION = "pick up the cube and put it into the box"
_MARK = re.compile(r"<[^<>\s]+>|\w+|[^\w\s]")


class Refused(Exception):
    """A dataset that is here cannot be built, or its first sample not be made: a training would end
    with ``error``."""

    def __init__(self, error: FluxError) -> None:
        super().__init__(str(error))
        self.error = error


@dataclass(frozen=True)
class Example:
    """The first sample of a dataset, or one that it could have.

    Args:
        sample: behind the transforms.
        states, actions: their widths before the transforms.
        cameras: name -> height and width in the data; None where they are not known.
        dataset: None where the sample is assumed.
        assumed: assumptions in place of missing knowledge.
        stand_in: a tokenizer is absent, so that the ids of tokens are not those of the training.
    """

    sample: Sample
    states: int
    actions: int
    cameras: Mapping[str, tuple[int, int] | None]
    dataset: Dataset | None
    assumed: tuple[str, ...]
    stand_in: bool


def example(
    table: Mapping[str, Any],
    context: RunContext,
    robot: EmbodimentSpec | None,
    widths: tuple[int, int],
) -> Example:
    """The first sample of the dataset that ``table`` describes; one of its shapes if it is absent.

    Args:
        robot: whose cameras and joints the data are assumed to have.
        widths: of states and actions, where no robot is known.

    Raises:
        Refused: the dataset is here, and its first sample cannot be made.
        FluxError: the transforms do not take the samples that are assumed.
    """
    assumed: list[str] = []
    known = _with_tokenizers(table, assumed)
    try:
        dataset = Dataset.adapt(build_dataset_from_cfg(known, context))
        uncached = getattr(dataset, "uncached", None)  # one frame is wanted, not all in memory
        sample = Dataset.adapt(dataset if uncached is None else uncached()).get_sample(0, 0)
    except FluxError as error:
        if not assumed and is_here(table):
            raise Refused(error) from error
        return assumed_example(first_dataset(known), robot, widths, [error.what, *assumed])
    joints = dataset.embodiment
    entry = dataset.statistics.get(dataset.statistic_name or "", {})
    states, actions = (_width(entry, key) for key in ("proprio", "action"))
    keys = first_dataset(table).get("img_keys", ())
    sizes = _sizes(keys, joints)
    return Example(sample, states, actions, sizes, dataset, tuple(assumed), _stands_in(known))


def assumed_example(
    table: Mapping[str, Any],
    robot: EmbodimentSpec | None,
    widths: tuple[int, int],
    notes: Sequence[str],
) -> Example:
    """A sample of zeros by a dataset's ``table`` alone; see :func:`example`."""
    states, actions = widths if robot is None else (robot.state_dim, robot.dim)
    keys, size = table.get("img_keys", ()), int(table.get("action_window_size", 9))
    sizes = _sizes(keys, robot)
    of_robot = "the robot's" if robot is not None else "the model's"
    assumed = [*notes, f"widths of states and actions are assumed to be {of_robot}"]
    if any(found is None for found in sizes.values()):
        assumed.append(f"images are assumed to be {HEIGHT} x {WIDTH}")
    sample: Sample = {
        "states": np.zeros(states, np.float32),
        "actions": np.zeros((size, actions), np.float32),
        "action_masks": np.ones(size, np.float32),
        "task_description": INSTRUCTION,
        "timestamp": np.zeros((), np.float32),
        "sample_ids": np.zeros((), np.int64),
        "stats": {"proprio": unit_statistics(states), "action": unit_statistics(actions)},
        "info": {},
    }
    if keys:
        sample["images"] = [
            np.zeros((3, *(found or (HEIGHT, WIDTH))), np.uint8) for found in sizes.values()
        ]
        sample["img_masks"] = np.ones(len(keys), np.bool_)
    if table.get("embodiment_id") is not None:
        sample["embodiment_ids"] = np.asarray(table["embodiment_id"], np.int64)
    sample = Pipeline(table.get("transforms", ()))(sample, np.random.default_rng(0))
    sample.pop("stats", None)
    images = sample.get("images")
    if isinstance(images, list) and len({image.shape for image in images}) == 1:
        sample["images"] = join_planes(split_images(images))
    sample = stack_steps([sample] * max(int(table.get("n_obs_steps", 1)), 1))
    return Example(sample, states, actions, sizes, None, tuple(assumed), _stands_in(table))


def unit_statistics(width: int) -> dict[str, list[float]]:
    """Statistics that change nothing: mean 0, standard deviation 1, a range of -1..1."""
    zeros, ones, below = [0.0] * width, [1.0] * width, [-1.0] * width
    return {"mean": zeros, "std": ones, "min": below, "max": ones, "q01": below, "q99": ones}


class StandInTokenizer(Tokenizer):
    """Takes the place of a tokenizer whose files are absent: words, and markers such as ``<img>``.

    Plain text has a token in front, as most tokenizers put one there. The number of tokens is about
    that of the real one; transforms bring it to their ``max_len``.
    """

    def encode(self, text: str) -> Sequence[int]:
        """A number for each word and marker."""
        ids = [3 + zlib.crc32(part.encode()) % 997 for part in _MARK.findall(text)]
        return ids if text.startswith("<") else [1, *ids]

    def encode_actions(self, actions: Any) -> Sequence[int]:
        """A number for every fourth of a chunk's."""
        return [number % 997 for number in range(max(1, np.size(actions) // 4))]


def is_here(table: Mapping[str, Any]) -> bool:
    """Whether the folders of the dataset that ``table`` describes are on this machine."""
    place = first_dataset(table).get("data_root_path")
    places = [place] if isinstance(place, str) else place
    return isinstance(places, Sequence) and bool(places) and all(map(os.path.isdir, places))


def _with_tokenizers(table: Mapping[str, Any], assumed: list[str]) -> dict[str, Any]:
    """A dataset's table in which tokenizers are built, or stand in for one that is not there."""
    transforms = []
    for transform in table.get("transforms", ()):
        inner = transform.get("tokenizer") if isinstance(transform, Mapping) else None
        if not isinstance(inner, Mapping):
            transforms.append(transform)
            continue
        try:
            tokenizer: Any = build_tokenizer_from_cfg(inner)
        except ConfigError as error:
            tokenizer = StandInTokenizer()
            assumed.append(f"{error.what}: tokens are assumed")
        transforms.append({**transform, "tokenizer": tokenizer})
    return {**table, "transforms": transforms} if transforms else dict(table)


def _stands_in(table: Mapping[str, Any]) -> bool:
    tables = [t for t in table.get("transforms", ()) if isinstance(t, Mapping)]
    return any(isinstance(t.get("tokenizer"), StandInTokenizer) for t in tables)


def _sizes(keys: Sequence[str], robot: EmbodimentSpec | None) -> dict[str, tuple[int, int] | None]:
    known = {c.name: (c.height, c.width) for c in robot.cameras} if robot is not None else {}
    return {camera_name(key): known.get(camera_name(key)) for key in keys}


def _width(statistics: Mapping[str, Any], key: str) -> int:
    return int(np.asarray(statistics.get(key, {}).get("mean", [])).shape[-1])
