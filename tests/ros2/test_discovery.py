"""Errors about the ROS graph."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from fluxvla_core.ros2 import discovery


def test_missing_topics_are_named_with_those_that_exist_and_a_guess():
    error = discovery.missing(
        {"left": "/puppet/joint_left"}, ["/puppet/left_joint", "/puppet/joint_lef"], 7
    )

    assert str(error) == (
        "no publisher on /puppet/joint_left (left); "
        "published are /puppet/joint_lef, /puppet/left_joint\n"
        "  likely cause: the driver is not running, or its topics have other names\n"
        "  next: is /puppet/joint_left here /puppet/joint_lef?"
    )


def test_without_a_near_name_the_next_step_is_the_driver():
    error = discovery.missing({"cam": "/camera"}, ["/zzz"], 0)

    assert error.next == "start the driver, or set the operator's topic names"


def test_a_long_graph_is_cut():
    error = discovery.missing({"cam": "/camera"}, [f"/t{i:02}" for i in range(30)], 0)

    assert "/t19, …" in error.what
    assert "/t20" not in error.what


def test_an_empty_domain_is_named_with_its_number(monkeypatch):
    for variable in ("ROS_LOCALHOST_ONLY", "ROS_AUTOMATIC_DISCOVERY_RANGE"):
        monkeypatch.delenv(variable, raising=False)
    error = discovery.missing({"cam": "/camera"}, [], 42)

    assert "nobody publishes anything on ROS domain 42" in error.what
    assert error.cause == "the robot is on another domain"
    assert "(now 42)" in error.next


@pytest.mark.parametrize(
    ("variable", "value"),
    [("ROS_LOCALHOST_ONLY", "1"), ("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")],
)
def test_discovery_limited_to_this_machine_is_a_likely_cause(monkeypatch, variable, value):
    monkeypatch.setenv(variable, value)
    error = discovery.missing({"cam": "/camera"}, [], 0)

    assert "or on another machine (discovery is limited to this one)" in error.cause


def test_another_type_is_named():
    error = discovery.wrong_type(
        "cam (/c)", "/c", "sensor_msgs/msg/Image", ["sensor_msgs/msg/CompressedImage"]
    )

    assert error.what == (
        "cam (/c) is published as sensor_msgs/msg/CompressedImage, sensor_msgs/msg/Image is needed"
    )
    assert error.next == "a compressed image topic ends in /compressed; /c does not"


def test_another_type_without_a_compressed_one():
    error = discovery.wrong_type("s (/s)", "/s", "a/msg/B", ["c/msg/D"])

    assert error.next == "set the operator's topic name, or its preset"


def publisher(name, namespace="/"):
    return SimpleNamespace(node_name=name, node_namespace=namespace)


def test_only_others_count_as_commanders():
    infos = [publisher("me"), publisher("teleop"), publisher("replay", "/tools")]

    assert discovery.other_publishers(infos, "me") == ["/teleop", "/tools/replay"]
    assert discovery.other_publishers([publisher("me")], "me") == []


@pytest.mark.parametrize("name", ["_NODE_NAME_UNKNOWN_", "_CREATED_BY_BARE_DDS_APP_"])
def test_a_node_without_a_name_counts(name):
    infos = [publisher(name, name)]

    assert discovery.other_publishers(infos, "me") == ["a node without a name yet"]


def test_commanders_are_given_for_contested_topics_only():
    node = SimpleNamespace(
        get_publishers_info_by_topic=lambda t: [publisher("me")] + [publisher("x")] * (t == "/b")
    )

    assert discovery.commanders(node, ["/a", "/b"], "me") == {"/b": ["/x"]}


def test_contested_topics_name_who_and_what_to_do():
    error = discovery.contested({"/master/joint_left": ["/teleop"]})

    assert error.what == (
        "/teleop also publishes on /master/joint_left: two commanders on one arm make it jump"
    )
    assert "forgotten after about 20 s" in error.next


def test_deaf_command_topics_are_named():
    assert discovery.nobody_listens(["/a", "/b"]).what.startswith("nobody listens on /a, /b")


def test_silent_publishers_are_named():
    error = discovery.silent_publishers(["cam (/c)"])

    assert error.what == "there is a publisher, but no message arrives on cam (/c)"
    assert "firewall" in error.cause
