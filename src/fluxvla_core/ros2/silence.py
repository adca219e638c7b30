"""What to say of streams that fell silent."""

from __future__ import annotations

from collections.abc import Mapping

from fluxvla_core.ros2.connection import Connection
from fluxvla_core.ros2.trouble import Stale


def explained(
    connection: Connection, silent: Mapping[str, float | None], max_age_s: float, whole: bool
) -> Stale:
    """Which topics are silent and since when; a frozen device, a dead driver, or the network.

    Args:
        silent: stream -> its age in seconds, as ``sync.silent`` gives them.
        max_age_s: seconds that are allowed.
        whole: whether these are all streams that should speak.
    """
    lines, gone = [], []
    for name, age in silent.items():
        stream = connection.streams[name]
        since = f"silent for {age:.2f} s" if age is not None else "never heard"
        lines.append(f"{stream.label} is {since}")
        if not connection.node.get_publishers_info_by_topic(stream.topic):
            gone.append(stream.topic)
    cause = "the device froze, or its driver was killed or hangs"
    if whole:
        cause = "every stream at once: the network is gone, or this machine is overloaded"
    if gone:
        cause = f"the driver is gone: nobody publishes {', '.join(gone)} any more"
    return Stale(
        f"{'; '.join(lines)}; {max_age_s:g} s is allowed",
        cause=cause,
        next="look at the driver; max_age_s of the operator says how long it may be silent",
    )
