"""Supervision of an episode at every control tick: state, tracking error, interrupts, its end."""

from __future__ import annotations

from collections.abc import Callable

from fluxvla_core.contracts.reporter import Reporter
from fluxvla_core.errors import FluxError
from fluxvla_core.robot.control.interrupt import Interrupts
from fluxvla_core.robot.control.sender import SentCommand
from fluxvla_core.robot.control.tracking import TrackingWatch
from fluxvla_core.robot.events import CommandSent, Event, Phase
from fluxvla_core.robot.robot import Robot


class EpisodeOver(BaseException):
    """Ends an episode from inside a tick. Not an error, and nobody's ``except Exception``."""

    def __init__(self, outcome: str) -> None:
        self.outcome = outcome
        super().__init__(outcome)


class Supervisor:
    """Watches the robot at every tick: its state, its tracking error, signals, the episode's end.

    Args:
        robot: the connected robot.
        tracking: compares its state with its commands.
        interrupts: signals that ask the run to end.
        max_steps: commands of the phase ``run`` after which the episode is over.
        reporter: shows how many commands were sent.
        emit: takes the event ``CommandSent``.

    ``phase`` is the current phase of the episode.
    """

    def __init__(
        self,
        robot: Robot,
        tracking: TrackingWatch,
        interrupts: Interrupts,
        max_steps: int,
        reporter: Reporter,
        emit: Callable[[Event], None],
    ) -> None:
        self.phase = Phase.START
        self._robot = robot
        self._tracking = tracking
        self._interrupts = interrupts
        self._max_steps = max_steps
        self._steps = 0
        self._reporter = reporter
        self._emit = emit

    def chunk_accepted(self) -> None:
        """The policy's motion begins, or continues."""
        self.phase = Phase.RUN

    def after_tick(self, sent: SentCommand | None, sent_at: float, late_s: float) -> None:
        """The tick after each command: reported always, supervised while it may still stop.

        Args:
            sent: the command; None at a tick without one.
            sent_at: time at which it was sent.
            late_s: seconds after its deadline.

        Raises:
            EpisodeOver: the task is done, or there were enough commands.
            NotFollowing: the arm is not where it is commanded to be.
            Interrupted: a signal came.
            FluxError: the state could not be read.
        """
        robot, phase = self._robot, self.phase
        try:
            measured, problem = robot.state(), None
        except FluxError as error:
            # What was sent is recorded all the same; and a stream that fell silent stops an arm,
            # it does not keep it from braking.
            measured, problem = None, error
        if sent is not None and phase is not Phase.OVER:
            state = None if measured is None else measured.state
            self._emit(CommandSent(robot.clock.now(), sent, phase, state, robot.sent_s, late_s))
        # Between two episodes, too: an arm that is held may be switched off, or moved.
        if not (phase.stoppable or phase is Phase.OVER):
            return
        if problem is not None:
            raise problem
        self._interrupts.check()
        if sent is not None:
            self._tracking.sent(sent.command, sent_at)
        if measured is not None and robot.follows_commands:
            self._tracking.check(measured.state, measured.at)
        if phase is not Phase.RUN or sent is None:
            return
        self._steps += 1
        self._reporter.progress("commands", self._steps, self._max_steps)
        if robot.done():
            raise EpisodeOver("done")
        if self._steps >= self._max_steps:
            raise EpisodeOver("max_steps")
