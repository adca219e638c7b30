"""Startup checks of ``connect``: waits for streams, and names in the error what is missing.

Message losses are counted because a robot that sees one image in thirty looks like a robot with
a bad policy. Fast DDS hands messages to processes of the same machine through shared memory, in a
segment of 512 KB that belongs to the publisher. A VGA image has 900 KB: it is cut into pieces
that overwrite one another before they are read. A reliable subscription gets the pieces again;
with best effort (what camera drivers offer by default) 93 to 99 of 100 images are lost. Only the
publishing process can be given a larger segment. (On Jazzy a profile's transports are overridden
while ``ROS_AUTOMATIC_DISCOVERY_RANGE`` is ``LOCALHOST``; there the publisher has to offer
RELIABLE.)
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from fluxvla_core.errors import FluxError, NotReady
from fluxvla_core.ros2 import discovery
from fluxvla_core.ros2.connection import LARGE_FRAMES, Connection
from fluxvla_core.ros2.messages import message_class, type_name
from fluxvla_core.ros2.qos import BEST_EFFORT, RELIABLE
from fluxvla_core.ros2.stream_reader import POLL_S
from fluxvla_core.ros2.streams import CAMERA, DEPTH, CommandSpec, Stream, StreamSpec
from fluxvla_core.ros2.sync import Stale

log = logging.getLogger("fluxvla.ros2")
_POLL_S = 0.02
# So many lost messages, and none received, are not chance.
_HOPELESS = 30
SEGMENT_BYTES = 512 * 1024
ENOUGH = 0.5
"""Share of the messages that has to arrive for a stream to be used at all."""
GOOD = 0.9
"""Share below which somebody should know."""


def open_topics(
    connection: Connection, specs: Iterable[StreamSpec], commands: Iterable[CommandSpec]
) -> dict[str, Any]:
    """Subscribe to all streams; returns topic -> publisher, for each of ``commands``.

    Raises:
        LoadFailed: a message package is missing.
    """
    for spec in specs:
        message = message_class(spec.message)
        connection.subscribe(spec.name, spec.topic, message, spec.depth, spec.latched)
    return {
        command.topic: connection.publisher(command.topic, message_class(command.message))
        for command in commands
    }


class StartupChecks:
    """Looks at one connection until everything that is needed is there.

    Args:
        connection: with all streams subscribed and all publishers made.
        specs: the streams.
        commands: what is published.
        publishers: topic -> publisher, for each of ``commands``.
    """

    def __init__(
        self,
        connection: Connection,
        specs: Sequence[StreamSpec],
        commands: Sequence[CommandSpec],
        publishers: Mapping[str, Any],
    ) -> None:
        self._connection = connection
        self._node = connection.node
        self._specs = [spec for spec in specs if spec.required]
        self._optional = [spec for spec in specs if not spec.required]
        self._exclusive = [command.topic for command in commands if command.exclusive]
        self._publishers = publishers
        self._warned: set[str] = set()
        self._since = time.monotonic()

    def run(self, timeout_s: float, rate_window_s: float) -> None:
        """Wait for everything, count what arrives, and log what somebody should know.

        Raises:
            NotReady, Rejected, Faulted: as ``wait`` and ``count``.
        """
        self.wait(timeout_s)
        for warning in [*self.count(rate_window_s), *self.missing_optional()]:
            log.warning("%s", warning)

    def wait(self, timeout_s: float) -> None:
        """Wait until all streams have a message, all commands a subscriber and no other publisher.

        Raises:
            NotReady, Rejected: not within ``timeout_s``; names the first thing that is wrong.
            Faulted: the connection broke.
        """
        until = self._since + timeout_s
        while True:
            self._connection.check()
            # Before anything else: the process may be frozen by the first lost piece.
            self._warn_of_vendors()
            self._check_losses()
            late = time.monotonic() >= until
            problem = self._problem(explain=late)
            if problem is None:
                return
            if late:
                raise problem
            time.sleep(_POLL_S)

    def count(self, seconds: float) -> list[str]:
        """Count what arrives for a while; warnings about streams that lose some of it.

        Raises:
            NotReady: a stream loses most messages.
            Rejected: another commander was discovered meanwhile.
        """
        if seconds <= 0:
            return []
        streams = [(spec, self._connection.streams[spec.name]) for spec in self._specs]
        before = [(stream.ring.received, stream.lost) for _, stream in streams]
        start = time.monotonic()
        time.sleep(seconds)
        span = time.monotonic() - start
        warnings = check_losses(
            ReceptionStats(
                stream.label,
                stream.reliability,
                span,
                stream.ring.received - received,
                stream.lost - lost,
                _size(stream),
                spec.expected_hz,
                stream.from_fast_dds,
            )
            for (spec, stream), (received, lost) in zip(streams, before, strict=True)
        )
        contested = self._contested()
        if contested is not None:
            raise contested
        return warnings

    def missing_optional(self) -> list[str]:
        """Warnings about streams that nobody publishes and that are not required."""
        published = discovery.published(self._node, self._connection.name)
        return [
            f"nobody publishes {spec.label}" + (f": {spec.unheard}" if spec.unheard else "")
            for spec in self._optional
            if spec.topic not in published
        ]

    def _check_losses(self) -> None:
        """Refuse streams that lost many messages and received none: waiting does not help them."""
        streams = [self._stream(spec) for spec in self._specs]
        lost = [s for s in streams if s.lost >= _HOPELESS and not s.newest()]
        if lost:
            raise self._losses_error(lost)

    def _warn_of_vendors(self) -> None:
        """Log once which images may freeze this process (docs/ros2.md has the measurements)."""
        images = [spec for spec in self._specs if spec.kind in (CAMERA, DEPTH)]
        streams = [s for s in map(self._stream, images) if s.name not in self._warned]
        found = [s for s in streams if s.other_vendors and s.reliability == RELIABLE]
        if found:
            self._warned.update(stream.name for stream in found)
            log.warning("%s", vendor_warning([self._origin(stream) for stream in found]))

    def _origin(self, stream: Stream) -> str:
        offers = self._node.get_publishers_info_by_topic(stream.topic)
        nodes = discovery.other_publishers(offers, self._connection.name)
        return f"{stream.label} from {', '.join(nodes)} ({', '.join(stream.other_vendors)})"

    def _losses_error(self, lost: Sequence[Stream]) -> NotReady:
        span = time.monotonic() - self._since
        return losses_error(
            [
                ReceptionStats(s.label, s.reliability, span, 0, s.lost, 0, None, s.from_fast_dds)
                for s in lost
            ]
        )

    def _problem(self, explain: bool) -> FluxError | None:
        """The first problem with the streams; None if all of them are there.

        Args:
            explain: look for the cause of a silent stream, which takes a while.
        """
        quiet = [s for spec in self._specs if not (s := self._stream(spec)).newest()]
        for stream in quiet:
            stream.refresh()
        if quiet:
            if not explain:
                return NotReady("waiting")
            error = self._explain_silence(quiet)
            known = {spec.name: spec.unheard for spec in self._specs}
            causes = [known[stream.name] for stream in quiet]
            if all(causes):
                error.cause = "; ".join(causes)
            return error
        # The publisher's own count: a subscriber that is on the graph may not be matched yet, and
        # until then commands are lost, so that the first one that arrives would be a jump.
        unmatched = [t for t in self._exclusive if not self._publishers[t].get_subscription_count()]
        if unmatched:
            return discovery.nobody_listens(unmatched)
        return self._contested()

    def _contested(self) -> FluxError | None:
        others = discovery.commanders(self._node, self._exclusive, self._connection.name)
        return discovery.contested(others) if others else None

    def _explain_silence(self, quiet: Sequence[Stream]) -> FluxError:
        published = discovery.published(self._node, self._connection.name)
        missing = {s.name: s.topic for s in quiet if s.topic not in published}
        if missing:
            return discovery.missing(missing, published, self._connection.domain)
        for stream in quiet:
            wanted = type_name(stream.message)
            offers = self._node.get_publishers_info_by_topic(stream.topic)
            types = sorted({offer.topic_type for offer in offers})
            if wanted not in types:
                return discovery.wrong_type(stream.label, stream.topic, wanted, types)
        lost = [s for s in quiet if s.lost]
        if lost:
            return self._losses_error(lost)
        return discovery.silent_publishers([s.label for s in quiet])

    def _stream(self, spec: StreamSpec) -> Stream:
        return self._connection.streams[spec.name]


def wait_for_reading(read: Callable[[], object], timeout_s: float) -> None:
    """Wait until a frame or a state can be read.

    Raises:
        Stale: not within ``timeout_s``.
    """
    until = time.monotonic() + timeout_s
    while True:
        try:
            read()
        except Stale:
            if time.monotonic() >= until:
                raise
            time.sleep(POLL_S)
        else:
            return


def _size(stream: Stream) -> int:
    """Bytes of the newest message's ``data``, 0 where there is none."""
    newest = stream.newest()
    data: Any = getattr(newest.message, "data", b"") if newest is not None else b""
    return len(data) if hasattr(data, "__len__") else 0


