"""``RemoteOperator``: in the main process, the images of an operator in the control process."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import Any, ClassVar

from fluxvla_core.contracts.frame import Frame
from fluxvla_core.contracts.robot import Operator
from fluxvla_core.errors import NotReady, Rejected
from fluxvla_core.robot.process.frames import (
    FrameChannel,
    FrameMemory,
    FrameMessage,
    frame_bytes,
    frame_of,
    make_frame_memory,
    observation_of,
)
from fluxvla_core.robot.process.messages import error_of
from fluxvla_core.spec import EmbodimentSpec

# How often a wait for a frame sees whether there is still somebody who could send one.
_POLL_S = 0.05


class RemoteOperator(Operator):
    """Stands in for an operator that runs as a whole in the control process: it gives its frames.

    Args:
        name: of the operator's class, for messages.
        embodiment: of the robot.
        domain_id: as the operator has it.
    """

    api: ClassVar[str] = "1.0"

    def __init__(self, name: str, embodiment: EmbodimentSpec, domain_id: int | None = None) -> None:
        self.name, self._embodiment, self._domain_id = name, embodiment, domain_id
        self._channel: FrameChannel | None = None
        # One request at a time.
        self._lock = threading.Lock()

    @property
    def embodiment(self) -> EmbodimentSpec:
        return self._embodiment

    @property
    def domain_id(self) -> int | None:
        return self._domain_id

    def open(self, cameras: Sequence[str]) -> FrameMemory:
        """The descriptors that a new control process is to have; this end keeps its own.

        Args:
            cameras: names of the cameras whose images are requested.

        Raises:
            OSError: the system has no room for it.
        """
        memory = make_frame_memory(frame_bytes(self.embodiment, cameras))
        self._channel = FrameChannel(memory)
        return memory

    def connect(self) -> None:
        """The control process connects to the robot."""

    def get_frame(self) -> Frame:
        """The newest frame, read in the control process for this call.

        Raises:
            NotReady: the control process does not run.
            FluxError: what the operator raised, or what is wrong with what it gave.
        """
        return frame_of(self.read_frame_message())

    def observe(self) -> tuple[dict[str, Any], Frame | None]:
        """The observation that the runner in the control process makes; raises as ``get_frame``."""
        return observation_of(self.read_frame_message())

    def read_frame_message(self) -> FrameMessage:
        """Request one frame or observation from the control process; raises as ``get_frame``."""
        with self._lock:
            channel = self._channel
            if channel is None:
                raise self._gone()
            channel.request()
            while not channel.answered(_POLL_S):
                if self._channel is not channel:
                    raise self._gone()
            message = channel.take()
        if "error" in message.fields:
            raise error_of(message.fields["error"])
        return message

    def send_action(self, action: Any) -> None:
        """Raises Rejected: the control process commands the robot."""
        raise Rejected(
            f"{self.name} runs in the control process, which alone sends commands",
            next="--set <section>.control_process=false drives it from this process",
        )

    def stop(self) -> None:
        """The control process stops the robot."""

    def close(self) -> None:
        """There are no more frames: the control process ended, or is to end."""
        channel, self._channel = self._channel, None
        if channel is not None:
            # Who waits for a frame gives up soon.
            with self._lock:
                channel.close()

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(
            f"{vars(self).get('name')} runs in the control process; here are its frames, and no "
            f"{name} (--set <section>.control_process=false keeps it in one process)"
        )

    def _gone(self) -> NotReady:
        return NotReady(f"{self.name} gives no frames: the control process does not run")
