"""A robot and a policy in memory, which the kit of inference runners drives and is driven by."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.frame import STATE, Frame, Observation
from fluxvla_core.contracts.policy import Policy
from fluxvla_core.contracts.robot import Operator
from fluxvla_core.control.clock import SimulatedClock
from fluxvla_core.errors import NotReady
from fluxvla_core.spec import Camera, EmbodimentSpec, Joint

Array = npt.NDArray[np.float64]
Fault = Callable[[], object]

SPEC = EmbodimentSpec(
    "stand-in",
    (
        Joint("shoulder", "rad", -1.0, 1.5, 2.0, 10.0),
        Joint("elbow", "rad", -2.0, 2.0, 3.0, 20.0),
        Joint("jaw", "normalized", 0.0, 1.0, 2.0, 30.0, kind="gripper", open=1.0, closed=0.0),
    ),
    (Camera("front", 24, 32), Camera("wrist", 16, 20)),
    50.0,
)
CONNECT, COMMAND, STOP, CLOSE = "connect", "command", "stop", "close"
"""Entries of ``StandInRobot.events``."""


def within(spec: EmbodimentSpec, share: float) -> Array:
    """``(dim,)``: each joint at this share of its range; a base at rest."""
    rows = [0.0 if j.by_speed else j.lower + share * (j.upper - j.lower) for j in spec.joints]
    return np.array(rows)


def near(spec: EmbodimentSpec, place: Array, seconds: float) -> Array:
    """``(dim,)``: each joint so far up from ``place`` as it goes in this time, and within limits.

    A base stays at rest.
    """
    ways = [
        0.0 if joint.by_speed else min(seconds * joint.velocity, (joint.upper - at) / 2.0)
        for joint, at in zip(spec.joints, place, strict=True)
    ]
    goal: Array = place + np.array(ways)
    return goal


class StandInRobot(Operator):
    """A robot in memory that follows each command at once, in simulated time, and logs its calls.

    A stand-in for an operator of another shape is a subclass whose own methods call ``receive``.

    Args:
        spec: its embodiment.

    Attributes:
        state: ``(dim,)`` where it is.
        sent: the ``(dim,)`` commands.
        events: the calls, in order: ``connect``, ``command``, ``stop``, ``close``.
        on_frame, on_command: called before a reading and before a command; may raise.
    """

    api: ClassVar[str] = "1.0"

    def __init__(self, spec: EmbodimentSpec = SPEC) -> None:
        self._spec, self._clock = spec, SimulatedClock()
        self.start = within(spec, 0.45)
        self.state = self.start.copy()
        self.sent: list[Array] = []
        self.events: list[str] = []
        self.on_frame: Fault = int
        self.on_command: Fault = int
        self._open = False

    @property
    def embodiment(self) -> EmbodimentSpec:
        return self._spec

    @property
    def clock(self) -> SimulatedClock:
        return self._clock

    def image(self, camera: Camera) -> npt.NDArray[np.uint8]:
        """``(height, width, 3)`` uint8: another shade for each camera, and after each command."""
        number = self._spec.camera_names.index(camera.name)
        shade = (40 + 90 * number + len(self.sent)) % 256
        return np.full((camera.height, camera.width, 3), shade, np.uint8)

    def picture(self, camera: Camera) -> npt.NDArray[np.uint8]:
        """Deprecated name of :meth:`image`."""
        message = "StandInRobot.picture is deprecated, use image"
        warnings.warn(message, DeprecationWarning, stacklevel=2)
        return self.image(camera)

    def receive(self, action: Array) -> None:
        """Take a ``(dim,)`` command without checking it; the kit does."""
        self.on_command()
        self.events.append(COMMAND)
        self.sent.append(np.array(action, dtype=np.float64))
        if self.sent[-1].shape == self.state.shape and np.isfinite(self.sent[-1]).all():
            self.state = self.sent[-1].copy()
        self._clock.advance(1.0 / self._spec.rate_hz)

    def connect(self) -> None:
        self.events.append(CONNECT)
        self._open = True

    def get_frame(self) -> Frame:
        if not self._open:
            raise NotReady("the stand-in is not connected")
        self.on_frame()
        images = {camera.name: self.image(camera) for camera in self._spec.cameras}
        return Frame(self.state.copy(), images, dict.fromkeys((STATE, *images), self._clock.now()))

    def send_action(self, action: Array) -> None:
        if not self._open:
            raise NotReady("the stand-in is not connected")
        self.receive(action)

    def stop(self) -> None:
        self.events.append(STOP)

    def close(self) -> None:
        self.events.append(CLOSE)
        self._open = False


class StandInPolicy(Policy):
    """Goes to ``goal``.

    Args:
        spec: the robot's.
        goal: ``(dim,)``, may be beyond the limits.
        pace: how fast each joint goes, as a share of its limit; may be more than 1.
        noise: of its actions, from the seed of the episode, as a share of an action's way at full
            speed.

    Attributes:
        asked: the observations.
        seeds: of the episodes.
        fault: called at its third question, and gives what takes the place of the answer if it
            returns an array.
    """

    api: ClassVar[str] = "1.0"

    def __init__(
        self, spec: EmbodimentSpec, goal: Array, pace: float = 0.5, noise: float = 0.0
    ) -> None:
        self._spec, self.goal, self.pace, self.noise = spec, goal, pace, noise
        self.asked: list[Observation] = []
        self.seeds: list[int] = []
        self.fault: Callable[[Array], Array | None] | None = None
        self._way = np.array([joint.slew_rate for joint in spec.joints]) / self.action_rate_hz
        self._rng = np.random.default_rng(0)

    @property
    def embodiment(self) -> EmbodimentSpec:
        return self._spec

    @property
    def action_rate_hz(self) -> float:
        return 10.0

    @property
    def horizon(self) -> int:
        return 5

    def reset(self, seed: int) -> None:
        self.seeds.append(seed)
        self._rng = np.random.default_rng(seed)

    def predict_action(self, observation: Observation) -> Array:
        self.asked.append(observation)
        place = np.asarray(observation["qpos"], dtype=np.float64)
        far = np.abs(self.goal - place)
        steps = np.arange(1, self.horizon + 1)[:, None] * self.pace * self._way
        chunk: Array = place + np.sign(self.goal - place) * np.minimum(steps, far)
        chunk = chunk + self.noise * self._way * self._rng.uniform(-1.0, 1.0, chunk.shape)
        if self.fault is not None and len(self.asked) == 3:
            other = self.fault(chunk)
            return chunk if other is None else other
        return chunk
