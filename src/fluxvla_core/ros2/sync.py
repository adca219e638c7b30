"""Approximate time synchronisation: from each stream the message nearest to one instant.

The instant is the newest one that every stream has reached, as seen by the senders' stamps. Two
bounds keep the result honest: no message may have arrived longer ago than ``max_age`` (on this
process's monotonic clock, which nobody steps), and the chosen messages' stamps may not be further
apart than ``max_skew``.
"""

from __future__ import annotations

import bisect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from fluxvla_core.ros2.ring import Received
from fluxvla_core.ros2.trouble import Stale

Streams = Mapping[str, Sequence[Received]]


@dataclass(frozen=True)
class Matched:
    """One message of each stream.

    ``skew`` is how far apart they are, in seconds; ``slowest`` the stream whose newest message is
    the one that the others were matched with.
    """

    messages: Mapping[str, Received]
    skew: float
    slowest: str


def silent(
    newest: Mapping[str, Received | None], now: float, max_age: float
) -> dict[str, float | None]:
    """Streams whose newest message arrived more than ``max_age`` s ago, with its age in seconds.

    None as age: nothing ever arrived.
    """
    ages = {name: None if item is None else now - item.receipt for name, item in newest.items()}
    return {name: age for name, age in ages.items() if age is None or age > max_age}


def match(streams: Streams, max_skew: float, by: str = "stamp") -> Matched:
    """The messages that belong together, one of each stream.

    Args:
        streams: name -> messages, newest last; none empty.
        max_skew: seconds that the chosen messages may be apart.
        by: ``stamp`` compares the senders' clocks, ``receipt`` when messages arrived (for senders
            whose clocks differ). Where any stream bears no stamps, ``receipt`` is used.

    Raises:
        Stale: they are further apart; names the first and the last stream, and whether the
            senders' clocks differ or a stream is late.
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
        raise _apart(chosen, times, skew, max_skew, by)
    return Matched(chosen, skew, slowest)


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
            next="look at its driver's load; if that is how it is, allow more with max_age_s",
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


def _apart(
    chosen: Mapping[str, Received],
    times: Mapping[str, float],
    skew: float,
    max_skew: float,
    by: str,
) -> Stale:
    first, last = min(times, key=times.__getitem__), max(times, key=times.__getitem__)
    receipts = [m.receipt for m in chosen.values()]
    cause = f"{first} is late, or comes in bursts"
    step = "look at its driver's load, or allow more with max_skew_s"
    if by == "stamp" and skew > 10 * max(max(receipts) - min(receipts), max_skew):
        cause = "they arrive together, so the clocks that stamp them differ"
        step = "synchronise the machines' clocks (chrony), or set sync_on='receipt'"
    return Stale(
        f"{first} is {skew:.3f} s behind {last}; at most {max_skew:g} s is allowed",
        cause=cause,
        next=step,
    )
