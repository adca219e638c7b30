"""Choosing reliability and durability by what is offered."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from fluxvla_core.ros2 import qos


def offers(*kinds):
    def named(value):
        return SimpleNamespace(name=value)

    return [
        SimpleNamespace(qos_profile=SimpleNamespace(reliability=named(r), durability=named(d)))
        for r, d in kinds
    ]


R, B = "RELIABLE", "BEST_EFFORT"
V, T = "VOLATILE", "TRANSIENT_LOCAL"


@pytest.mark.parametrize(
    ("given", "chosen"),
    [
        ([], qos.BEST_EFFORT),
        ([(R, V)], qos.RELIABLE),
        ([(R, V), (R, T)], qos.RELIABLE),
        ([(B, V)], qos.BEST_EFFORT),
        ([(R, V), (B, V)], qos.BEST_EFFORT),
    ],
)
def test_reliable_only_where_everybody_offers_it(given, chosen):
    assert qos.reliability(offers(*given)) == chosen


@pytest.mark.parametrize(
    ("given", "kept"), [([], False), ([(R, T)], True), ([(R, T), (R, V)], False)]
)
def test_last_messages_are_asked_for_only_where_everybody_keeps_them(given, kept):
    assert qos.keeps_last(offers(*given)) is kept


@pytest.mark.parametrize(
    ("vendors", "fast"),
    [
        ([], False),
        ([(1, 15)], True),
        ([(1, 16)], False),  # Eclipse Cyclone DDS
        ([(1, 15), (1, 1)], False),  # RTI Connext
    ],
)
def test_the_vendor_is_told_by_the_publishers_guid(ros_domain, vendors, fast):
    given = [SimpleNamespace(endpoint_gid=[*vendor, *range(14)]) for vendor in vendors]

    assert qos.from_fast_dds(given) is fast


# As rclpy (Kilted) gave them: Fast DDS 3.2.3, and Cyclone DDS 11.0.1 from its wheel.
FAST = bytes.fromhex("010f78fdb15c8c530100000000000603")
CYCLONE = bytes.fromhex("01105eb2fadf5a541ebd6aa700000203")
UNLISTED = b"\x01\x7f" + CYCLONE[2:]


@pytest.mark.parametrize(
    ("gids", "names"),
    [
        ([], []),
        ([FAST], []),
        ([CYCLONE], ["Cyclone DDS"]),
        ([FAST, CYCLONE, CYCLONE], ["Cyclone DDS"]),
        ([UNLISTED], ["another DDS (vendor 017f)"]),
    ],
)
def test_publishers_on_another_dds_are_named(ros_domain, gids, names):
    given = [SimpleNamespace(endpoint_gid=list(gid)) for gid in gids]

    assert qos.other_vendors(given) == names


def test_where_fast_dds_does_not_receive_there_is_nothing_to_name(ros_domain, monkeypatch):
    monkeypatch.setattr(qos, "_uses_fast_dds", lambda: False)

    assert qos.other_vendors([SimpleNamespace(endpoint_gid=list(CYCLONE))]) == []


def test_profiles_say_what_was_chosen(ros_domain):
    profile = qos.profile(qos.RELIABLE, 3, latched=True)
    plain = qos.profile(qos.BEST_EFFORT, 1)

    assert (profile.depth, profile.reliability.name, profile.durability.name) == (3, R, T)
    assert (plain.depth, plain.reliability.name, plain.durability.name) == (1, B, V)
