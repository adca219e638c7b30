"""Queries of the ROS graph, and the errors for what is missing, silent or wrong on it."""

from __future__ import annotations

import difflib
import os
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from fluxvla_core.errors import NotReady, Rejected
from fluxvla_core.ros2.connection import Connection
from fluxvla_core.ros2.sync import Stale

# Every node has these; they do not show which robot is there.
_OF_EVERY_NODE = frozenset({"/rosout", "/parameter_events"})
_SHOWN = 20
# How long DDS keeps a participant that was killed (Fast DDS's lease).
_LEASE_S = 20


def published(node: Any, own_node: str) -> list[str]:
    """Topics on this domain that nodes other than ``own_node`` publish."""
    return [
        topic
        for topic, _ in node.get_topic_names_and_types()
        if topic not in _OF_EVERY_NODE
        and other_publishers(node.get_publishers_info_by_topic(topic), own_node)
    ]


def missing(wanted: Mapping[str, str], published: Iterable[str], domain: int) -> NotReady:
    """The error for topics that nobody publishes.

    Args:
        wanted: stream -> topic of all that are missing.
        published: topics on the graph that others publish.
        domain: the ROS domain looked at.
    """
    lines = [f"no publisher on {topic} ({name})" for name, topic in wanted.items()]
    there = sorted(published)
    if there:
        shown = ", ".join(there[:_SHOWN]) + (", …" if len(there) > _SHOWN else "")
        lines.append(f"published are {shown}")
        cause = "the driver is not running, or its topics have other names"
        guesses = {
            topic: near
            for topic in wanted.values()
            if (near := difflib.get_close_matches(topic, there, n=1, cutoff=0.7))
        }
        step = "; ".join(f"is {topic} here {near[0]}?" for topic, near in guesses.items())
        step = step or "start the driver, or set the operator's topic names"
    else:
        lines.append(f"nobody publishes anything on ROS domain {domain}")
        cause, step = _advice_on_domain(domain)
    return NotReady("; ".join(lines), cause=cause, next=step)


def wrong_type(label: str, topic: str, wanted: str, present: Sequence[str]) -> NotReady:
    """The error for a topic that is published with another message type."""
    step = None
    if any(name.endswith("/CompressedImage") for name in present):
        step = f"a compressed image topic ends in /compressed; {topic} does not"
    return NotReady(
        f"{label} is published as {', '.join(present)}, {wanted} is needed",
        cause="the topic belongs to another kind of driver",
        next=step or "set the operator's topic name, or its preset",
    )


def silent_publishers(labels: Iterable[str]) -> NotReady:
    """The error for topics with a publisher from which nothing arrives."""
    return NotReady(
        f"there is a publisher, but no message arrives on {', '.join(labels)}",
        cause="the driver waits for its device, or a firewall lets discovery through and no data",
        next="look at the driver's own output; ros2 topic hz TOPIC shows whether it sends",
    )


def nobody_listens(topics: Iterable[str]) -> NotReady:
    """The error for command topics without a subscriber."""
    return NotReady(
        f"nobody listens on {', '.join(topics)}: commands would go nowhere",
        cause="the arm's controller is not running, or takes commands on another topic",
        next="start it, or set the operator's command topics",
    )


def silent_streams(
    connection: Connection, silent: Mapping[str, float | None], max_age_s: float, whole: bool
) -> Stale:
    """The error for streams that were received before and fell silent.

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


def other_publishers(infos: Iterable[Any], own_node: str) -> list[str]:
    """Names of nodes other than ``own_node`` among a topic's publishers.

    Args:
        infos: what ``Node.get_publishers_info_by_topic`` gives.
    """
    names = []
    for info in infos:
        if info.node_name == own_node:
            continue
        namespace = info.node_namespace.rstrip("/")
        # The second is what rmw calls programs that use a DDS without ROS.
        known = not any(mark in info.node_name for mark in ("UNKNOWN", "BARE_DDS_APP"))
        names.append(f"{namespace}/{info.node_name}" if known else "a node without a name yet")
    return sorted(names)


def commanders(node: Any, topics: Iterable[str], own_node: str) -> dict[str, list[str]]:
    """Topic -> names of the nodes other than ``own_node`` that publish on it."""
    found = {
        topic: other_publishers(node.get_publishers_info_by_topic(topic), own_node)
        for topic in topics
    }
    return {topic: names for topic, names in found.items() if names}


def contested(topics: Mapping[str, Sequence[str]]) -> Rejected:
    """The error for command topics that others publish on.

    Args:
        topics: topic -> names of the nodes.
    """
    lines = [f"{', '.join(nodes)} also publishes on {topic}" for topic, nodes in topics.items()]
    return Rejected(
        f"{'; '.join(lines)}: two commanders on one arm make it jump",
        cause="teleoperation, a recorder's replay, or another run of FluxVLA is still running",
        next=f"stop it; a process that was killed is forgotten after about {_LEASE_S} s",
    )


def _advice_on_domain(domain: int) -> tuple[str, str]:
    """Cause and next step where nobody publishes anything."""
    reach = os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "")
    alone = os.environ.get("ROS_LOCALHOST_ONLY") == "1" or reach in ("LOCALHOST", "OFF")
    cause = "the robot is on another domain"
    if alone:
        cause += ", or on another machine (discovery is limited to this one)"
    step = (
        f"echo $ROS_DOMAIN_ID in the driver's shell and set the same here (now {domain}), "
        "as ROS_DOMAIN_ID or as the operator's domain_id"
    )
    return cause, step
