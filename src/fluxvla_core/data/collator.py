"""``DictCollator``: collate samples to one batch of tensors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fluxvla_core.contracts.training import Collator
from fluxvla_core.data.transforms.images import SCALE
from fluxvla_core.errors import DataError


class DictCollator(Collator):
    """Collate samples: stack the keys that a model computes with, list the others.

    Args:
        keys: stacked into tensors of shape ``(batch, ...)``; every sample needs equal shapes.
        meta_keys: kept as plain lists, one entry a sample.

    What is left of normalising pictures (``image_scale``) is stacked without being listed.

    Keys that are configured but that no sample has are left out: one list serves datasets with
    and without ``embodiment_ids``.

    Raises:
        DataError: a sample has a key in neither list or one that another sample lacks, or its
            value cannot be stacked.
    """

    def __init__(
        self, keys: Sequence[str] | None = None, meta_keys: Sequence[str] | None = None
    ) -> None:
        self.keys = tuple(keys or ())
        self.meta_keys = tuple(meta_keys or ())

    def __call__(self, samples: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        if not samples:
            raise DataError("there are no samples to make a batch of")
        batch: dict[str, Any] = {}
        for sample in samples:
            _check_keys(samples[0], sample)
        for key in samples[0]:
            if key in self.keys or key == SCALE:
                batch[key] = _stack(key, [sample[key] for sample in samples])
            elif key in self.meta_keys:
                batch[key] = [sample[key] for sample in samples]
            else:
                raise DataError(
                    f"sample key {key!r} is in neither keys nor meta_keys of the collator",
                    next=f"add {key!r} to the collator's keys (to stack) or meta_keys (to list)",
                )
        return batch


def _check_keys(one: Mapping[str, Any], other: Mapping[str, Any]) -> None:
    differing = sorted(one.keys() ^ other.keys())
    if differing:
        without = other if differing[0] in one else one
        raise DataError(
            f"sample key {differing[0]!r} is missing in one sample of the batch; it has "
            f"{sorted(without)}",
            cause="datasets of a mixture that do not give the same, embodiment_id for example",
        )


def _stack(key: str, values: list[Any]) -> Any:
    import torch

    first = values[0]
    try:
        if isinstance(first, torch.Tensor):
            return torch.stack(values)
        if isinstance(first, np.ndarray | np.generic):
            return torch.from_numpy(np.stack(values))
    except (TypeError, ValueError, RuntimeError) as error:
        shapes = sorted({str(tuple(np.shape(value))) for value in values})
        raise DataError(
            f"sample key {key!r} cannot be stacked: shapes {', '.join(shapes)} ({error})"
        ) from error
    raise DataError(
        f"sample key {key!r} is listed in keys, but {type(first).__name__} cannot be stacked",
        next=f"move {key!r} to the collator's meta_keys",
    )
