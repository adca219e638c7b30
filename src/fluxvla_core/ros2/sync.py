"""Approximate time synchronisation: from each stream the message nearest to one instant.

The instant is the newest one that every stream has reached, as seen by the senders' stamps. Two
bounds keep the result honest: no message may have arrived longer ago than ``max_age`` (on this
process's monotonic clock, which nobody steps), and the chosen messages' stamps may not be further
apart than ``max_skew``.
"""

from __future__ import annotations

import bisect
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

from fluxvla_core.errors import NotReady
from fluxvla_core.ros2.streams import STEP, Received

_CLOCKS = "synchronise the machines' clocks (chrony), or set sync_on='receipt'"
CLOCK_SAMPLES = 16
"""The last messages of a stream, from which its sender's clock and latency are estimated."""
Streams = Mapping[str, Sequence[Received]]


class Stale(NotReady):
    """A stream is silent, late, or too far from the others in time; it may recover.

    The arm still obeys: it is braked and held, by the safety rule named here.
    """

    rule: ClassVar[str] = "freshness"


@dataclass(frozen=True)
class Matched:
    """One message of each stream.

    ``skew`` is how far apart they are, in seconds; ``slowest`` the stream whose newest message is
    the one that the others were matched with.
    """

    messages: Mapping[str, Received]
    skew: float
    slowest: str


def wall_offset() -> float:
    """Seconds to add to a receipt time (monotonic) for this machine's wall clock."""
    return time.time() - time.monotonic()


def silent(
    newest: Mapping[str, Received | None], now: float, max_age: float
) -> dict[str, float | None]:
    """Streams whose newest message arrived more than ``max_age`` s ago, with its age in seconds.

    None as age: nothing ever arrived.
    """
    ages = {name: None if item is None else now - item.receipt for name, item in newest.items()}
    return {name: age for name, age in ages.items() if age is None or age > max_age}


def match(
    streams: Streams, max_skew: float, by: str = "stamp", wall_offset: float | None = None
) -> Matched:
    """The messages that belong together, one of each stream.

    Args:
        streams: name -> messages, newest last; none empty.
        max_skew: seconds that the chosen messages may be apart.
        by: ``stamp`` compares the senders' clocks, ``receipt`` when messages arrived (for senders
            whose clocks differ). Where any stream has no stamps, ``receipt`` is used.
        wall_offset: see :func:`wall_offset`; tells which sender's clock is off.

    Raises:
        Stale: they are further apart; names the first and the last stream, and whether the
            senders' clocks differ (and whose is off) or a stream is late.
    """
    if any(items[-1].stamp is None for items in streams.values()):
        by = "receipt"
    reached = {name: _time(items[-1], by) for name, items in streams.items()}
    slowest = min(reached, key=reached.__getitem__)
    instant = reached[slowest]
    chosen = {name: _nearest(items, instant, by) for name, items in streams.items()}
    times = {name: _time(message, by) for name, message in chosen.items()}
    skew = max(times.values()) - min(times.values())
    if skew > max_skew:
        error = _too_far_apart(chosen, times, skew, max_skew, by)
        if by == "stamp":
            first, last = min(times, key=times.__getitem__), max(times, key=times.__getitem__)
            delays = {name: _delay(streams[name]) for name in (first, last)}
            if abs(delays[first] - delays[last]) > STEP:
                error.cause, error.next = _wrong_clock(delays, wall_offset), _CLOCKS
        raise error
    return Matched(chosen, skew, slowest)


