"""``ReplayPolicy``: what was done in a recording, done again."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import numpy.typing as npt

from fluxvla_core.build import RunContext
from fluxvla_core.contracts.frame import Observation
from fluxvla_core.contracts.policy import Continuation, Policy
from fluxvla_core.errors import ConfigError, DataError
from fluxvla_core.robot.policy_calls import PolicyEnded
from fluxvla_core.robot.recording.recorded import Recorded, open_recording
from fluxvla_core.spec.embodiment import EmbodimentSpec

Array = npt.NDArray[np.float64]
CHUNKS, COMMANDS = "chunks", "commands"
ENDED = "recording_ended"
"""An episode's outcome."""


class RecordingEnded(PolicyEnded):
    """A replayed policy has no answer left."""

    outcome = ENDED


class ReplayPolicy(Policy):
    """Gives the recorded answers, whatever it is shown; after the last one the episode ends.

    ``chunks`` repeats the policy: its n-th answer again at the n-th question. From the same start
    and with the same runner settings that gives the same commands; a runner that asks more often,
    or less often, than the recorded one plays less of each answer, or more. ``commands`` repeats
    the motion with any settings: all commands of the task as one chunk, played to its end. The
    runner's safety is the same as for any policy.

    Args:
        recording: an episode's folder, with or without pictures, or its MCAP file.
        actions: ``chunks`` or ``commands``.
        context: what the run knows (injected): its reporter learns when the recording ends.

    Raises:
        ConfigError: ``actions`` is neither.
    """

    cameras: tuple[str, ...] = ()
    """It looks at none."""

    def __init__(
        self, recording: str, actions: str = CHUNKS, context: RunContext | None = None
    ) -> None:
        if actions not in (CHUNKS, COMMANDS):
            raise ConfigError(f"actions {actions!r} is neither {CHUNKS!r} nor {COMMANDS!r}")
        self.recording = recording
        self.actions = actions
        self._reporter = (context or RunContext()).reporter
        self._next = 0

    @cached_property
    def recorded(self) -> Recorded:
        """The recording, read when it is first needed.

        Raises:
            DataError: it cannot be read.
        """
        return open_recording(self.recording)

    @property
    def embodiment(self) -> EmbodimentSpec:
        """The recorded robot."""
        return self.recorded.embodiment

    @property
    def action_rate_hz(self) -> float:
        """Keyframes a second."""
        key = "action_rate_hz" if self.actions == CHUNKS else "rate_hz"
        return float(self.recorded.start[key])

    @property
    def horizon(self) -> int:
        """Keyframes of a chunk."""
        return len(self._chunks[0])

    @property
    def whole_motion(self) -> bool:
        """Whether its one chunk is all that there is to do."""
        return self.actions == COMMANDS

    def reset(self, seed: int) -> None:
        """Begin anew; nothing is drawn."""
        self._next = 0

    def predict_action(self, observation: Observation) -> Array:
        """``(horizon, dim)``: the next answer.

        Raises:
            RecordingEnded: there is none left; a robot's episode ends well with it.
        """
        if self._next >= len(self._chunks):
            cut = "" if self.recorded.whole else ", where it was cut short"
            text = f"the recording {self.recorded.path} ends here{cut}"
            self._reporter.info(text)
            raise RecordingEnded(text)
        self._next += 1
        return self._chunks[self._next - 1].copy()

    def continue_action(self, observation: Observation, rest: Continuation) -> Array:
        """The next answer, whatever it had to go on from when it was recorded."""
        return self.predict_action(observation)

    @cached_property
    def _chunks(self) -> list[Array]:
        recorded = self.recorded
        if self.actions == CHUNKS:
            found = recorded.chunks()
        else:
            commands = recorded.commands("run")[1]
            found = [commands] if len(commands) else []
        if not found:
            raise DataError(
                f"the recording holds no {self.actions}: nothing was done in it",
                where=str(recorded.path),
            )
        return found
