"""``EpisodeRecorder``: writes what happens in an episode to files, and counts its summary."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fluxvla_core.contracts.frame import STATE
from fluxvla_core.contracts.policy import Policy
from fluxvla_core.contracts.runner import Reporter
from fluxvla_core.errors import RunFailed
from fluxvla_core.robot.events import (
    ChunkAccepted,
    CommandSent,
    EpisodeEnded,
    EpisodeObserver,
    EpisodePrepared,
    Event,
    FilterSkipped,
    HistoryObserved,
    Observed,
    ObservedFrame,
    Refused,
    Stopped,
    StoppedWhileHeld,
)
from fluxvla_core.robot.recording import episode_log
from fluxvla_core.robot.recording.logged import logged, milliseconds
from fluxvla_core.robot.recording.trace import EpisodeTrace, Recording
from fluxvla_core.robot.robot import Robot
from fluxvla_core.ros2 import RobotFrame, depth_stream


@dataclass(eq=False)
class EpisodeRecorder(EpisodeObserver):
    """Writes events, images and videos of an episode into a folder.

    Args:
        folder: where the record goes; opened with ``EpisodePrepared``, finished with
            ``EpisodeEnded``.
        robot, policy: those that act in the episode.
        cameras: names of those that the policy looks at.
        video_fps: frames a second of the videos; None records none.
        everything: record images too, in a bag; otherwise lines of JSON.
        reporter: learns what was not recorded, and where the record is.

    ``summary`` is what ``episode.json`` holds, once the episode has ended.
    """

    folder: Path
    robot: Robot
    policy: Policy
    cameras: tuple[str, ...]
    video_fps: float | None
    everything: bool
    reporter: Reporter

    def __post_init__(self) -> None:
        self.summary: dict[str, Any] = {}
        self._counted = episode_log.EpisodeSummary()
        self._commands = 0
        self._rate_hz = 0.0
        self._images: dict[str, Any] = {}
        self._trace: EpisodeTrace

    def on_event(self, event: Event) -> None:
        match event:
            case EpisodePrepared():
                self._open(event)
            case Observed():
                self._images = dict(event.observed.observation["images"])
                self._observed(event.at, event.observed)
            case HistoryObserved():
                self._observed(event.at, event.observed)
            case Refused():
                self._write(
                    episode_log.REFUSED, event.at, what=event.what, given=_shown(event.values)
                )
            case ChunkAccepted():
                self._write(
                    episode_log.CHUNK,
                    event.at,
                    observed=event.observed.at,
                    rate_hz=self.policy.action_rate_hz,
                    keyframes=event.actions,
                    ms=milliseconds(event.stages),
                )
            case CommandSent():
                self._commands += 1
                self._keep(logged(event))
                self._film()
            case FilterSkipped() | Stopped():
                self._keep(logged(event))
            case EpisodeEnded():
                self._finish(event)
            case StoppedWhileHeld():
                self._note_stop(event)

    def _open(self, event: EpisodePrepared) -> None:
        """Open the files.

        Raises:
            RunFailed: the folder cannot be written to.
        """
        robot, policy = self.robot, self.policy
        spec = robot.embodiment
        self._rate_hz = event.rate_hz
        source = robot.images_after
        names = {"state": spec.state_names, "action": spec.joint_names}
        recording = Recording(names, spec.camera_names, source) if self.everything else None
        self._trace = EpisodeTrace(self.folder, self.video_fps, recording)
        self._write(
            episode_log.START,
            event.at,
            format=episode_log.FORMAT,
            task=event.task.name,
            instruction=event.task.instruction,
            seed=event.seed,
            robot=robot.name,
            embodiment=spec.to_dict(),
            rate_hz=event.rate_hz,
            policy=type(policy).__name__,
            policy_source=str(policy.source),
            action_rate_hz=policy.action_rate_hz,
            horizon=policy.horizon,
            lockstep=robot.lockstep,
            native=source is not None,
            began=time.time(),
        )

    def _observed(self, now: float, observed: ObservedFrame) -> None:
        frame, images = observed.frame, observed.observation["images"]
        seen = images if frame is None else frame.images
        stamps = dict(frame.stamps) if frame is not None else dict.fromkeys((STATE, *images), now)
        for camera, image in seen.items():
            self._trace.image(camera, stamps.get(camera, now), image)
        base = self._beside(frame, stamps) if isinstance(frame, RobotFrame) else {}
        self._write(
            episode_log.OBSERVATION,
            now,
            state=observed.state,
            stamps=stamps,
            **base,
            ms=milliseconds(observed.seconds),
        )

    def _finish(self, event: EpisodeEnded) -> None:
        """Finish the files, and say what was not recorded.

        Raises:
            RunFailed: something could not be written, of an episode that ended well.
        """
        self._keep(logged(event))
        self.summary = self._counted.to_dict()
        try:
            self.summary = self._trace.close(self.summary)
            lost = [f"{count} {kind}" for kind, count in self._trace.dropped.items() if count]
            if lost:
                self.reporter.warn(
                    f"{' and '.join(lost)} were not recorded: "
                    "the disk or the processor did not keep up"
                )
        except RunFailed as error:
            if event.problem is None:
                raise
            # A lost record must not hide why an episode ended.
            self.reporter.warn(str(error))
        self.reporter.artifact("episode", self.folder)

    def _note_stop(self, event: StoppedWhileHeld) -> None:
        place = self.folder / episode_log.HELD
        fields = {"time": time.time(), **asdict(event.trip), "failure": event.failure}
        try:
            with place.open("a", encoding="utf-8") as file:
                file.write(json.dumps(fields) + "\n")
        except OSError as error:
            problem = RunFailed(f"a trip could not be recorded: {error}", where=str(place))
            self.reporter.warn(str(problem))

    def _write(self, kind: str, at: float, **fields: Any) -> None:
        self._keep({"event": kind, "t": at, **fields})

    def _keep(self, event: Mapping[str, Any]) -> None:
        self._counted.add(event)
        self._trace.write(event)

    def _beside(self, frame: RobotFrame, stamps: Mapping[str, float]) -> dict[str, Any]:
        """Record what a frame has besides state and images; what of it belongs into an event."""
        for camera, metres in frame.depths.items():
            stamp = stamps.get(depth_stream(camera), stamps[STATE])
            self._trace.depth(camera, stamp, metres)
        return {} if frame.base is None else {"base": frame.base}

    def _film(self) -> None:
        """A frame for each video: fresh from a simulation, else the last one that was seen."""
        robot, fps = self.robot, self.video_fps
        if fps is None or self._commands % max(1, round(self._rate_hz / fps)):
            return
        images: Mapping[str, Any] = self._images
        if robot.lockstep and robot.complete:
            with robot.delays.of(robot.frame_call):
                frame = robot.frame()
            images = frame.images
            for camera, image in images.items():
                self._trace.image(camera, frame.stamps[camera], image)
        shown = self.cameras or images
        self._trace.frames({name: images[name] for name in shown if name in images})


def _shown(value: Any) -> Any:
    """``value`` as JSON that shows what is wrong with it."""
    if isinstance(value, Mapping):
        return {str(key): _shown(inner) for key, inner in value.items()}
    if isinstance(value, np.ndarray) and (value.dtype.kind not in "fiu" or value.ndim > 2):
        return f"{value.shape} {value.dtype}"
    if isinstance(value, np.ndarray) and value.ndim == 0:
        return _shown(value.item())
    if isinstance(value, (np.ndarray, list, tuple)):
        return [_shown(inner) for inner in value]
    if isinstance(value, (float, np.floating)) and not np.isfinite(value):
        return str(value)
    if isinstance(value, np.generic):
        return value.item()
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    return repr(value)[:500]
