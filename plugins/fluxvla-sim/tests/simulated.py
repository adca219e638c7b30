"""Simulated robots in processes of their own, and what talks to them over ROS 2."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections import deque
from types import SimpleNamespace

import numpy as np
import pytest

from fluxvla_core.ros2 import Connection, message_class
from fluxvla_core.testing.ros2 import ros_domain

__all__ = ["ros_domain"]

SMALL = ["--height", "48", "--width", "64", "--camera-hz", "20"]
# Machines that run tests stall for seconds; where silence is not what is tested, it is forgiven.
PATIENT = {"height": 48, "width": 64, "connect_timeout_s": 30.0, "max_age_s": 20.0}
ALOHA = {"arms": "viperx300", "camera_names": ("top",), **PATIENT}
UR = {"camera_names": ("front",), **PATIENT}
SILENT_S = 2.0


def wait_for(condition, seconds=20.0):
    until = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until, "did not happen in time"
        time.sleep(0.02)


@pytest.fixture
def simulate(ros_domain):
    started = []

    def start(*arguments):
        run = "import sys; from fluxvla_core.cli.main import main; sys.exit(main())"
        process = subprocess.Popen(
            [sys.executable, "-c", run, "sim", *arguments, *SMALL, "--log-format", "json"],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        started.append(process)
        return process

    yield start
    for process in started:
        process.kill()
        process.communicate(timeout=30.0)


@pytest.fixture
def connect(ros_domain):
    opened = []

    def make(cls, **arguments):
        operator = cls(rate_window_s=0.0, **arguments)
        opened.append(operator)
        operator.connect()
        return operator

    yield make
    for operator in opened:
        operator.close()


@pytest.fixture
def topics(ros_domain):
    """The simulation's own topics: ``facts()``, ``tell(topic, value)``; ``listen`` to any."""
    connection = Connection("test")
    text = message_class("std_msgs.msg:String")
    kinds = {"/sim/reset": message_class("std_msgs.msg:Int64"), "/sim/fault": text}
    kinds["/sim/speed_scaling"] = message_class("std_msgs.msg:Float64")
    stream = connection.subscribe("facts", "/sim/facts", text, 1)
    publishers = {topic: connection.publisher(topic, cls) for topic, cls in kinds.items()}

    def tell(topic, value):
        wait_for(lambda: publishers[topic].get_subscription_count())
        publishers[topic].publish(kinds[topic](data=value))

    def facts():
        wait_for(stream.newest)
        return json.loads(stream.newest().message.data)

    def listen(topic, kind, kept=400):
        # Not a stream of ours: that leaves out what comes twice or late.
        heard = deque(maxlen=kept)

        def keep(message):
            heard.append(message)

        connection.node.create_subscription(message_class(kind), topic, keep, kept)
        return heard

    yield SimpleNamespace(tell=tell, facts=facts, listen=listen)
    connection.close()


def drive(operator, target, arrived, steps=100, hz=50.0):
    """Go there in a straight line, as a control loop does, and wait until the arm is there."""
    start = operator.get_state()
    for share in np.linspace(0.0, 1.0, steps):
        operator.send_action(start + share * (target - start))
        time.sleep(1.0 / hz)
    wait_for(lambda: arrived(operator.get_state()))
