"""The ur-rtde client: importing it, calls with a time limit, disconnecting."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Any

from fluxvla_core.errors import LoadFailed

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
