"""Widths of a batch, compared with the model's."""

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


def check_actions(who: str, actions: Tensor, chunk: tuple[int, int]) -> None:
    """Compare ``actions`` ``(B, T, D)`` with the model's ``chunk`` ``(T, D)``.

    Raises:
        ConfigError: they differ; names both.
    """
    if tuple(actions.shape[1:]) != chunk:
        raise ConfigError(
            f"{who}: actions are {tuple(actions.shape[1:])} a sample, the model's chunks {chunk}",
            cause="the model was made for another robot, or action_window_size is another",
            next="let train_dataloader.dataset.action_window_size be the model's horizon, and the "
            "width of the (padded) actions the model's",
        )
