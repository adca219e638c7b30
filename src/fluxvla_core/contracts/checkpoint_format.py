"""The contract of checkpoint formats of other projects: openpi's, LeRobot's, GR00T's, …"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from fluxvla_core.contracts.contract import Contract
from fluxvla_core.spec import EmbodimentSpec


@dataclass(frozen=True)
class ForeignCheckpoint:
    """A trained policy as another project's checkpoint has it, in the terms of this one.

    Args:
        model: the config's ``model`` table that builds the architecture.
        tensors: weights and buffers under the names of that model's ``state_dict``: torch tensors,
            or what ``safetensors_in`` and ``renamed`` give, which is read when it is used.
        img_keys: cameras, in the order in which the model takes their images.
        transforms: tables of the transforms from a robot's observation to a batch; one of them
            normalises states and actions, and is able to undo it.
        statistics: ``{"private": {"proprio": {...}, "action": {...}}}``, which they normalise by.
        horizon: actions in a chunk.
        action_rate_hz: actions a second, if the checkpoint has it.
        embodiment: the robot that it was trained for, if the checkpoint describes it.
        notes: remarks for the person who imports it.
    """

    model: Mapping[str, Any]
    tensors: Mapping[str, Any]
    img_keys: Sequence[str]
    transforms: Sequence[Mapping[str, Any]]
    statistics: Mapping[str, Any]
    horizon: int
    action_rate_hz: float | None = None
    embodiment: EmbodimentSpec | None = None
    notes: Sequence[str] = ()


class CheckpointFormat(Contract):
    """Reads, and may write, one model family's checkpoints as another project saves them."""

    name: ClassVar[str] = ""
    """``--format``: the project of the format (``lerobot``, ``openpi``); classes for several model
    families may share it."""
    model_types: ClassVar[Sequence[str]] = ()
    """The ``type`` of the models that it reads and writes."""

    @abstractmethod
    def recognizes(self, folder: Path) -> bool:
        """Whether ``folder`` is such a checkpoint, by its file names and at most its config.

        It must not raise for a folder of anything else.
        """

    @abstractmethod
    def read(self, folder: Path, tokenizer: str | None = None) -> ForeignCheckpoint:
        """The checkpoint in ``folder``.

        A format whose checkpoints leave a choice has parameters for it besides, which are then
        options of ``fluxvla import-checkpoint``:

        * ``robot: str | None = None``: whose statistics (and layers) are meant, where a checkpoint
          knows several, by the name that it has for it: GR00T's embodiment tag, OpenVLA's
          ``unnorm_key``; see ``chosen_robot``.
        * ``absent: Sequence[str] = ()``: cameras that the robot does not have, by the checkpoint's
          names. The model acts as in that project when their images are missing; see
          ``without_cameras``.

        Args:
            tokenizer: ``model_path`` of the tokenizer, for formats without one.

        Raises:
            CheckpointError: it is damaged, of a newer format, or of a model that is not built here.
            UsageError: it knows no such robot or camera; says which there are.
        """

    def write(self, checkpoint: ForeignCheckpoint, folder: Path) -> None:
        """Write ``checkpoint`` into the empty ``folder`` as that project saves one.

        Raises:
            CheckpointError: that format cannot hold it.
        """
        raise NotImplementedError(f"{type(self).__name__} is only read")
