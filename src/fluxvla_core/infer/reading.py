"""Readings of a robot for its policy: complete, fresh, and what the embodiment describes."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from concurrent.futures import wait
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.frame import STATE, Frame
from fluxvla_core.errors import NotReady
from fluxvla_core.infer.episode_record import EpisodeRecord
from fluxvla_core.infer.plan import Plan
from fluxvla_core.safety.gates import FreshnessGate, check_frame
from fluxvla_core.safety.stops import BadFrame, BadTiming

_LOOK_S = 0.5  # that a reading may take


@dataclass(frozen=True)
class Reading:
    """What was seen at one moment, on the robot's clock.

    Args:
        window: the observation, as the operator gave it.
        frame: what it is of, where the operator has frames.
        state: ``(state_dim,)``.
        measured: when the state came.
        at: when the oldest of its streams came.
        seconds: what it took, by stage.
    """

    window: dict[str, Any]
    frame: Frame | None
    state: npt.NDArray[np.float64]
    measured: float
    at: float
    seconds: Mapping[str, float]


class Reader:
    """Reads in an episode; what it does not let through is in ``record``."""

    def __init__(self, plan: Plan, record: EpisodeRecord) -> None:
        self._plan, self._record = plan, record
        self._gate = FreshnessGate(plan.settings.max_age_s, plan.settings.max_skew_s)

    def first(self) -> Reading:
        """The first one, for which the robot has ``ready_s``.

        Raises:
            NotReady: it gave none that is complete and fresh.
            BadFrame: it is not what the embodiment describes.
            Interrupted: a signal came meanwhile.
        """
        until = time.monotonic() + self._plan.ready_s
        while True:
            self._plan.interrupts.check()
            try:
                return self._checked(*self._look(until), {})
            except (NotReady, BadTiming) as error:
                if time.monotonic() > until:
                    raise NotReady(
                        f"the robot gave no complete reading within {self._plan.ready_s:g} s: "
                        f"{error.what}",
                        cause=error.cause,
                        next=error.next,
                    ) from error
                time.sleep(0.02)

    def read(self) -> Reading:
        """One more; in the thread that asks the policy.

        Raises:
            BadFrame: it is not what the embodiment describes, or a stream is gone.
            BadTiming: it is too old, its streams are too far apart, or one ran backwards.
        """
        began = time.perf_counter()
        window, frame = self._plan.look()
        seconds = {"sync": time.perf_counter() - began}
        try:
            return self._checked(window, frame, seconds)
        except NotReady as error:
            raise BadFrame(error.what, cause="a stream that was there is gone") from error

    def _look(self, until: float) -> tuple[dict[str, Any], Frame | None]:
        """A look in the thread that all are made in: cameras may be bound to one."""
        plan = self._plan
        if plan.robot.lockstep:
            return plan.look()
        # One that is begun shortly before the end is given its time, too.
        until = max(until, time.monotonic() + _LOOK_S)
        future = plan.worker.submit(plan.look)
        while not future.done() and time.monotonic() < until:
            plan.interrupts.check()
            wait((future,), timeout=0.02)
        if not future.done():
            raise NotReady(f"{plan.robot.name}.get_frame does not return")
        return future.result()

    def _checked(
        self, window: dict[str, Any], frame: Frame | None, seconds: dict[str, float]
    ) -> Reading:
        plan = self._plan
        _check_complete(window, plan.cameras)
        measured = at = now = plan.robot.clock.now()
        state, stamps = window["qpos"], dict[str, float]()
        if frame is not None:
            age = max(self._gate.check(frame.stamps, plan.cameras, now), 0.0)
            state, stamps = frame.state, dict(frame.stamps)
            measured, at = stamps[STATE], now - age
            seconds = {"receipt": age, **seconds}
        state = np.asarray(state, dtype=np.float64)
        reading = Frame(state=state, images=window["images"], stamps=stamps)
        try:
            check_frame(reading, plan.robot.embodiment, plan.cameras)
        except BadFrame:
            self._record.refused("reading", state=state, images=window["images"])
            raise
        return Reading(window, frame, state, measured, at, seconds)


def _check_complete(window: dict[str, Any], cameras: Sequence[str]) -> None:
    """A stream that has not come yet is None in an operator of the specification's shape."""
    if window.get("qpos") is None:
        raise NotReady("there are no joint states yet")
    missing = [name for name in cameras if window["images"].get(name) is None]
    if missing:
        raise NotReady(f"there is no picture of {', '.join(missing)} yet")
