"""Messages that are kept serialized, and deserialized when they are read."""

from __future__ import annotations

import pytest

from fluxvla_core.ros2.messages import BadMessage, message_class, stamp_of, stamp_reader
from fluxvla_core.ros2.streams import Received, Ring

pytest.importorskip("rclpy")
from rclpy.serialization import serialize_message

JOINTS = message_class("sensor_msgs.msg:JointState")


def joint_state(sec: int = 0, nanosec: int = 0):
    message = JOINTS(name=["elbow"], position=[0.25])
    message.header.stamp.sec, message.header.stamp.nanosec = sec, nanosec
    return message


@pytest.mark.parametrize(
    "stamp", [(0, 0), (0, 1), (1_700_000_000, 999_999_999), (-5, 250_000_000)]
)
def test_the_stamp_is_read_without_the_rest(stamp):
    message = joint_state(*stamp)

    assert stamp_reader(JOINTS)(serialize_message(message)) == stamp_of(message)


def test_the_byte_order_is_the_senders():
    big_endian = b"\x00\x00\x00\x00" + (7).to_bytes(4, "big") + (500_000_000).to_bytes(4, "big")

    assert stamp_reader(JOINTS)(big_endian) == 7.5


def test_messages_without_a_header_have_no_stamp():
    cls = message_class("std_msgs.msg:Float64")

    assert stamp_reader(cls)(serialize_message(cls(data=1.0))) is None


class HeaderLast:
    """Has the fields of a message whose header does not come first."""

    @classmethod
    def get_fields_and_field_types(cls):
        return {"data": "float64", "header": "std_msgs/Header"}


def test_a_stamp_behind_other_fields_cannot_be_read_without_them():
    assert stamp_reader(HeaderLast) is None


def test_a_message_is_deserialized_once_and_only_when_it_is_read():
    ring = Ring(4)
    data = serialize_message(joint_state(3))
    assert ring.add(1.0, 3.0, data, JOINTS)

    received = ring.newest()
    assert received.content is data
    assert list(received.message.position) == [0.25]
    assert received.message is received.message


def test_bytes_that_are_no_message_are_refused():
    with pytest.raises(BadMessage, match="sensor_msgs/msg/JointState"):
        Received(1.0, None, b"\x00\x01\x00\x00\x01", JOINTS).message
