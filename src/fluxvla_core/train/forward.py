"""From a collated batch to a loss: only what the model asks for, on the device it is on."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from fluxvla_core.errors import ConfigError
from fluxvla_core.train.units import blocks_of
from fluxvla_core.transforms.deferral import normalized

IDS = "sample_ids"


def to_device(batch: Mapping[str, Any], device: torch.device) -> dict[str, Any]:
    """Tensors of a batch on ``device``; from pinned memory the copy overlaps with computing.

    Pictures are normalised there if that has been left to the device.
    """
    return normalized(
        {
            key: value.to(device, non_blocking=True) if isinstance(value, Tensor) else value
            for key, value in batch.items()
        }
    )


class ForwardArguments:
    """Chooses, from a batch, the arguments of ``model.forward``.

    Lists (``meta_keys``) and ``sample_ids`` that the model does not take are left out; a tensor
    that it does not take is an error, because a mask under a wrong name would train silently
    without it.

    Raises:
        ConfigError: the model takes no such tensor, or lacks one that it needs.
    """

    def __init__(self, model: nn.Module, where: str | None = None) -> None:
        self._where = where
        parameters = inspect.signature(model.forward).parameters.values()
        self._model = type(model).__name__
        self._any = any(p.kind is p.VAR_KEYWORD for p in parameters)
        named = [p for p in parameters if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)]
        self._taken = {p.name for p in named}
        self._needed = {p.name for p in named if p.default is p.empty}

    def __call__(self, batch: Mapping[str, Any]) -> dict[str, Any]:
        if self._any:
            return dict(batch)
        missing = sorted(self._needed - set(batch))
        if missing:
            raise ConfigError(
                f"{self._model}.forward needs {', '.join(map(repr, missing))}, which the batch "
                f"does not have; it has {', '.join(sorted(batch))}",
                where=self._where,
                next="let a transform of the dataset make it, and list it in the collator's keys",
            )
        extra = sorted(
            key
            for key, value in batch.items()
            if key not in self._taken and key != IDS and isinstance(value, Tensor)
        )
        if extra:
            raise ConfigError(
                f"{self._model}.forward takes no {', '.join(map(repr, extra))}; "
                f"it takes {', '.join(sorted(self._taken))}",
                where=self._where,
                next="move what only describes from the collator's keys to meta_keys",
            )
        return {key: value for key, value in batch.items() if key in self._taken}


def loss_of(output: Any, model: nn.Module) -> Tensor:
    """The scalar ``output["loss"]``.

    Raises:
        ConfigError: the model returned something else.
    """
    loss = output.get("loss") if isinstance(output, Mapping) else None
    if not (isinstance(loss, Tensor) and loss.ndim == 0):
        raise ConfigError(
            f"{type(model).__name__}.forward must return a mapping with a scalar tensor 'loss'"
        )
    return loss


def sample_losses_of(output: Any) -> Tensor | None:
    """``output["sample_losses"]``, ``(B,)``, if the model tells each sample's: for the records."""
    losses = output.get("sample_losses") if isinstance(output, Mapping) else None
    return losses.detach() if isinstance(losses, Tensor) else None


def checkpoint_activations(model: nn.Module) -> None:
    """Recompute the model's ``fsdp_units`` in the backward pass instead of keeping their insides.

    Raises:
        ConfigError: the model names no units.
    """
    from torch.utils.checkpoint import checkpoint

    units = blocks_of(model)
    if not units:
        raise ConfigError(
            f"enable_gradient_checkpointing: {type(model).__name__} names no units to recompute",
            cause="it has no fsdp_units()",
        )
    for unit in units:
        unit.__dict__["forward"] = _recomputed(unit.forward, checkpoint)


def compile_units(model: nn.Module) -> None:
    """Compile each of the model's ``fsdp_units`` by itself; names and state stay as they are.

    Only what is inside a unit's ``forward``: what sharding does before and after it, and drawing
    noise and time, stay outside.

    Raises:
        ConfigError: the model names no units.
    """
    units = blocks_of(model)
    if not units:
        raise ConfigError(
            f"compile_blocks: {type(model).__name__} names no blocks to compile",
            cause="it has no fsdp_units()",
        )
    for unit in units:
        unit.__dict__["forward"] = torch.compile(unit.forward)


def _recomputed(forward: Any, checkpoint: Any) -> Any:
    def run(*args: Any, **kwargs: Any) -> Any:
        return checkpoint(forward, *args, use_reentrant=False, **kwargs)

    return run
