"""A camera driver on Cyclone DDS: reliable images, in a process of its own.

    python -m benchmarks._cyclone_camera TOPIC [TOPIC ...] --height H --width W --hz RATE

It uses Cyclone's own Python package instead of ROS 2, whose wheels bring Fast DDS alone, and
publishes black images from the first line of its input until it is ended. ``ROS_DOMAIN_ID`` is its
domain.
"""

import argparse
import os
import time
from dataclasses import dataclass

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import int32, sequence, uint8, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.topic import Topic
from cyclonedds.util import duration

# The types of ROS 2 as they are named on the wire: sensor_msgs/msg/Image.idl and what it contains.
# No ``from __future__ import annotations``: Cyclone reads these annotations.


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Time
    frame_id: str


@dataclass
class Image(IdlStruct, typename="sensor_msgs::msg::dds_::Image_"):
    header: Header
    height: uint32
    width: uint32
    encoding: str
    is_bigendian: uint8
    step: uint32
    data: sequence[uint8]


def main() -> None:
    """Publish until the process is ended."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("topics", nargs="+")
    parser.add_argument("--height", type=int, required=True)
    parser.add_argument("--width", type=int, required=True)
    parser.add_argument("--hz", type=float, required=True)
    args = parser.parse_args()
    participant = DomainParticipant(int(os.environ["ROS_DOMAIN_ID"]))
    qos = Qos(Policy.Reliability.Reliable(duration(milliseconds=100)), Policy.History.KeepLast(5))
    # A topic of ROS 2 has this prefix in DDS.
    topics = [Topic(participant, f"rt{topic}", Image, qos=qos) for topic in args.topics]
    writers = [DataWriter(participant, topic, qos=qos) for topic in topics]
    input()
    pixels = bytes(args.height * args.width * 3)
    due = time.monotonic()
    while True:
        seconds, nanoseconds = divmod(time.time_ns(), 10**9)
        header = Header(Time(seconds, nanoseconds), "camera")
        for writer in writers:
            writer.write(Image(header, args.height, args.width, "rgb8", 0, 3 * args.width, pixels))
        due = max(due + 1 / args.hz, time.monotonic())
        time.sleep(due - time.monotonic() if due > time.monotonic() else 0.0)


if __name__ == "__main__":
    main()
