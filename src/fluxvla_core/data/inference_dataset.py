"""``PrivateInferenceDataset``: a robot's observation as a model's batch of one."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.frame import Sample
from fluxvla_core.contracts.training import InferenceDataset
from fluxvla_core.data.lerobot import camera_name
from fluxvla_core.data.transforms.images import stack_images
from fluxvla_core.data.transforms.pipeline import Pipeline
from fluxvla_core.data.transforms.state_action import load_statistics
from fluxvla_core.errors import ConfigError, DataError, located

_INSTRUCTION = "go"  # as short as any
_KEYS = ("images", "img_masks", "lang_tokens", "lang_masks", "states", "embodiment_ids")


class PrivateInferenceDataset(InferenceDataset):
    """Prepares an observation: the arguments of the model's ``predict_action``.

    The same transforms as in training, without ``training_only`` ones, give ``images``
    ``(1, 3N, H, W)``, ``img_masks`` ``(1, N)`` all True, ``lang_tokens`` and ``lang_masks``
    ``(1, L)``, ``states`` ``(1, D)`` float32 and, if set, ``embodiment_ids`` ``(1,)`` int64:
    torch tensors on the CPU.

    Args:
        img_keys: cameras, as in training; ``observation.images.top`` and ``top`` mean the same.
            With none the batch has no images.
        transforms: tables of ``fluxvla.transforms``, or callables.
        norm_stats: the statistics, or the path of ``dataset_statistics.json``.
        embodiment_id: the robot's number in a model of several.
        statistic_name: which of the statistics.
        processors: a checkpoint's ``processors`` folder.
    """

    def __init__(
        self,
        img_keys: Sequence[str],
        transforms: Sequence[Mapping[str, Any] | Callable[..., Sample]],
        norm_stats: Mapping[str, Any] | str | Path | None = None,
        embodiment_id: int | None = None,
        statistic_name: str = "private",
        processors: str | Path | None = None,
    ) -> None:
        self.img_keys = tuple(img_keys)
        self.pipeline = Pipeline(transforms, processors).inference()
        self.embodiment_id = embodiment_id
        self.statistic_name = statistic_name
        self.stats = None
        if norm_stats is not None:
            statistics = load_statistics(norm_stats)
            if statistic_name not in statistics:
                raise ConfigError(
                    f"PrivateInferenceDataset: the statistics have no {statistic_name!r}; "
                    f"they have {', '.join(sorted(statistics))}"
                )
            self.stats = statistics[statistic_name]

    def __call__(self, observation: Mapping[str, Any]) -> dict[str, Any]:
        """Prepare one observation.

        Args:
            observation: ``qpos`` ``(D,)``, ``task_description``, and images ``(H, W, 3)`` uint8
                RGB, either under ``images`` or flat, by camera.

        Raises:
            DataError: an image or the state is missing or of another type.
            ConfigError: there is no instruction, or a transform does not fit.
        """
        import torch

        sample: Sample = {"states": _state(observation)}
        if self.img_keys:
            sample["images"] = [self._image(observation, key) for key in self.img_keys]
            sample["img_masks"] = np.ones(len(self.img_keys), np.bool_)
        if "task_description" in observation:
            sample["task_description"] = observation["task_description"]
        if self.stats is not None:
            sample["stats"] = self.stats
        if self.embodiment_id is not None:
            sample["embodiment_ids"] = np.asarray(self.embodiment_id, np.int64)
        sample = self.pipeline(sample)
        if self.img_keys:
            sample["images"] = stack_images(sample["images"])
        batch = {key: np.asarray(sample[key])[None] for key in _KEYS if key in sample}
        return {k: torch.from_numpy(np.ascontiguousarray(array)) for k, array in batch.items()}

    def _image(self, observation: Mapping[str, Any], key: str) -> npt.NDArray[np.uint8]:
        nested = observation.get("images")
        images = nested if isinstance(nested, Mapping) else observation
        for name in (key, camera_name(key)):
            image = images.get(name)
            if image is not None:
                return _chw(name, image)
        have = sorted(k for k, v in images.items() if np.ndim(v) == 3)
        raise DataError(
            f"the observation has no image of camera {camera_name(key)!r}; "
            f"it has {', '.join(have) or 'none'}"
        )


def _chw(name: str, image: Any) -> npt.NDArray[np.uint8]:
    array = np.asarray(image)
    if array.dtype != np.uint8 or array.ndim != 3 or array.shape[2] != 3 or not array.size:
        raise DataError(
            f"camera {name!r} gives {array.dtype} of shape {array.shape}; "
            "uint8 of shape (height, width, 3) is expected"
        )
    return array.transpose(2, 0, 1)


def _state(observation: Mapping[str, Any]) -> npt.NDArray[np.float32]:
    if observation.get("qpos") is None:
        raise DataError(f"the observation has no 'qpos'; it has {', '.join(sorted(observation))}")
    state = np.array(observation["qpos"], np.float32)
    if state.ndim != 1 or not np.isfinite(state).all():
        raise DataError(f"'qpos' must be one row of finite numbers, got {state.tolist()}")
    return state


def try_preparation(
    prepare: Callable[[Mapping[str, Any]], Any],
    denormalize: Callable[[Mapping[str, Any]], Any],
    cameras: Mapping[str, tuple[int, int]],
    state_dim: int,
    chunk: tuple[int, int],
    where: str,
) -> Mapping[str, Any]:
    """Prepare a blank observation, and scale a chunk of zeros back.

    Errors of transforms and statistics (a number of images, a width, a missing statistic) come at
    once, and with the checkpoint's name, not when the robot asks the first time.

    Args:
        prepare, denormalize: of a ``LocalPolicy``.
        cameras: name -> height and width of its images.
        state_dim: numbers of a state.
        chunk: actions, and numbers of each.
        where: the checkpoint.

    Returns:
        The batch of the observation, empty where ``prepare`` gives something else.

    Raises:
        FluxError: what they raise.
    """
    states = np.zeros(state_dim, np.float32)
    images = {name: np.zeros((*size, 3), np.uint8) for name, size in cameras.items()}
    observation = {"qpos": states, "images": images, "task_description": _INSTRUCTION}
    with located(where):
        batch = prepare(observation)
        denormalize({"action": np.zeros((1, *chunk), np.float32), "states": states})
    return batch if isinstance(batch, Mapping) else {}
