"""``UndividedRobot``: a robot whose commands and images are both handled in the control process."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Sequence
from typing import Any

from fluxvla_core.contracts.frame import STATE
from fluxvla_core.control.safety import BadFrame, BadTiming
from fluxvla_core.errors import FluxError
from fluxvla_core.robot.process.frames import (
    FrameChannel,
    FrameMessage,
    frame_of,
    message_of_frame,
    message_of_observation,
)
from fluxvla_core.robot.process.messages import error_fields
from fluxvla_core.robot.robot import Observe, Robot, StateSample, as_state, check_frame, is_number
from fluxvla_core.spec import EmbodimentSpec


class UndividedRobot(Robot):
    """A robot that is not divided; the main process requests its frames.

    They are read in a thread of its own: a camera that keeps ``get_frame`` waiting delays no
    command. Code in there that holds the GIL does.

    Args:
        operator, embodiment, runner_sends: as ``Robot`` has them.
    """

    def __init__(
        self, operator: Any, embodiment: EmbodimentSpec, runner_sends: bool = False
    ) -> None:
        super().__init__(operator, embodiment, runner_sends)
        self._observe: Observe | None = None
        self._cameras: tuple[str, ...] = ()
        self._max_age_s = math.inf
        # When the call of ``get_frame`` that is under way began; None if none is.
        self._began: float | None = None
        self._states: deque[StateSample] = deque(maxlen=1)

    def observed_by(self, observe: Observe) -> None:
        """Have a runner make the observations, before ``serve``."""
        self._observe = observe

    def serve(self, channel: FrameChannel, cameras: Sequence[str], max_age_s: float) -> None:
        """Begin to answer the main process.

        Args:
            channel: the control process's end.
            cameras: names of the cameras whose images are sent.
            max_age_s: how long ``get_frame`` may take while the arm moves.
        """
        self._cameras, self._max_age_s = tuple(cameras), max_age_s

        def answer() -> None:
            while True:
                channel.wait_for_request()
                self._began = time.monotonic()
                message = self._read_message(channel)
                self._began = None
                channel.answer(message)

        threading.Thread(target=answer, name="fluxvla-frames", daemon=True).start()

    def check_frame_time(self) -> None:
        """Raise an error if ``get_frame`` takes too long; called at every command in motion.

        Raises:
            BadTiming: it does not: what it will give is old.
        """
        began = self._began
        seconds = 0.0 if began is None else time.monotonic() - began
        if seconds > self._max_age_s:
            raise BadTiming(
                f"{self.frame_call.name} has not returned for {seconds:.2f} s, "
                f"safety.max_age_s is {self._max_age_s:g}",
                cause=self.frame_call.cause,
                next=self.frame_call.next,
            )

    def state(self) -> StateSample | None:
        """As ``Robot.state``; without ``get_state`` that of each frame, once."""
        measured = super().state()
        if measured is not None or not self._states:
            return measured
        return self._states.popleft()

    def _read_message(self, channel: FrameChannel) -> FrameMessage:
        """The result of one ``get_frame``, or its error."""
        try:
            message = self._read()
            if channel.fits(message):
                return message
            error: BaseException = self._too_large(message)
        except BaseException as raised:  # noqa: BLE001 - raised in the main process
            error = raised
        message = FrameMessage({"error": error_fields(error)})
        if channel.fits(message):
            return message
        what = f"{self.frame_call.name} raised {type(error).__name__} with a very long message"
        return FrameMessage({"error": error_fields(BadFrame(what))})

    def _read(self) -> FrameMessage:
        if self._observe is None:
            frame = self.frame()
            message = message_of_frame(frame, self._cameras, self.frame_call.name)
            self._keep_state(frame.state, frame.stamps.get(STATE))
            return message
        try:
            window, made_of = self._observe()
        except FluxError:
            raise
        except (Exception, SystemExit) as error:
            raise BadFrame(
                f"{self.frame_call.name}, or what the runner makes of it, "
                f"raised {type(error).__name__}: {error}"
            ) from error
        message = message_of_observation(
            window, made_of, self._cameras, "update_observation_window()"
        )
        if made_of is None:
            self._keep_state(window.get("qpos"), None)
        else:
            self._keep_state(made_of.state, made_of.stamps.get(STATE))
        return message

    def _keep_state(self, found: Any, stamp: float | None) -> None:
        """Keep a valid state for the tracking check; the main process reports an invalid one."""
        try:
            state = as_state(found, self.embodiment, self.frame_call.name)
        except FluxError:
            return
        timed = stamp is not None and is_number(stamp) and math.isfinite(stamp)
        self._states.append(StateSample(state, stamp if timed and stamp else self.clock.now()))

    def _too_large(self, message: FrameMessage) -> FluxError:
        try:
            check_frame(frame_of(message), self.embodiment, self._cameras)
        except BadFrame as error:
            return error
        size = sum(array.nbytes for array in message.arrays.values())
        return BadFrame(f"{self.frame_call.name} gave {size} bytes, more than its embodiment says")
