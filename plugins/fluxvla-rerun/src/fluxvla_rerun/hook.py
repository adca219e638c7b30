"""``RerunViewer``: a hook that logs a run's data to a Rerun recording."""

from __future__ import annotations

import socket
import time
import uuid
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import numpy.typing as npt
import rerun

from fluxvla_core import EmbodimentSpec, Hook, RunContext
from fluxvla_core.errors import ConfigError

Array = npt.NDArray[np.float64]

ROBOT, STEP = "robot", "step"
"""Timelines: seconds on the robot's clock, and optimizer steps."""
_HERE = "rerun+http://127.0.0.1:9876/proxy"
_PORT = 9876
_TRY_S = 2.0  # for one connection
_START_S = 4.0  # for a viewer that is started
_URLS = ("rerun://", "rerun+http://", "rerun+https://")


class RerunViewer(Hook):
    """Shows a run in the Rerun viewer, live, and keeps it as a file.

    On a robot: cameras, each joint's measured position, target and command, the policy's chunks
    with their latency, and an event log with tasks and safe stops. In training: the metrics.

    Args:
        file: the recording, in the work dir; an existing one is kept, and a number is added to the
            name. None writes none.
        viewer: ``spawn`` starts a viewer on this machine; ``rerun+http://HOST:9876/proxy`` sends to
            one that runs elsewhere; None shows nothing.
        jpeg_quality: 1 to 100, of images in the recording; None keeps every bit of them.
        budget_s: seconds that it may be behind the run before it is left out.

    Raises:
        ConfigError: nothing is asked for, or a value is not one of these.
    """

    api = "1.0"
    budget_s = 10.0

    def __init__(
        self,
        file: str | None = "run.rrd",
        viewer: str | None = None,
        jpeg_quality: int | None = 75,
        budget_s: float = 10.0,
    ) -> None:
        if file is None and viewer is None:
            raise ConfigError("RerunViewer: with neither file nor viewer it shows nothing")
        if file is not None and (Path(file).is_absolute() or ".." in Path(file).parts):
            raise ConfigError(f"RerunViewer: file lies in the work dir, got {file!r}")
        if viewer not in (None, "spawn") and not str(viewer).startswith(_URLS):
            raise ConfigError(
                f"RerunViewer: viewer is 'spawn' or a URL like rerun+http://HOST:9876/proxy, "
                f"got {viewer!r}"
            )
        if jpeg_quality is not None and not 1 <= jpeg_quality <= 100:
            raise ConfigError(f"RerunViewer: jpeg_quality is 1 to 100, got {jpeg_quality}")
        self.file, self.viewer, self.jpeg_quality = file, viewer, jpeg_quality
        self.budget_s = budget_s
        self.path: Path | None = None
        self._joints: Sequence[str] = ()
        # One for the file and one for the viewer: a viewer that does not answer keeps no file back.
        self._file: rerun.RecordingStream | None = None
        self._live: rerun.RecordingStream | None = None

    def run_started(self, context: RunContext, embodiment: EmbodimentSpec | None) -> None:
        self._joints = () if embodiment is None else [joint.name for joint in embodiment.joints]
        identity = uuid.uuid4()
        if self.file is not None:
            self.path = _free(Path(context.work_dir) / self.file)
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = rerun.RecordingStream("fluxvla", recording_id=identity)
            self._file.save(self.path)
        if self.viewer is not None:
            self._connect(self.viewer, identity, context)
        self._event(f"run of {context.config_file or 'a config'}, section {context.section!r}")

    def _connect(self, viewer: str, identity: uuid.UUID, context: RunContext) -> None:
        """Send to a viewer, if one answers: Rerun itself waits long, and says nothing."""
        url, patience_s = viewer, 0.0
        if viewer == "spawn":
            url, patience_s = _HERE, _START_S
            rerun.spawn(connect=False)
        if not _answers(url, patience_s):
            rest = f"this run is in {self.path} alone" if self.path else "this run is not shown"
            context.reporter.warn(f"RerunViewer: no viewer answers at {url}; {rest}")
            return
        self._live = rerun.RecordingStream("fluxvla", recording_id=identity)
        self._live.connect_grpc(url)

    def after_step(self, step: int, metrics: Mapping[str, float]) -> None:
        self._time(STEP, sequence=step)
        for name, value in metrics.items():
            if isinstance(value, (int, float)):
                self._log(f"training/{_part(name)}", rerun.Scalars(float(value)))

    def checkpoint_saved(self, path: Path, step: int) -> None:
        self._time(STEP, sequence=step)
        self._event(f"saved {path.name}")

    def episode_started(self, task: str, stamp: float) -> None:
        self._time(ROBOT, duration=stamp)
        self._event(f"episode: {task}")

    def observed(self, observation: Mapping[str, Any], stamp: float) -> None:
        self._time(ROBOT, duration=stamp)
        for name, image in observation["images"].items():
            if image is not None:  # nothing has come of that camera yet
                shown = rerun.Image(np.asarray(image))
                if self.jpeg_quality is not None:
                    shown = shown.compress(jpeg_quality=self.jpeg_quality)
                self._log(f"cameras/{_part(name)}", shown)
        self._positions("measured", observation["qpos"])

    def inferred(self, chunk: Array, latency_s: float, stamp: float) -> None:
        self._time(ROBOT, duration=stamp)
        self._log("policy/chunk", rerun.Tensor(chunk, dim_names=("keyframe", "joint")))
        self._log("policy/latency_s", rerun.Scalars(latency_s))

    def action_sent(self, action: Array, stamp: float, target: Array, state: Array | None) -> None:
        self._time(ROBOT, duration=stamp)
        self._positions("command", action)
        self._positions("target", target)
        if state is not None:
            self._positions("measured", state)

    def stopped(self, rule: str, problem: str, stamp: float) -> None:
        self._time(ROBOT, duration=stamp)
        self._event(f"stopped ({rule}): {problem}", "WARN")

    def episode_finished(self, reason: str, stamp: float) -> None:
        self._time(ROBOT, duration=stamp)
        self._event(f"episode over: {reason}")

    def run_finished(self, outcome: str) -> None:
        self._event(f"run: {outcome}", "INFO" if outcome == "ok" else "WARN")
        if self._file is not None:
            self._file.flush()
            self._file.disconnect()
            self._file = None
        if self._live is not None:
            # Raises if the viewer has gone, which is reported; to disconnect would take seconds.
            self._live.flush(timeout_sec=self.budget_s / 2)
            self._live.disconnect()
            self._live = None

    def _streams(self) -> list[rerun.RecordingStream]:
        return [stream for stream in (self._file, self._live) if stream is not None]

    def _time(self, timeline: str, **when: float) -> None:
        for stream in self._streams():
            stream.set_time(timeline, **when)

    def _log(self, entity: str, value: Any) -> None:
        for stream in self._streams():
            stream.log(entity, value)

    def _positions(self, what: str, values: npt.ArrayLike) -> None:
        """One curve for each joint; those of one joint are shown together."""
        flat = np.asarray(values, dtype=np.float64).ravel()
        named = self._joints if len(self._joints) == len(flat) else range(len(flat))
        for name, value in zip(named, flat, strict=True):
            self._log(f"joints/{_part(name)}/{what}", rerun.Scalars(float(value)))

    def _event(self, text: str, level: str = "INFO") -> None:
        self._log("events", rerun.TextLog(text, level=level))


def _answers(url: str, patience_s: float) -> bool:
    """Whether something listens at a viewer's URL, or begins to within ``patience_s``."""
    parts = urlsplit(url)
    until = time.monotonic() + patience_s
    while True:
        try:
            with socket.create_connection((parts.hostname, parts.port or _PORT), _TRY_S):
                return True
        except OSError:
            if time.monotonic() >= until:
                return False
            time.sleep(0.1)


def _free(path: Path) -> Path:
    """``path``, or with ``-2``, ``-3``, … in its name: nothing is overwritten."""
    number, found = 2, path
    while found.exists():
        found = path.with_name(f"{path.stem}-{number}{path.suffix}")
        number += 1
    return found


def _part(name: object) -> str:
    """A name as one part of an entity's path."""
    return str(name).replace("/", "_")
