"""Quality of service: what to ask for, given what publishers offer."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

RELIABLE = "reliable"
BEST_EFFORT = "best_effort"
_FAST_DDS = b"\x01\x0f"
# The first two bytes of a GUID are the vendor of the publisher's DDS (dds-foundation.org).
_VENDORS = {b"\x01\x01": "RTI Connext", b"\x01\x10": "Cyclone DDS"}


def reliability(offers: Iterable[Any]) -> str:
    """The QoS to subscribe with: ``reliable`` if every publisher offers it, else ``best_effort``.

    A reliable subscription is never matched with a best-effort publisher, while a best-effort one
    is matched with any; and best effort loses images that a reliable one would have repaired.

    Args:
        offers: what ``Node.get_publishers_info_by_topic`` gives.
    """
    kinds = [offer.qos_profile.reliability.name for offer in offers]
    return RELIABLE if kinds and all(kind == "RELIABLE" for kind in kinds) else BEST_EFFORT


def from_fast_dds(offers: Iterable[Any]) -> bool:
    """Whether every publisher is one of Fast DDS, by the vendor in its GUID (RTPS 9.3.1.5), and
    this process uses Fast DDS, too: only then do they share memory."""
    vendors = [_vendor(offer) for offer in offers]
    return bool(vendors) and _uses_fast_dds() and all(vendor == _FAST_DDS for vendor in vendors)


def other_vendors(offers: Iterable[Any]) -> list[str]:
    """Names of the DDS of the publishers that do not use Fast DDS, if this process does."""
    others = {_vendor(offer) for offer in offers} - {_FAST_DDS}
    if not others or not _uses_fast_dds():
        return []
    return sorted(_VENDORS.get(vendor, f"another DDS (vendor {vendor.hex()})") for vendor in others)


def _vendor(offer: Any) -> bytes:
    return bytes(offer.endpoint_gid[:2])


def _uses_fast_dds() -> bool:
    from rclpy.utilities import get_rmw_implementation_identifier

    return "fastrtps" in get_rmw_implementation_identifier()


def keeps_last(offers: Iterable[Any]) -> bool:
    """Whether every publisher hands its last message to who comes later (``transient_local``).

    Asking for it where one does not would leave that one unmatched.
    """
    kinds = [offer.qos_profile.durability.name for offer in offers]
    return bool(kinds) and all(kind == "TRANSIENT_LOCAL" for kind in kinds)


def profile(kind: str, depth: int, latched: bool = False) -> Any:
    """``rclpy.qos.QoSProfile`` with the last ``depth`` messages, reliable or best effort, and
    ``transient_local`` durability if ``latched``."""
    from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

    return QoSProfile(
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE
        if kind == RELIABLE
        else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )
