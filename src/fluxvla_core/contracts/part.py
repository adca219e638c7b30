"""``Part``: the whole robot, or the part of a divided one that an operator has."""

from __future__ import annotations

from enum import Enum

from fluxvla_core.errors import NotReady, Rejected


class Part(Enum):
    """The whole robot, or one of the two parts that ``Operator`` can be divided into.

    The value says which, in messages.
    """

    WHOLE = "the whole robot"
    WITHOUT_CAMERAS = "the part without cameras"
    WITHOUT_COMMANDS = "the part without commands"

    @property
    def cameras(self) -> bool:
        """Whether it reads images."""
        return self is not Part.WITHOUT_CAMERAS

    @property
    def commands(self) -> bool:
        """Whether it sends anything."""
        return self is not Part.WITHOUT_COMMANDS

    def check_cameras(self, robot: str) -> None:
        """Refuse a frame where there are no cameras.

        Raises:
            NotReady: this part has none; names the ``robot``.
        """
        if not self.cameras:
            raise NotReady(
                f"this part of {robot} has no cameras, and so no frames",
                cause="the robot is divided, and its cameras are in another process",
                next="call get_state() here, and get_frame() of the part without commands",
            )

    def check_commands(self, robot: str) -> None:
        """Refuse to send anything where nothing is sent.

        Raises:
            Rejected: this part sends nothing; names the ``robot``.
        """
        if not self.commands:
            raise Rejected(
                f"this part of {robot} sends no commands",
                cause="the robot is divided, and another process commands it",
                next="call send_action() of the part without cameras",
            )

    def divided(self, part: Part, connected: bool, robot: str) -> Part:
        """``part``, for an operator that is this one as yet.

        Args:
            part: what it is to become.
            connected: whether it is connected.
            robot: its name, for the message.

        Raises:
            Rejected: it is connected, or the other part.
        """
        if connected or self not in (Part.WHOLE, part):
            state = "connected" if connected else self.value
            raise Rejected(
                f"{robot} cannot become {part.value}: it is {state} already",
                next="build another operator for it",
            )
        return part
