"""One node, one thread, and an orderly end; with real rclpy."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from fluxvla_core.errors import ConfigError, Faulted
from fluxvla_core.ros2 import Connection, joints, message_class
from fluxvla_core.ros2 import connection as room

pytestmark = pytest.mark.usefixtures("ros_domain")


def wait_for(condition, seconds=5.0):
    until = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until, "did not happen in time"
        time.sleep(0.01)


@pytest.fixture
def connect():
    opened = []

    def open_(name="test", domain_id=None):
        opened.append(Connection(name, domain_id))
        return opened[-1]

    yield open_
    for each in opened:
        each.close()


def test_what_is_published_arrives_with_its_receipt_time(connect):
    cls = message_class("sensor_msgs.msg:JointState")
    sender, receiver = connect("sender"), connect("receiver")
    publisher = sender.publisher("/joints", cls)
    stream = receiver.subscribe("joints", "/joints", cls, depth=4)
    wait_for(lambda: publisher.get_subscription_count() == 1)

    before = time.monotonic()
    publisher.publish(joints.fill(cls(), ["a"], [0.5]))
    wait_for(stream.newest)

    received = stream.newest()
    assert before <= received.receipt <= time.monotonic()
    assert received.stamp is None
    assert list(received.message.position) == [0.5]


def test_domains_in_one_process_do_not_hear_each_other(connect, ros_domain, other_domain):
    cls = message_class("std_msgs.msg:Float64")
    sender = connect("sender")
    near, far = connect("near"), connect("far", other_domain)
    publisher = sender.publisher("/number", cls)
    streams = [c.subscribe("number", "/number", cls, 4) for c in (near, far)]

    wait_for(lambda: publisher.publish(cls(data=1.0)) or streams[0].newest())
    time.sleep(0.2)

    assert (near.domain, far.domain) == (ros_domain, other_domain)
    assert streams[1].newest() is None


def test_closing_ends_thread_and_node_and_may_be_repeated(connect):
    watcher, closed = connect("watcher"), connect("closed")
    wait_for(lambda: closed.name in watcher.node.get_node_names())

    closed.close()
    closed.close()

    assert closed.name not in [thread.name for thread in threading.enumerate()]
    wait_for(lambda: closed.name not in watcher.node.get_node_names())
    with pytest.raises(Faulted, match=f"the connection {closed.name} is closed"):
        closed.check()


def test_many_connections_come_and_go(connect):
    before = threading.active_count()
    for _ in range(10):
        connect().close()

    assert threading.active_count() == before


def test_closing_from_the_ros_thread_does_not_wait_for_itself(connect):
    connection = connect()
    connection.every(0.01, connection.close)

    wait_for(lambda: connection.name not in [t.name for t in threading.enumerate()])


def test_a_callback_that_raises_is_reported_to_whoever_asks(connect):
    connection = connect()

    def fail():
        raise RuntimeError("the callback broke")

    connection.every(0.01, fail)
    wait_for(lambda: connection.failure)

    with pytest.raises(Faulted, match=r"the ROS thread of test_\w+ ended: the callback broke"):
        connection.check()


def test_two_nodes_of_one_name_are_told_apart(connect):
    assert connect("fluxvla aloha/1").name != connect("fluxvla aloha/1").name
    assert connect("fluxvla aloha/1").name.startswith(f"fluxvla_aloha_1_{os.getpid()}_")


@pytest.mark.parametrize("domain", [-1, 233])
def test_a_domain_out_of_range_is_refused(domain):
    with pytest.raises(ConfigError, match=f"a number from 0 to 232, got {domain}"):
        Connection("test", domain)


def test_a_domain_that_is_no_number_is_refused(monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", "robot")
    with pytest.raises(ConfigError, match="a number from 0 to 232, got 'robot'"):
        Connection("test")


def run(code, **options):
    return subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, **options
    )


OPEN = "from fluxvla_core.ros2.connection import Connection\nc = Connection('left')\n"


@pytest.mark.parametrize("ending", ["", "raise RuntimeError('bug')", "import sys; sys.exit(3)"])
def test_a_program_that_forgets_to_close_still_ends(ending):
    process = run(OPEN + ending)
    _, errors = process.communicate(timeout=20)

    assert process.returncode == {"": 0, "r": 1, "i": 3}[ending[:1]]
    assert b"terminate called" not in errors


def test_after_ctrl_c_a_last_message_can_still_be_sent(connect):
    """rclpy's own handlers would have closed the context by then."""
    cls = message_class("std_msgs.msg:Float64")
    stream = connect().subscribe("hold", "/hold", cls, 4)
    process = run(
        OPEN + "from std_msgs.msg import Float64\nimport time\n"
        "p = c.publisher('/hold', Float64)\n"
        "while not p.get_subscription_count(): time.sleep(0.01)\n"
        "try:\n    print('ready', flush=True)\n    time.sleep(20)\n"
        "except KeyboardInterrupt:\n    p.publish(Float64(data=7.0))\n"
        "    p.wait_for_all_acked()\n    c.close()\n"
    )
    assert process.stdout.readline() == b"ready\n"

    process.send_signal(signal.SIGINT)
    wait_for(stream.newest)
    process.communicate(timeout=20)

    assert stream.newest().message.data == 7.0
    assert process.returncode == 0


def test_timers_do_not_follow_the_wall_clock(connect):
    timer = connect().every(0.05, lambda: None)

    assert timer.clock.clock_type.name == "STEADY_TIME"


def test_watchers_are_called_with_every_look_at_the_graph(connect, monkeypatch):
    monkeypatch.setattr(room, "WATCH_S", 0.02)
    connection = connect()
    calls = []
    connection.watch(lambda: calls.append(threading.current_thread().name))

    wait_for(lambda: len(calls) > 2)

    assert set(calls) == {connection.name}
