"""What is counted and written while an episode runs, and the summary at its end."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.control.path import Sent
from fluxvla_core.control.rate import Rate
from fluxvla_core.infer.plan import Plan
from fluxvla_core.infer.tasks import Task
from fluxvla_core.record.timings import Timings
from fluxvla_core.record.trace import EpisodeTrace
from fluxvla_core.safety.limits import count_clamps

Array = npt.NDArray[np.float64]


class EpisodeRecord:
    """Lines of the trace, frames of the videos, counts and timings.

    Args:
        plan: of the episode.
        trace: open; ``close`` finishes it.
        rate: of the episode's commands.
    """

    def __init__(self, plan: Plan, trace: EpisodeTrace, rate: Rate) -> None:
        self._plan = plan
        self._trace = trace
        self._rate = rate
        self._trips = len(plan.latch.trips)
        self._beats = 0
        self._clamps: dict[str, dict[str, int]] = {}
        self._images: dict[str, Any] = {}
        self._state: Array | None = None
        self.timings = Timings()
        self.chunks = 0
        self.steps = 0

    def seen(self, state: Array, images: dict[str, Any]) -> None:
        """The newest observation: what lines and videos show where nothing newer is known."""
        self._state, self._images = state, dict(images)

    def chunk(self, keyframes: Array, observed: float, seconds: dict[str, float]) -> None:
        """A chunk was admitted; ``seconds`` by stage."""
        self.chunks += 1
        for stage, value in seconds.items():
            self.timings.add(stage, value)
        self.event(
            "chunk",
            observed=observed,
            keyframes=keyframes,
            ms={stage: round(value * 1e3, 3) for stage, value in seconds.items()},
        )

    def command(self, sent: Sent, phase: str, state: Array | None) -> None:
        """A command was sent in ``phase``; ``state`` if it was read at this beat."""
        self._beats += 1
        sent_s, late_s = self._plan.robot.sent_s, self._rate.late_s
        self.timings.add("late", late_s)
        if sent_s is not None:
            self.timings.add("send", sent_s)
        for joint, reasons in count_clamps([sent.clamps]).items():
            counts = self._clamps.setdefault(joint, {})
            for reason, count in reasons.items():
                counts[reason] = counts.get(reason, 0) + count
        self.event(
            "command",
            phase=phase,
            wanted=sent.target,
            command=sent.command,
            state=self._state if state is None else state,
            clamps=[asdict(clamp) for clamp in sent.clamps],
            late_ms=round(late_s * 1e3, 3),
            send_ms=None if sent_s is None else round(sent_s * 1e3, 3),
        )
        self._film()

    def event(self, kind: str, **fields: Any) -> None:
        """One line of the trace, stamped on the operator's clock."""
        self._trace.write({"event": kind, "t": self._plan.robot.clock.now(), **fields})

    def close(
        self, task: Task, seed: int, outcome: str, success: bool | None, problem: str | None
    ) -> dict[str, Any]:
        """Finish the files; the summary that ``episode.json`` holds.

        Raises:
            RunFailed: something could not be written.
        """
        robot = self._plan.robot
        summary: dict[str, Any] = {
            "format": "fluxvla-episode-1",
            "task": task.name,
            "instruction": task.instruction,
            "outcome": outcome,
            "success": success,
            "problem": problem,
            "steps": self.steps,
            "chunks": self.chunks,
            "seed": seed,
            "robot": robot.name,
            "embodiment": robot.embodiment.name,
            "joints": list(robot.embodiment.joint_names),
            "rate_hz": self._plan.rate_hz,
            "skipped_beats": self._rate.skipped,
            "clamps": self._clamps,
            "trips": [asdict(trip) for trip in self._plan.latch.trips[self._trips :]],
            "timings": self.timings.summary(),
        }
        self._trace.close(summary)
        return summary

    def _film(self) -> None:
        """A frame for each video: fresh from a simulation, else the last one that was seen."""
        fps, robot = self._plan.video_fps, self._plan.robot
        if fps is None or self._beats % max(1, round(self._plan.rate_hz / fps)):
            return
        images = self._images
        if robot.lockstep and robot.complete:
            images = robot.operator.get_frame().images
        self._trace.frames({name: images[name] for name in self._plan.cameras if name in images})
