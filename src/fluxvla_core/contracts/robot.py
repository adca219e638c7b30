"""The contracts of a robot: operator and its parts, action filter, clock."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from enum import Enum
from typing import TYPE_CHECKING, Any

from fluxvla_core.contracts.contract import Contract, attribute, required
from fluxvla_core.contracts.frame import Frame
from fluxvla_core.errors import NotReady, Rejected
from fluxvla_core.spec import EmbodimentSpec

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt


class Clock(Contract):
    """The time that the control loop lives in: monotonic on robots, stepped in simulations."""

    @abstractmethod
    def now(self) -> float:
        """Seconds; only differences mean something."""

    @abstractmethod
    def sleep_until(self, deadline: float) -> None:
        """Return at ``deadline`` (seconds on this clock), at once if it is past."""

    @attribute
    def lockstep(self) -> bool:
        """Whether time passes only with commands, as in a simulation that steps its physics."""
        return True


class Operator(Contract):
    """Driver of one robot. The constructor names every parameter and does no I/O.

    A class that inherits nothing needs ``get_frame`` only, where its runner sends the commands and
    the config gives the embodiment; one with ``send_action`` needs ``stop``, too.
    """

    @required
    def embodiment(self) -> EmbodimentSpec:
        """Joints, cameras, limits and rate of the robot; valid before ``connect``."""

    @abstractmethod
    def connect(self) -> None:
        """Open the connection. Raises NotReady (try again), Rejected, or Faulted."""

    @abstractmethod
    def get_frame(self) -> Frame:
        """The newest frame, in fresh arrays. Raises NotReady before the first one."""

    @abstractmethod
    def send_action(self, action: npt.NDArray[np.float64]) -> None:
        """Send one ``(dim,)`` command in the embodiment's units.

        Raises Rejected for a wrong shape, a non-finite or out-of-spec value, before any I/O.
        """

    @abstractmethod
    def stop(self) -> None:
        """Come to a safe stop and hold: in any state, from any thread; may be called several times.

        A later stop, ``close``'s among them, sends the arm nothing unless ``send_action`` succeeded
        since: it may have been moved, and would be thrown back. An arm that somebody else commands
        is sent nothing at all. A speed, a mobile base's, is set to zero by every stop.
        """

    @abstractmethod
    def close(self) -> None:
        """Close the connection and free all resources; may be called several times."""

    # -- optional abilities ----------------------------------------------------------------------

    @attribute
    def clock(self) -> Clock | None:
        """The robot's own time; None is the monotonic clock.

        A simulation that steps its physics in ``send_action`` has one. Its ``lockstep`` (True by
        default) says whether that time stands still between commands.
        """
        return None

    @attribute
    def follows_commands(self) -> bool:
        """Whether the arm executes its commands; False for a recorded one.

        Its tracking error is then no fault.
        """
        return True

    @attribute
    def last_action(self) -> npt.NDArray[np.float64] | None:
        """``(dim,)`` the command that holds the arm: the last one, or what ``stop`` made of it.

        None if it has none, or one of somebody else's. Where this is defined episodes begin from
        there: an arm lags behind what holds it, and a gripper presses, and neither is to be let go.
        After a stop, a joint further from it than ``HOLD_REACH`` (``control.tracking``) was moved,
        and begins where it is.
        """
        return None

    @attribute
    def speed_scaling(self) -> float:
        """Share of its speed that a person lets the robot have: 0 (paused) to 1.

        Commands keep to it. ``send_action`` refuses while the robot is paused.
        """
        return 1.0

    @attribute
    def domain_id(self) -> int | None:
        """The ROS domain that the robot is on, and that tasks on a topic are taken from.

        None is ``ROS_DOMAIN_ID``; a robot without ROS has no other.
        """
        return None

    def get_state(self) -> npt.NDArray[np.float64] | None:
        """The newest ``(state_dim,)`` state alone, at no cost; None where that is not available.

        The arm is then watched at every command. Called from the thread that sends commands.
        """
        return None

    def state_stamp(self) -> float | None:
        """When the newest state arrived, in seconds on ``clock``; None takes it for new.

        An arm whose joint states are old is then not taken for one that does not follow.
        """
        return None

    def begin_episode(self, instruction: str, episode: int) -> None:
        """Episode number ``episode`` (from 0) begins; the arm has not moved in it yet.

        A simulation puts its objects in place.
        """

    def task_done(self) -> bool:
        """Whether the episode can end here; asked after each command."""
        return False

    def task_success(self) -> bool | None:
        """Whether the task is done as of now; None if unknown. Asked at the end of an episode."""
        return None

    def episode_facts(self) -> Mapping[str, Any]:
        """JSON values that go into the results of an evaluation, after each episode."""
        return {}

    def images_after(
        self, camera: str, after: float
    ) -> tuple[Sequence[tuple[float, npt.NDArray[np.uint8]]], int]:
        """Images that are kept for recordings, which then have all that arrive.

        Stamps and ``(H, W, 3)`` uint8 RGB images, oldest first, and how many ever arrived.
        Called often, from a thread of its own; ``after`` is the stamp of the last one it has.
        Without this method recordings have the images of the frames.
        """
        return (), 0

    # -- one robot in two processes --------------------------------------------------------------

    def without_cameras(self) -> Operator | None:
        """The state and the commands of this robot, for the process that commands it.

        None (the default) says that this robot cannot be divided. Called before ``connect``, on an
        operator that is not used itself afterwards: it may return itself. Another process has the
        other part, at the same time. ``embodiment`` is still that of the whole robot, with its
        cameras. Everything is asked but ``images_after`` and ``get_frame``, which raises
        NotReady; ``get_state`` and ``state_stamp`` are needed then.
        """
        return None

    def without_commands(self) -> Operator | None:
        """The cameras and the state of this robot, read only, for the process that asks the policy.

        None (the default) says that this robot cannot be divided. Called as ``without_cameras`` is.
        The part has a connection of its own, and is asked ``connect``, ``get_frame``,
        ``get_state``, ``state_stamp``, ``images_after``, ``close``, ``domain_id``, ``clock`` and
        ``embodiment`` only. It sends the robot nothing, also not in ``close``; it neither holds the
        arm nor looks for others who command it. ``send_action`` raises Rejected, ``stop`` does
        nothing.
        """
        return None

    _together = (("without_cameras", "without_commands"),)

    @classmethod
    def _enough(cls, candidate: type) -> tuple[tuple[str, ...], ...]:
        if getattr(candidate, "send_action", None) is not None:
            return (("get_frame", "send_action", "stop"),)
        return (("get_frame",),)


class ActionFilter(Contract):
    """Changes a policy's targets before the limits are applied, which no filter can undo."""

    @abstractmethod
    def __call__(self, action: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """The ``(dim,)`` target, in physical units, that takes the place of ``action``."""

    def bind(self, embodiment: EmbodimentSpec) -> None:
        """Called once, before the robot is connected. Raises ConfigError if it does not fit."""

    def reset(self, pose: npt.NDArray[np.float64]) -> None:
        """An episode begins with the arm at ``(dim,)`` ``pose``."""


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
        """``part``, if an operator that is ``self`` can become it.

        Args:
            part: the new part.
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