@dataclass(frozen=True)
class ReceptionStats:
    """Statistics of what one stream received in some time.

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
        counted = float(self.received + self.lost)
        return max(counted, (self.expected_hz or 0.0) * self.seconds)

    @property
    def share(self) -> float:
        """Received of wanted, 1 where nothing was."""
        return self.received / self.wanted if self.wanted else 1.0

    def __str__(self) -> str:
        return f"{self.label}: {self.received} of {self.wanted:.0f} messages arrived"


def check_losses(streams: Iterable[ReceptionStats]) -> list[str]:
    """Warnings for streams that lose some messages.

    Raises:
        NotReady: a stream loses most; names all of them, and the shared-memory trap if it is one.
    """
    everything = list(streams)
    bad = [r for r in everything if r.share < ENOUGH]
    if bad:
        raise losses_error(bad)
    return [f"{r} in {r.seconds:.1f} s" for r in everything if r.share < GOOD]


def losses_error(bad: list[ReceptionStats]) -> NotReady:
    """The error for streams that lose most of their messages."""
    what = "; ".join(f"{r} in {r.seconds:.1f} s" for r in bad)
    if any(is_trap(r) and r.from_fast_dds for r in bad):
        return NotReady(
            what,
            cause="the publisher offers best effort, and its images are larger than the 512 KB "
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
            # Not RELIABLE: see vendor_warning.
            next="make the receive buffers of this machine larger (net.core.rmem_max; 'Robots on "
            "another DDS' in docs/ros2.md says how), or the images smaller or compressed",
        )
    return NotReady(
        what,
        cause="the driver is slower than expected, or the network or this machine is overloaded",
        next="set the rate that the driver really has, or lighten the load; "
        "ros2 topic hz TOPIC shows what another subscriber gets",
    )


def vendor_warning(origins: Sequence[str]) -> str:
    """The warning for reliable images from another DDS; ``origins`` says who publishes them."""
    return (
        f"reliable images come from another DDS: {'; '.join(origins)}. When pieces of a large "
        "one are lost, Fast DDS can freeze this whole process (measured with Cyclone DDS). "
        "Let the publisher offer best effort, and start this program with "
        f"FASTDDS_DEFAULT_PROFILES_FILE={large_frames_profile()}, whose larger receive buffer "
        "loses fewer; see 'Robots on another DDS' in docs/ros2.md"
    )


def is_trap(stats: ReceptionStats) -> bool:
    """Whether large best-effort messages are lost: with Fast DDS, the shared-memory trap.

    Where no message ever arrived its size is unknown, and losses that the middleware reports for a
    best-effort stream are enough.
    """
    large = stats.size > SEGMENT_BYTES or (stats.size == 0 and stats.lost > 0)
    return stats.reliability == BEST_EFFORT and large and stats.share < ENOUGH


def large_frames_profile() -> str:
    """Path of the Fast DDS profile with a 32 MB segment that ships with this package."""
    return str(LARGE_FRAMES)
