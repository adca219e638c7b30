"""The ur-rtde client: importing it, its readings, calls with a time limit, disconnecting."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.errors import LoadFailed, NotReady

log = logging.getLogger("fluxvla.ur")


def import_rtde() -> tuple[Any, Any]:
    """Its modules for control and for receiving.

    Raises:
        LoadFailed: it is not installed.
    """
    try:
        import rtde_control
        import rtde_receive
    except ImportError as error:
        raise LoadFailed(
            f"URRTDEOperator needs ur-rtde, which cannot be imported: {error}",
            next="pip install 'fluxvla-ur[rtde]'",
        ) from error
    return rtde_control, rtde_receive


@dataclass(frozen=True)
class Reading:
    """The controller's last message.

    Args:
        receipt: when it arrived (monotonic, s).
        joints: ``(6,)`` positions, rad.
        safety: ``safety_mode`` of the RTDE guide.
        scaling: share of the programmed speed that the robot runs at, 0 to 1.
    """

    receipt: float
    joints: npt.NDArray[np.float64]
    safety: int
    scaling: float

    @classmethod
    def newest(cls, receive: Any, receipt: float) -> Reading:
        """What the client received last."""
        return cls(
            receipt,
            np.array(receive.getActualQ(), dtype=np.float64),
            int(receive.getSafetyMode()),
            float(np.clip(receive.getSpeedScalingCombined(), 0.0, 1.0)),
        )


def wait_for(condition: Callable[[], bool], what: str, timeout_s: float) -> None:
    """Wait until ``condition`` holds.

    Raises:
        NotReady: it does not within ``timeout_s``; the message begins with ``what``.
    """
    until = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > until:
            raise NotReady(f"{what} after {timeout_s:g} s")
        time.sleep(0.01)


def within(seconds: float, call: Callable[[], object]) -> bool:
    """Whether ``call`` returns in that time; else its thread continues. Failures are logged."""

    def guarded() -> None:
        try:
            call()
        except Exception as error:  # noqa: BLE001 - the caller ends a motion for another reason
            log.error("the robot's client failed: %s", error)

    thread = threading.Thread(target=guarded, name="fluxvla-rtde-call", daemon=True)
    thread.start()
    thread.join(seconds)
    return not thread.is_alive()


def disconnect(control: Any, receive: Any) -> None:
    """End both connections, where there are any; what fails is logged."""
    calls: list[Callable[[], Any]] = []
    if control is not None and control.isConnected():
        calls.append(control.stopScript)
    calls += [each.disconnect for each in (control, receive) if each is not None]
    for call in calls:
        try:
            call()
        # What C++ throws arrives as this; the calls after a failed one matter no less.
        except RuntimeError as error:
            log.warning("ending the connection to the robot: %s: %s", call.__name__, error)
