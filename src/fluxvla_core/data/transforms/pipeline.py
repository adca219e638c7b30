"""``Pipeline``: a list of transforms, the same for training and for inference."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from fluxvla_core.build import build_transform_from_cfg
from fluxvla_core.errors import ConfigError
from fluxvla_core.untrusted import read_json

Sample = dict[str, Any]
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
        self.transforms = [build_transform_from_cfg(_redirect(t, saved)) for t in transforms]

    def __call__(self, sample: Sample, rng: np.random.Generator | None = None) -> Sample:
        for transform in self.transforms:
            if not getattr(transform, "needs_rng", False):
                sample = transform(sample)
                continue
            if rng is None:
                raise ConfigError(
                    f"{type(transform).__name__} draws random numbers, which only training has",
                    next="give it training_only = True, or take it out of this section",
                )
            sample = transform(sample, rng)
        return sample

    def inference(self) -> Pipeline:
        """The same transforms without the ``training_only`` ones."""
        return self._of([t for t in self.transforms if not getattr(t, "training_only", False)])

    def deferring(self) -> Pipeline | None:
        """The same transforms, with normalising images left to the device; None if that cannot be.

        It must be the last transform that touches images. Those after it declare that they do not
        by ``keeps_images = True``; if one does not declare it, nothing can be left.
        """
        for place, transform in reversed(list(enumerate(self.transforms))):
            if declared(transform, "keeps_images", "__call__"):
                continue
            if declared(transform, "defer", "__call__") is None:
                return None
            before, after = self.transforms[:place], self.transforms[place + 1 :]
            return self._of([*before, transform.defer, *after])
        return None

    def save_pretrained(self, folder: str | Path) -> None:
        """Save every tokenizer into ``folder``, under the path that its table named it by."""
        root = Path(folder)
        index: dict[str, str] = {}
        for transform in self.transforms:
            tokenizer = getattr(transform, "tokenizer", None)
            path = getattr(tokenizer, "model_path", None)
            if tokenizer is None or path is None:
                continue
            path = self._named.get(path, path)
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
    """``dataset.deferring()``, or None if its samples are made by another class than that one's."""
    defer = declared(dataset, "deferring", "get_samples")
    return None if defer is None else defer(dataset)


def declared(thing: object, name: str, method: str) -> Any:
    """The attribute ``name`` of the class that defines ``thing``'s ``method``; None without one.

    A subclass that overrides ``method`` does not inherit what was declared of the old one, and a
    wrapper that delegates attributes declares nothing.
    """
    owner = next((cls for cls in type(thing).__mro__ if method in vars(cls)), object)
    return vars(owner).get(name)


def _saved(folder: Path) -> dict[str, str]:
    """Model path in a config -> folder of its saved copy."""
    file = folder / INDEX
    if not os.path.lexists(file):
        return {}
    names = read_json(file, dict[str, str], ConfigError)
    for name in names.values():
        if PurePath(name).name != name:
            raise ConfigError(f"{name!r} is no folder beside it", where=str(file))
    return {path: str(folder / name) for path, name in names.items()}


def _redirect(table: Any, saved: Mapping[str, str]) -> Any:
    if not isinstance(table, Mapping) or not isinstance(table.get("tokenizer"), Mapping):
        return table
    tokenizer = table["tokenizer"]
    path = saved.get(str(tokenizer.get("model_path")))
    return table if path is None else {**table, "tokenizer": {**tokenizer, "model_path": path}}
