"""Tasks from a ROS 2 topic, said by another node."""

from __future__ import annotations

import _thread
import threading
import time

import pytest

from fluxvla_core.errors import LoadFailed, UsageError
from fluxvla_core.robot.tasks import TopicTasks
from fluxvla_core.testing.ros2 import ros_domain

__all__ = ["ros_domain"]
TOPIC = "/arm/task"
# Three seconds of a task: time to say something meanwhile.
STEPS = 150


class Somebody:
    """A node that says tasks, and hears what becomes of them."""

    def __init__(self):
        from fluxvla_core.ros2 import Connection, message_class, qos

        self.string = message_class("std_msgs.msg:String")
        self.connection = Connection("somebody")
        self.said = self.connection.publisher(TOPIC, self.string, depth=10)
        self.heard = []
        self.connection.node.create_subscription(
            self.string,
            f"{TOPIC}/status",
            lambda message: self.heard.append(message.data),
            qos.profile(qos.RELIABLE, 10, latched=True),
        )

    def say(self, text):
        until = time.monotonic() + 20
        while not self.said.get_subscription_count():
            assert time.monotonic() < until, "nobody listens"
            time.sleep(0.02)
        self.said.publish(self.string(data=text))

    def hears(self, text):
        until = time.monotonic() + 20
        while not any(text in heard for heard in self.heard):
            assert time.monotonic() < until, f"never heard {text!r}, but {self.heard}"
            time.sleep(0.02)


@pytest.fixture
def somebody(ros_domain):
    made = Somebody()
    yield made
    made.connection.close()


def test_tasks_that_are_said_are_done(somebody, bench, make_arm):
    bench.arm = make_arm(realtime=True)
    runner = bench.runner(task=None, task_topic=TOPIC, max_publish_step=STEPS)
    runner.run_setup()
    ended = []

    def person():
        try:
            # What is said before that is refused.
            somebody.hears(f"waiting for a task on {TOPIC}")
            somebody.say("3")
            somebody.hears("unknown task '3'; nothing was moved")
            somebody.say("lift teh red cube")
            somebody.hears("nothing was moved; the nearest is 2: 'lift the red cube'")
            ended.append(len(bench.arm.sent))
            somebody.say("2")
            while not bench.arm.sent:
                time.sleep(0.01)
            somebody.say("stir the soup")
            somebody.hears(f"2: max_steps, no success, {STEPS} commands")
            somebody.hears("refused, the robot was busy: stir the soup")
            somebody.say("wave at the camera")
            while bench.policy.asked[-1]["task_description"] != "wave at the camera":
                time.sleep(0.01)
        except BaseException:
            _thread.interrupt_main()
            raise
        finally:
            bench.arm.faults["send_action"] = OSError("that is enough")

    thread = threading.Thread(target=person)
    thread.start()
    with pytest.raises(Exception, match="that is enough"):
        runner.run()
    thread.join()
    somebody.hears("1: failed: ")

    assert ended == [0], "an unknown task moves nothing"
    instructions = [asked["task_description"] for asked in bench.policy.asked]
    assert list(dict.fromkeys(instructions)) == ["lift the red cube", "wave at the camera"]
    assert bench.arm.calls[-1] == "close"


def test_of_two_tasks_at_once_the_newer_is_done(somebody):
    said = []
    topic = TopicTasks(TOPIC, said.append)
    topic.open()
    try:
        topic.ask()
        assert topic.poll() is None
        somebody.say("1")
        somebody.say(" 2 ")
        until = time.monotonic() + 20
        while len(topic._heard) < 2:
            assert time.monotonic() < until
            time.sleep(0.02)
        assert topic.poll() == "2"
        assert said == [f"waiting for a task on {TOPIC}", "refused, a newer task came: 1"]
        somebody.hears("refused, a newer task came: 1")
    finally:
        topic.close()
    topic.close()


def test_without_ros_the_run_says_so_before_the_robot_is_connected(bench, monkeypatch):
    def missing():
        raise LoadFailed("ROS 2 cannot be used: importing rclpy fails (not here)")

    monkeypatch.setattr("fluxvla_core.ros2.connection.require_rclpy", missing)

    with pytest.raises(LoadFailed, match="ROS 2 cannot be used"):
        bench.run(task=None, task_topic=TOPIC)
    assert "connect" not in bench.arm.calls


def test_a_task_of_the_command_line_comes_first(bench):
    assert bench.run(task="2", task_topic=TOPIC, max_publish_step=5)["task"] == "2"
    with pytest.raises(UsageError, match="unknown task '9'"):
        bench.run(task="9", task_topic=TOPIC)
