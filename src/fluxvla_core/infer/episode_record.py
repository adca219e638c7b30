"""What is counted and written while an episode runs, and the summary at its end."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.frame import STATE, Frame
from fluxvla_core.control.path import Sent
from fluxvla_core.control.rate import Rate
from fluxvla_core.infer.plan import Plan
from fluxvla_core.infer.tasks import Task
from fluxvla_core.record import tally
from fluxvla_core.record.trace import EpisodeTrace, Recording
from fluxvla_core.ros2.frames import RobotFrame
from fluxvla_core.ros2.streams import depth_stream

Array = npt.NDArray[np.float64]


class EpisodeRecord:
    """Events, pictures and videos of an episode, and what they add up to.

    Args:
        plan: of the episode.
        task, seed: of the episode.
        folder: where the record goes; ``close`` finishes it.
        rate: of the episode's commands.

    Raises:
        RunFailed: the folder cannot be written to.
    """

    def __init__(self, plan: Plan, task: Task, seed: int, folder: Path, rate: Rate) -> None:
        self._plan = plan
        self._rate = rate
        self._trips = len(plan.latch.trips)
        self._tally = tally.Tally()
        self._beats = 0
        self._images: dict[str, Any] = {}
        self._state: Array | None = None
        self.steps = 0
        spec = plan.robot.embodiment
        source = getattr(plan.robot.operator, "pictures_after", None)
        names = {"state": spec.state_names, "action": spec.joint_names}
        recording = Recording(names, spec.camera_names, source) if plan.record else None
        self._trace = EpisodeTrace(folder, plan.video_fps, recording)
        self.event(
            tally.START,
            format=tally.FORMAT,
            task=task.name,
            instruction=task.instruction,
            seed=seed,
            robot=plan.robot.name,
            embodiment=spec.to_dict(),
            rate_hz=plan.rate_hz,
            policy=type(plan.policy).__name__,
            policy_source=str(getattr(plan.policy, "source", "")),
            action_rate_hz=plan.policy.action_rate_hz,
            horizon=plan.policy.horizon,
            lockstep=plan.robot.lockstep,
            native=source is not None,
            began=time.time(),
        )

    def seen(
        self,
        state: Array,
        images: Mapping[str, Any],
        frame: Frame | None,
        seconds: Mapping[str, float],
    ) -> None:
        """A reading that was looked at.

        Args:
            state: ``(state_dim,)``.
            images: camera -> picture, those of the policy.
            frame: what they are of, where the operator has frames.
            seconds: by stage.
        """
        now = self._plan.robot.clock.now()
        self._state, self._images = state, dict(images)
        pictures = images if frame is None else frame.images
        stamps = dict(frame.stamps) if frame is not None else dict.fromkeys((STATE, *images), now)
        for camera, image in pictures.items():
            self._trace.picture(camera, stamps.get(camera, now), image)
        base = self._beside(frame, stamps) if isinstance(frame, RobotFrame) else {}
        self.event(tally.OBSERVATION, state=state, stamps=stamps, **base, ms=_milliseconds(seconds))

    def refused(self, what: str, **values: Any) -> None:
        """Something was not let through; ``values`` may be anything."""
        self.event(tally.REFUSED, what=what, given=_shown(values))

    def chunk(self, keyframes: Array, observed: float, seconds: Mapping[str, float]) -> None:
        """A chunk was admitted; ``seconds`` by stage."""
        self.event(
            tally.CHUNK,
            observed=observed,
            rate_hz=self._plan.policy.action_rate_hz,
            keyframes=keyframes,
            ms=_milliseconds(seconds),
        )

    def command(self, sent: Sent, phase: str, state: Array | None) -> None:
        """A command was sent in ``phase``; ``state`` if it was read at this beat."""
        self._beats += 1
        seconds = {"send": self._plan.robot.sent_s, "late": self._rate.late_s}
        self.event(
            tally.COMMAND,
            phase=phase,
            wanted=sent.target,
            command=sent.command,
            state=state,
            clamps=[asdict(clamp) for clamp in sent.clamps],
            **({"held": True} if sent.held else {}),
            ms=_milliseconds({k: v for k, v in seconds.items() if v is not None}),
        )
        self._film()

    def event(self, kind: str, **fields: Any) -> None:
        """One event, stamped on the operator's clock."""
        event = {"event": kind, "t": self._plan.robot.clock.now(), **fields}
        self._tally.add(event)
        self._trace.write(event)

    def close(self, outcome: str, success: bool | None, problem: str | None) -> dict[str, Any]:
        """Finish the files, and say what was not recorded; what ``episode.json`` holds.

        Raises:
            RunFailed: something could not be written.
        """
        trips = [asdict(trip) for trip in self._plan.latch.trips[self._trips :]]
        self.event(
            tally.END,
            outcome=outcome,
            success=success,
            problem=problem,
            skipped_beats=self._rate.skipped,
            trips=trips,
        )
        summary = self._trace.close(self._tally.summary())
        lost = [f"{count} {what}" for what, count in self._trace.dropped.items() if count]
        if lost:
            self._plan.context.reporter.warn(
                f"{' and '.join(lost)} were not recorded: the disk or the processor did not keep up"
            )
        return summary

    def _beside(self, frame: RobotFrame, stamps: Mapping[str, float]) -> dict[str, Any]:
        """Record what a frame has besides state and pictures; what of it belongs into an event."""
        for camera, metres in frame.depths.items():
            stamp = stamps.get(depth_stream(camera), stamps[STATE])
            self._trace.depth(camera, stamp, metres)
        return {} if frame.base is None else {"base": frame.base}

    def _film(self) -> None:
        """A frame for each video: fresh from a simulation, else the last one that was seen."""
        plan, robot = self._plan, self._plan.robot
        if plan.video_fps is None or self._beats % max(1, round(plan.rate_hz / plan.video_fps)):
            return
        images = self._images
        if robot.lockstep and robot.complete:
            frame = robot.operator.get_frame()
            images = frame.images
            for camera, image in images.items():
                self._trace.picture(camera, frame.stamps[camera], image)
        shown = plan.cameras or images
        self._trace.frames({name: images[name] for name in shown if name in images})


def _shown(value: Any) -> Any:
    """``value`` as JSON that shows what is wrong with it."""
    if isinstance(value, Mapping):
        return {str(key): _shown(inner) for key, inner in value.items()}
    if isinstance(value, np.ndarray) and (value.dtype.kind not in "fiu" or value.ndim > 2):
        return f"{value.shape} {value.dtype}"
    if isinstance(value, (np.ndarray, list, tuple)):
        return [_shown(inner) for inner in value]
    if isinstance(value, (float, np.floating)) and not np.isfinite(value):
        return str(value)
    if isinstance(value, np.generic):
        return value.item()
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    return repr(value)[:500]


def _milliseconds(seconds: Mapping[str, float]) -> dict[str, float]:
    return {stage: round(value * 1e3, 3) for stage, value in seconds.items()}
