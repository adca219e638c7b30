"""Frames (a robot's state and images, with receipt times), observations (a policy's input)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypedDict

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

STATE = "state"


@dataclass(frozen=True)
class Frame:
    """The result of ``Operator.get_frame``; all arrays are fresh and belong to the caller.

    Args:
        state: ``(state_dim,)`` float64 in the embodiment's units and order.
        images: camera name -> ``(height, width, 3)`` uint8, RGB.
        stamps: stream -> monotonic receipt time in seconds; ``"state"``, each camera name, and what
            else came with them.
    """

    state: npt.NDArray[np.float64]
    images: Mapping[str, npt.NDArray[np.uint8]]
    stamps: Mapping[str, float]


@dataclass(frozen=True)
class RobotFrame(Frame):
    """A frame with what else the robot measures.

    Args:
        depths: camera name -> ``(height, width)`` float32 metres, NaN where nothing was measured.
        base: ``(2,)`` forward speed in m/s and turning speed in rad/s of a mobile base, or None.
    """

    depths: Mapping[str, npt.NDArray[np.float32]] = field(default_factory=dict)
    base: npt.NDArray[np.float64] | None = None


class _Present(TypedDict):
    qpos: npt.NDArray[np.float32]
    images: dict[str, npt.NDArray[np.uint8]]
    task_description: str


class Observation(_Present, total=False):
    """Input of a policy.

    ``qpos`` is ``(state_dim,)`` float32 in physical units, ``images`` maps camera name to
    ``(height, width, 3)`` uint8 RGB, ``task_description`` is the instruction in plain words.

    A policy with ``n_obs_steps`` above 1 also gets ``history``: the ``n_obs_steps - 1``
    observations before, the oldest first, each one of the policy's actions after the other. At the
    beginning of an episode its first observation is repeated.
    """

    history: Sequence[Observation]


Sample = dict[str, Any]
"""One training sample on its way through the transforms; keys as ``ParquetDataset`` says."""
