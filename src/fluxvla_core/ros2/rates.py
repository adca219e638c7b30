"""Is what arrives what was sent? Checked once at start-up, because a robot that sees one picture
in thirty looks like a robot with a bad policy.

Fast DDS hands messages to processes of the same machine through shared memory, in a segment of
512 KB that belongs to the publisher. A VGA picture has 900 KB: it is cut into pieces that overwrite
one another before they are read. A reliable subscription gets the pieces again; with best effort
(what camera drivers offer by default) 93 to 99 of 100 pictures are lost. Only the publishing
process can be given a larger segment. (On Jazzy a profile's transports are overridden while
``ROS_AUTOMATIC_DISCOVERY_RANGE`` is ``LOCALHOST``; there the publisher has to offer RELIABLE.)
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from importlib import resources

from fluxvla_core.errors import NotReady
from fluxvla_core.ros2.qos import BEST_EFFORT

SEGMENT_BYTES = 512 * 1024
ENOUGH = 0.5
"""Share of the messages that has to arrive for a stream to be used at all."""
GOOD = 0.9
"""Share below which somebody should know."""


@dataclass(frozen=True)
class Reception:
    """What one stream received in a while.

    Args:
        label: the stream's name and topic.
        reliability: what it subscribed with.
        seconds: for how long was counted.
        received: messages that arrived.
        lost: messages that the middleware says were sent and did not arrive.
        size: bytes of one message, 0 if unknown.
        expected_hz: messages a second that should come; None takes received and lost together.
        from_fast_dds: whether its publishers are ones of Fast DDS; others know no such segment.
    """

    label: str
    reliability: str
    seconds: float
    received: int
    lost: int
    size: int
    expected_hz: float | None = None
    from_fast_dds: bool = False

    @property
    def wanted(self) -> float:
        """Messages that should have arrived."""
        told = float(self.received + self.lost)
        return max(told, (self.expected_hz or 0.0) * self.seconds)

    @property
    def share(self) -> float:
        """Received of wanted, 1 where nothing was."""
        return self.received / self.wanted if self.wanted else 1.0

    def __str__(self) -> str:
        return f"{self.label}: {self.received} of {self.wanted:.0f} messages arrived"


def check(receptions: Iterable[Reception]) -> list[str]:
    """Warnings for streams that lose some messages.

    Raises:
        NotReady: a stream loses most; names all of them, and the shared-memory trap if it is one.
    """
    everything = list(receptions)
    bad = [r for r in everything if r.share < ENOUGH]
    if bad:
        raise lossy(bad)
    return [f"{r} in {r.seconds:.1f} s" for r in everything if r.share < GOOD]


def lossy(bad: list[Reception]) -> NotReady:
    """The error for streams that lose most of their messages."""
    what = "; ".join(f"{r} in {r.seconds:.1f} s" for r in bad)
    if any(is_trap(r) and r.from_fast_dds for r in bad):
        return NotReady(
            what,
            cause="the publisher offers best effort, and its pictures are larger than the 512 KB "
            "of Fast DDS's shared memory, so their pieces overwrite one another",
            next="start the publisher (not this program) with "
            f"FASTDDS_DEFAULT_PROFILES_FILE={large_frames_profile()}, or let it offer RELIABLE",
        )
    if any(is_trap(r) for r in bad):
        return NotReady(
            what,
            cause="the publisher offers best effort, so that a large message is lost with any "
            "piece of it; publisher and subscriber do not share Fast DDS's memory, so the network "
            "or its buffers drop the pieces",
            next="let the publisher offer RELIABLE, or make the receive buffers of this machine "
            "larger (net.core.rmem_max) and the pictures smaller or compressed",
        )
    return NotReady(
        what,
        cause="the driver is slower than expected, or the network or this machine is overloaded",
        next="set the rate that the driver really has, or lighten the load; "
        "ros2 topic hz TOPIC shows what another subscriber gets",
    )


def is_trap(reception: Reception) -> bool:
    """Whether large best-effort messages are lost: with Fast DDS, the shared-memory trap.

    Where no message ever arrived its size is unknown, and losses that the middleware reports for a
    best-effort stream are enough.
    """
    large = reception.size > SEGMENT_BYTES or (reception.size == 0 and reception.lost > 0)
    return reception.reliability == BEST_EFFORT and large and reception.share < ENOUGH


def large_frames_profile() -> str:
    """Path of the Fast DDS profile with a 32 MB segment that ships with this package."""
    return str(resources.files("fluxvla_core.ros2") / "fastdds_large_frames.xml")
