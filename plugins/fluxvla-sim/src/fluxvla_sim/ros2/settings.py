"""Settings of a simulated robot, and the streams and faults that its command line names."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from fluxvla_core.errors import ConfigError, UsageError
from fluxvla_core.ros2 import FLOAT64, ODOMETRY, Fault, depth_stream
from fluxvla_sim.ros2.drivers import Driver
from fluxvla_sim.world import CONTROL_HZ, SUBSTEPS

# The product of two rates may be rounded to just below an integer: without this tolerance
# ``floor`` would then lose a state.
_ROUNDING = 1e-9


@dataclass(frozen=True)
class NodeSettings:
    """Settings of a simulated robot on ROS 2.

    Args:
        name: of the robot; ``sim_`` before it names the node.
        seed: of the first scene.
        real_time_factor: simulated seconds in a second.
        state_hz: states a simulated second, of every stream of them. Above ``CONTROL_HZ`` the
            physics goes in smaller parts of a control period, down to its own 2 ms.
        camera_hz: images a simulated second of each camera, if the machine can; a camera that
            nobody listens to is not drawn.
        latencies: stream -> simulated seconds that its messages are under way, with true stamps.
        height, width: of every image, in pixels.
        best_effort: offer images as camera drivers do by default, not reliably.
        faults: (seconds after the start, stream, fault), faults that begin by themselves.
        domain_id: the ROS domain; None takes ``ROS_DOMAIN_ID``.
    """

    name: str
    seed: int = 0
    real_time_factor: float = 1.0
    state_hz: float = CONTROL_HZ
    camera_hz: float = 30.0
    latencies: Mapping[str, float] = field(default_factory=dict)
    height: int = 480
    width: int = 640
    best_effort: bool = False
    faults: Sequence[tuple[float, str, Fault]] = ()
    domain_id: int | None = None

    def __post_init__(self) -> None:
        if not 0 < self.real_time_factor <= 1:
            raise ConfigError(
                f"the real-time factor must be above 0 and at most 1, got {self.real_time_factor:g}"
            )
        if not 0 < self.camera_hz <= 1000:
            raise ConfigError(f"cameras need a rate from 0 to 1000 Hz, got {self.camera_hz:g}")
        most = CONTROL_HZ * SUBSTEPS
        if not 0 < self.state_hz <= most:
            raise ConfigError(
                f"states need a rate from 0 to {most:g} Hz, as the physics is stepped; "
                f"got {self.state_hz:g}"
            )

    @property
    def parts(self) -> int:
        """Into how many parts a control period is divided: as few as ``state_hz`` allows."""
        whole = (n for n in range(1, SUBSTEPS + 1) if SUBSTEPS % n == 0)
        return next(n for n in whole if CONTROL_HZ * n >= self.state_hz)

    def states_by(self, part: int) -> int:
        """How many states are said by the end of so many parts of control periods."""
        return math.floor(part * self.state_hz / (CONTROL_HZ * self.parts) + _ROUNDING)

    def latency_s(self, stream: str) -> float:
        """Latency of a stream's messages, in seconds of the wall clock."""
        return self.latencies.get(stream, 0.0) / self.real_time_factor


def depths(driver: Driver) -> dict[str, str]:
    """Stream -> topic of the depth images of those cameras that a robot has."""
    return {depth_stream(c): driver.depths[c] for c in driver.cameras if c in driver.depths}


def check_stream(driver: Driver, stream: str) -> None:
    """Refuse what is not a stream of a robot's.

    Raises:
        UsageError: there is no such stream; names those that there are.
    """
    known = [*driver.states, *driver.cameras, *depths(driver)]
    if stream not in known:
        raise UsageError(f"the robot has no stream {stream!r}; it has {', '.join(known)}")


def check_fault(driver: Driver, stream: str, fault: Fault) -> None:
    """Refuse a fault that a robot's stream cannot have.

    Raises:
        UsageError: there is no such stream (names those that there are), or its messages have
            nothing that could be wrong in this way.
    """
    if stream in driver.latched:
        raise UsageError(f"{stream} is said once, at the start: it can have no fault")
    check_stream(driver, stream)
    if fault.mode == "nan" and stream not in driver.states:
        raise UsageError(f"{stream} is a camera: an image's numbers cannot be NaN")
    if fault.mode == "nan" and driver.states[stream][1] == ODOMETRY:
        raise UsageError(f"{stream} is odometry: only joints and bare numbers are made NaN")
    if fault.mode == "clock" and stream in driver.states and driver.states[stream][1] == FLOAT64:
        raise UsageError(f"{stream} is a bare number: it has no stamp that could be wrong")


def timed_fault(text: str) -> tuple[float, str, Fault]:
    """``STREAM=MODE[:AMOUNT][@SECONDS]`` as (seconds, stream, fault).

    Raises:
        UsageError: another form.
    """
    fault, _, after = text.partition("@")
    try:
        seconds = float(after or 0.0)
    except ValueError as error:
        raise UsageError(f"{text!r}: {after!r} is not a number of seconds") from error
    return (seconds, *Fault.parse(fault))


def stream_latency(text: str) -> tuple[str, float]:
    """``STREAM=SECONDS`` as (stream, seconds).

    Raises:
        UsageError: another form.
    """
    stream, _, seconds = text.rpartition("=")
    try:
        latency = float(seconds)
    except ValueError:
        latency = math.nan
    if not (stream and 0 <= latency < math.inf):
        raise UsageError(f"{text!r} is not a latency; write STREAM=SECONDS, as top=0.05")
    return stream, latency
