"""The streams of a simulated robot, as people name them on a command line."""

from __future__ import annotations

import math

from fluxvla_core.errors import UsageError
from fluxvla_core.ros2 import FLOAT64, ODOMETRY, Fault, depth_stream
from fluxvla_sim.ros2.bodies import Body


def depths(body: Body) -> dict[str, str]:
    """Stream -> topic of the depth pictures of those cameras that a robot has."""
    return {depth_stream(c): body.depths[c] for c in body.cameras if c in body.depths}


def check_stream(body: Body, stream: str) -> None:
    """Refuse what is no stream of a robot's.

    Raises:
        UsageError: there is no such stream; names those that there are.
    """
    known = [*body.states, *body.cameras, *depths(body)]
    if stream not in known:
        raise UsageError(f"the robot has no stream {stream!r}; it has {', '.join(known)}")


def check_fault(body: Body, stream: str, fault: Fault) -> None:
    """Refuse a fault that a robot's stream cannot have.

    Raises:
        UsageError: there is no such stream (names those that there are), or its messages have
            nothing that could be wrong in this way.
    """
    if stream in body.latched:
        raise UsageError(f"{stream} is said once, at the start: it can have no fault")
    check_stream(body, stream)
    if fault.mode == "nan" and stream not in body.states:
        raise UsageError(f"{stream} is a camera: a picture's numbers cannot be NaN")
    if fault.mode == "nan" and body.states[stream][1] == ODOMETRY:
        raise UsageError(f"{stream} is odometry: only joints and bare numbers are made NaN")
    if fault.mode == "clock" and stream in body.states and body.states[stream][1] == FLOAT64:
        raise UsageError(f"{stream} is a bare number: it bears no stamp that could be wrong")


def timed_fault(text: str) -> tuple[float, str, Fault]:
    """``STREAM=MODE[:AMOUNT][@SECONDS]`` as (seconds, stream, fault).

    Raises:
        UsageError: another form.
    """
    fault, _, after = text.partition("@")
    try:
        seconds = float(after or 0.0)
    except ValueError as error:
        raise UsageError(f"{text!r}: {after!r} is no number of seconds") from error
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
        raise UsageError(f"{text!r} is no latency; write STREAM=SECONDS, as top=0.05")
    return stream, latency