def check_together(streams: Streams, max_skew: float, wall_offset: float | None = None) -> None:
    """Refuse parts of one state whose stamps say that they are of different times.

    What arrives at the same time and is stamped apart is a difference of clocks, or one sender is
    that much later than the other: either way the newest messages do not belong together. Images
    take longer than joint states, and are matched by their stamps instead.

    Args:
        streams: those that make up the state; where one has no stamps, nothing is checked.
        max_skew, wall_offset: see ``match``.

    Raises:
        Stale: names the two that are furthest apart, and whose clock is off.
    """
    if len(streams) < 2 or any(items[-1].stamp is None for items in streams.values()):
        return
    delays = {name: _delay(items) for name, items in streams.items()}
    first, last = max(delays, key=delays.__getitem__), min(delays, key=delays.__getitem__)
    apart = delays[first] - delays[last]
    if apart > max_skew:
        raise Stale(
            f"{first} is stamped {apart:.3f} s earlier than {last}, although they arrive together; "
            f"at most {max_skew:g} s is allowed",
            cause=_wrong_clock({name: delays[name] for name in (first, last)}, wall_offset),
            next=f"{_CLOCKS}; the operator's max_skew_s sets what is allowed",
        )


def check_age(matched: Matched, now: float, max_age: float) -> None:
    """Refuse what belongs together but happened too long ago.

    Raises:
        Stale: the oldest of the messages arrived more than ``max_age`` s ago, because the
            slowest stream is that late; names it.
    """
    age = now - min(message.receipt for message in matched.messages.values())
    if age > max_age:
        raise Stale(
            f"{matched.slowest} is late: what belongs to its newest message arrived {age:.2f} s "
            f"ago; {max_age:g} s is allowed",
            cause="its driver or the network delays it",
            next="look at its driver's load, or allow more with max_age_s of the operator",
        )


def _delay(items: Sequence[Received]) -> float:
    """How long after its stamp a message arrives, at best: latency, and how clocks differ.

    At best, because messages may come in bursts.
    """
    delays = [message.delay_s for message in items[-CLOCK_SAMPLES:]]
    return min((delay for delay in delays if delay is not None), default=0.0)


def _wrong_clock(delays: Mapping[str, float], wall_offset: float | None) -> str:
    """Text: which of the streams has a wrong clock."""
    slow, fast = max(delays, key=delays.__getitem__), min(delays, key=delays.__getitem__)
    # By this machine's wall clock; a stamp in the future cannot be a message that is late.
    behind = {name: delay + (wall_offset or 0.0) for name, delay in delays.items()}
    if wall_offset is None or min(map(abs, behind.values())) > STEP:
        return "they arrive together, so the clocks that stamp them differ"
    if abs(behind[fast]) > abs(behind[slow]):
        return f"the clock that stamps {fast} is {-behind[fast]:.2f} s ahead of this machine's"
    return (
        f"the clock that stamps {slow} is {behind[slow]:.2f} s behind this machine's, "
        "or its messages are sent that late"
    )


def _nearest(items: Sequence[Received], instant: float, by: str) -> Received:
    # Rings keep their messages in the order of both clocks.
    after = bisect.bisect_left(items, instant, key=lambda message: _time(message, by))
    around = items[max(after - 1, 0) : after + 1]
    return min(around, key=lambda message: abs(_time(message, by) - instant))


def _time(message: Received, by: str) -> float:
    # A stream may begin with messages that had no stamp yet; they never match.
    if by == "stamp":
        return message.stamp if message.stamp is not None else float("-inf")
    return message.receipt


def _too_far_apart(
    chosen: Mapping[str, Received],
    times: Mapping[str, float],
    skew: float,
    max_skew: float,
    by: str,
) -> Stale:
    first, last = min(times, key=times.__getitem__), max(times, key=times.__getitem__)
    receipts = [m.receipt for m in chosen.values()]
    cause = f"{first} is late, or comes in bursts"
    step = "look at its driver's load, or allow more with max_skew_s of the operator"
    if by == "stamp" and skew > 10 * max(max(receipts) - min(receipts), max_skew):
        cause = "they arrive together, so the clocks that stamp them differ"
        step = _CLOCKS
    return Stale(
        f"{first} is {skew:.3f} s behind {last}; at most {max_skew:g} s is allowed",
        cause=cause,
        next=step,
    )
