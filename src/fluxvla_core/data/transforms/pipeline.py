"""``Pipeline``: a list of transforms, used in training and in inference."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path, PurePath
from typing import Any, cast

import numpy as np

from fluxvla_core.build import build_transform_from_cfg
from fluxvla_core.contracts.contract import implements, original
from fluxvla_core.contracts.frame import Sample
from fluxvla_core.contracts.training import RandomTransform, Tokenizer, Transform
from fluxvla_core.errors import ConfigError
from fluxvla_core.untrusted import read_json

INDEX = "processors.json"


class Pipeline:
    """Apply transforms in order.

    A transform is ``t(sample) -> sample``; one with ``needs_rng = True`` is called as
    ``t(sample, rng)``; one with ``training_only = True`` (augmentation, noise) is left out of
    :meth:`inference`.

    Args:
        transforms: config tables or callables.
        processors: a checkpoint's ``processors`` folder; tokenizers that were saved there are
            loaded from there instead of from the path that the table names.
    """

    def __init__(
        self,
        transforms: Sequence[Mapping[str, Any] | Callable[..., Sample]],
        processors: str | Path | None = None,
    ) -> None:
        saved = _saved(Path(processors)) if processors is not None else {}
        self._named = {copy: path for path, copy in saved.items()}
        built = [build_transform_from_cfg(_redirect(t, saved)) for t in transforms]
        self.transforms: list[Transform | RandomTransform] = [
            t if isinstance(t, RandomTransform) else Transform.adapt(t) for t in built
        ]

    def __call__(self, sample: Sample, rng: np.random.Generator | None = None) -> Sample:
        for transform in self.transforms:
            if not transform.needs_rng:
                try:
                    sample = cast(Transform, transform)(sample)
                except KeyError as error:
                    _explain_missing(transform, sample, error)
                    raise
                continue
            if rng is None:
                raise ConfigError(
                    f"{type(transform).__name__} draws random numbers, which only training has",
                    next="give it training_only = True, or take it out of this section",
                )
            sample = cast(RandomTransform, transform)(sample, rng)
        return sample

    def inference(self) -> Pipeline:
        """The same transforms without the ``training_only`` ones."""
        return self._of([t for t in self.transforms if not t.training_only])

    def deferring(self) -> Pipeline | None:
        """The same transforms, with normalising images deferred to the device; None if impossible.

        It must be the last transform that uses images. Those after it declare that they do not
        by ``keeps_images = True``; if one does not declare it, nothing can be deferred.
        """
        for place, transform in reversed(list(enumerate(self.transforms))):
            if declared(transform, "keeps_images", "__call__"):
                continue
            if declared(transform, "defer", "__call__") is None:
                return None
            before, after = self.transforms[:place], self.transforms[place + 1 :]
            return self._of([*before, transform.defer, *after])
        return None

    def warnings(
        self, stats: Mapping[str, Any], states: Sequence[str], actions: Sequence[str]
    ) -> list[str]:
        """Warnings of the transforms before training; see ``Transform.warnings``."""
        return [text for t in self.transforms for text in t.warnings(stats, states, actions)]

    def save_pretrained(self, folder: str | Path) -> None:
        """Save every tokenizer into ``folder``, under the path that its table named it by."""
        root = Path(folder)
        index: dict[str, str] = {}
        for transform in self.transforms:
            if not implements(transform.tokenizer, Tokenizer, "save_pretrained"):
                continue
            tokenizer = Tokenizer.adapt(transform.tokenizer)
            if tokenizer.model_path is None:
                continue
            path = self._named.get(tokenizer.model_path, tokenizer.model_path)
            if path in index:
                continue
            name = "tokenizer" if not index else f"tokenizer-{len(index) + 1}"
            tokenizer.save_pretrained(root / name)
            index[path] = name
        if index:
            (root / INDEX).write_text(json.dumps(index, indent=1) + "\n", encoding="utf-8")

    def _of(self, transforms: Sequence[Any]) -> Pipeline:
        other = Pipeline(transforms)
        other._named = self._named
        return other


def deferring(dataset: Any) -> Any:
    """``dataset.deferring()``; None if a class that has none makes its samples."""
    defer = declared(dataset, "deferring", "get_samples")
    return None if defer is None else defer(original(dataset))


def declared(thing: object, name: str, method: str) -> Any:
    """The attribute ``name`` of the class that defines ``thing``'s ``method``; None without one.

    A subclass that overrides ``method`` does not inherit the declarations about the old one, and a
    wrapper that delegates attributes declares nothing.
    """
    owner = next((cls for cls in type(original(thing)).__mro__ if method in vars(cls)), object)
    return vars(owner).get(name)


def redirected(tables: Sequence[Mapping[str, Any]], processors: Path) -> list[Mapping[str, Any]]:
    """``tables`` with the tokenizers that a checkpoint's ``processors`` folder has."""
    saved = _saved(processors)
    return [_redirect(table, saved) for table in tables]


_OF_A_SAMPLE = {
    "images": "img_keys names no camera",
    "states": "the data or the robot has no state",
    "task_description": "the data or the section has no task",
    "stats": "there are no statistics: norm_stats, or a dataset or checkpoint that has them",
}
"""What a transform may look for in a sample -> why it may not be there."""


def _explain_missing(transform: Any, sample: Sample, error: KeyError) -> None:
    key = error.args[0] if error.args else None
    if key in _OF_A_SAMPLE and key not in sample:
        raise ConfigError(
            f"{type(transform).__name__} needs {key!r}; the sample has {', '.join(sorted(sample))}",
            cause=_OF_A_SAMPLE[key],
        ) from error


def _saved(folder: Path) -> dict[str, str]:
    """Model path in a config -> folder of its saved copy."""
    file = folder / INDEX
    if not os.path.lexists(file):
        return {}
    names = read_json(file, dict[str, str], ConfigError)
    for name in names.values():
        if PurePath(name).name != name:
            raise ConfigError(f"{name!r} is not a folder next to it", where=str(file))
    return {path: str(folder / name) for path, name in names.items()}


def _redirect(table: Any, saved: Mapping[str, str]) -> Any:
    if not isinstance(table, Mapping) or not isinstance(table.get("tokenizer"), Mapping):
        return table
    tokenizer = table["tokenizer"]
    path = saved.get(str(tokenizer.get("model_path")))
    return table if path is None else {**table, "tokenizer": {**tokenizer, "model_path": path}}
