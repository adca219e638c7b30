"""Where a run's pictures are normalised: in the data workers, or on the device that trains."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from fluxvla_core.data.collator import DictCollator
from fluxvla_core.transforms.deferral import deferring

if TYPE_CHECKING:
    import torch


def on_device(device: torch.device) -> bool:
    """Whether normalising there saves three quarters of what is handed over: a GPU is far away."""
    return device.type == "cuda"


def source(dataset: Any, collator: Any, device: torch.device) -> Any:
    """``dataset`` as a loader is to read it: leaving to ``device`` what can be left to it.

    ``to_device`` then does it. Nothing is left with a collator of somebody else's, which may look
    at pictures.
    """
    stacks = type(collator).__call__ is DictCollator.__call__ and "images" in collator.keys
    found = deferring(dataset) if on_device(device) and stacks else None
    return dataset if found is None else found
