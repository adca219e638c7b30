"""What a batch has, compared with what the model takes: widths, and actions that are given."""

from __future__ import annotations

from torch import Tensor

from fluxvla_core.errors import ConfigError


def check_states(who: str, key: str, states: Tensor, width: int) -> None:
    """Compare ``states`` ``(..., S)`` with the model's ``width``.

    Args:
        who: the model, for messages.
        key: what its config calls the width.

    Raises:
        ConfigError: they differ; names both.
    """
    if states.shape[-1] != width:
        raise ConfigError(
            f"{who}: states have {states.shape[-1]} numbers, {key} is {width}",
            cause="the model was made for another robot, or a transform pads states to another "
            "width",
            next=f"let {key}, and state_dim of the transform that normalises, be the width of the "
            "data's states or, where the model pads them, one width",
        )


def check_actions(
    who: str, shape: tuple[int, ...], chunk: tuple[int, int], what: str = "actions"
) -> None:
    """Compare the ``shape`` of a sample's actions with the model's ``chunk`` ``(T, D)``.

    Args:
        who: the model, for messages.
        what: what has the shape, if it is not the actions: their noise.

    Raises:
        ConfigError: they differ; names both.
    """
    if shape != chunk:
        raise ConfigError(
            f"{who}: {what} are {shape} a sample, the model's chunks {chunk}",
            cause="the model was made for another robot, or action_window_size is another",
            next="let train_dataloader.dataset.action_window_size be the model's horizon, and the "
            "width of the (padded) actions the model's",
        )


def check_prefix_len(prefix_conditioning: bool, prefix_len: Tensor | None) -> None:
    """Check that a training batch says how many actions are given if, and only if, the model asks.

    Args:
        prefix_conditioning: of the model: it is trained to continue a chunk.
        prefix_len: ``(B, K)`` int64 of the batch, or None.

    Raises:
        ConfigError: one without the other.
    """
    if prefix_conditioning != (prefix_len is not None):
        raise ConfigError(
            f"prefix_conditioning is {prefix_conditioning}, and the batch has "
            f"{'no' if prefix_len is None else 'a'} prefix_len",
            next="dict(type='SamplePrefixLength', max_delay=...) behind SampleFlowNoise, and "
            "prefix_len among the collator's keys, belong to prefix_conditioning=True",
        )
