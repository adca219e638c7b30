"""A connected ROS 2 operator: commands, stops, and a driver that falls ill; in two processes."""

from __future__ import annotations

import re
import threading
import time

import numpy as np
import pytest

from fluxvla_core.errors import Faulted, NotReady, Rejected
from fluxvla_core.ros2 import JOINT_STATE, BadMessage, Stale, StreamSpec, joints
from tests.ros2.arm import (
    CAMERA,
    COMMANDS,
    NAMES,
    STATE,
    Arm,
    frame_error,
    frames_of,
    rejection_of,
    wait_for,
)

SECOND = {**STATE, "topic": "/second/state"}


class TwoArms(Arm):
    """The state of one joint comes from a driver of its own."""

    def streams(self):
        return [*super().streams(), StreamSpec("second", "/second/state", JOINT_STATE)]

    def read_state(self, messages):
        other = joints.positions(messages["second"], NAMES[2:], "second (/second/state)")
        return np.append(super().read_state(messages)[:2], other)


@pytest.fixture(scope="module")
def lasting_robot(lasting_drivers):
    return lasting_drivers([STATE, SECOND, CAMERA], [COMMANDS], name="robot")


def settled(robot):
    """The last test's operator held its arm when it was closed; that too has arrived."""
    before, looks, until = len(robot.heard), 0, time.monotonic() + 30.0
    # Several looks: a machine that stands still delays commands too, and the time of one look.
    while looks < 10:
        time.sleep(0.03)
        looks = looks + 1 if len(robot.heard) == before else 0
        before = len(robot.heard)
        assert looks or time.monotonic() < until, f"commands still arrive: {before} by now"


def commanded(arm, robot, action):
    """Send a command, and wait until it is there: one that a newer overtakes never arrives."""
    arm.send_action(action)
    wait_for(lambda: robot.on("/arm/command"))


@pytest.fixture
def robot(lasting_robot):
    """A robot that is well, and has heard nothing yet."""
    lasting_robot.tell(reset=True)
    settled(lasting_robot)
    lasting_robot.heard.clear()
    yield lasting_robot
    lasting_robot.tell(reset=True)


@pytest.fixture
def arm(operators, robot):
    operator = operators()
    operator.connect()
    return operator


def test_a_frame_has_state_by_name_images_and_receipt_stamps(arm):
    frame = arm.get_frame()

    np.testing.assert_array_equal(frame.state, [0.1, 0.2, 0.5])
    assert frame.images["cam"].shape == (48, 64, 3)
    assert (frame.images["cam"] == [10, 20, 30]).all()
    assert set(frame.stamps) == {"state", "cam"}
    assert all(0 <= time.monotonic() - stamp < 1.0 for stamp in frame.stamps.values())


def test_images_that_nobody_looked_at_can_be_had(arm):
    images, received = arm.images_after("cam", 0.0)
    assert received >= len(images) > 0
    assert all(image.shape == (48, 64, 3) for _, image in images)
    newest = max(stamp for stamp, _ in images)

    wait_for(lambda: arm.images_after("cam", newest)[0])

    assert min(stamp for stamp, _ in arm.images_after("cam", newest)[0]) > newest
    assert arm.images_after("elsewhere", 0.0) == ([], 0)
    arm.close()
    assert arm.images_after("cam", 0.0) == ([], 0)


def test_the_state_alone(arm):
    np.testing.assert_array_equal(arm.get_state(), [0.1, 0.2, 0.5])


def test_connecting_twice_is_connecting_once(arm):
    before = threading.active_count()
    arm.connect()

    assert threading.active_count() == before


def test_it_can_be_closed_and_connected_again(arm):
    arm.close()
    arm.connect()

    assert arm.get_frame().state.shape == (3,)


def test_the_wrong_domain_is_named(operators, robot, other_domain):
    operator = operators(domain_id=other_domain, connect_timeout_s=0.3)

    with pytest.raises(NotReady, match=f"nobody publishes anything on ROS domain {other_domain}"):
        operator.connect()


class TestCommanding:
    def test_commands_arrive_by_name(self, arm, robot):
        arm.send_action(np.array([0.5, -0.5, 1.0]))
        wait_for(lambda: robot.on("/arm/command"))

        (heard,) = robot.on("/arm/command")
        assert dict(zip(heard["name"], heard["position"], strict=True)) == {
            "elbow": 0.5,
            "wrist": -0.5,
            "grip": 1.0,
        }

    def test_a_refused_action_sends_nothing(self, arm, robot):
        for bad in ([np.nan, 0, 0], [0, 0], [5.0, 0, 0]):
            with pytest.raises(Rejected):
                arm.send_action(bad)
        time.sleep(0.2)

        assert robot.on("/arm/command") == []

    def test_stop_repeats_the_last_command(self, arm, robot):
        commanded(arm, robot, [0.15, 0.1, 0.3])
        arm.stop()
        wait_for(lambda: len(robot.on("/arm/command")) == 2)

        assert [h["position"] for h in robot.on("/arm/command")] == [[0.15, 0.1, 0.3]] * 2

    def test_stop_leaves_an_arm_alone_that_was_never_commanded(self, arm, robot):
        arm.stop()
        arm.close()
        time.sleep(0.2)

        assert robot.on("/arm/command") == []

    def test_stop_leads_a_blocked_joint_to_where_it_is_within_its_limits(self, arm, robot):
        commanded(arm, robot, [0.3, 0.2, 0.0])
        arm.stop()
        settled(robot)

        path = np.array([h["position"] for h in robot.on("/arm/command")])
        np.testing.assert_array_equal(path[-1], [0.1, 0.2, 0.0])
        speed = np.diff(np.vstack([path[0], path, path[-1]]), axis=0) * 50
        assert np.abs(speed).max() <= 1.0
        assert np.abs(np.diff(speed, axis=0)).max() * 50 <= 1.0
        np.testing.assert_array_equal(arm.last_action, [0.1, 0.2, 0.0])

    def test_a_new_command_ends_the_way_of_a_stop(self, arm, robot):
        commanded(arm, robot, [0.9, 0.2, 0.0])
        stopping = threading.Thread(target=arm.stop)
        stopping.start()
        wait_for(lambda: len(robot.on("/arm/command")) >= 5)
        arm.send_action([0.5, 0.2, 0.0])
        stopping.join(10.0)
        settled(robot)

        assert robot.on("/arm/command")[-1]["position"] == [0.5, 0.2, 0.0]

    def test_stop_holds_the_last_command_when_the_state_is_gone(self, arm, robot):
        commanded(arm, robot, [0.9, 0.2, 0.0])
        robot.tell(fault="/arm/state=drop")
        frame_error(arm, "arm (/arm/state) is silent")
        arm.stop()
        wait_for(lambda: len(robot.on("/arm/command")) == 2)

        assert robot.on("/arm/command")[-1]["position"] == [0.9, 0.2, 0.0]

    def test_the_hold_of_close_arrives(self, arm, robot):
        commanded(arm, robot, [0.15, 0.1, 0.3])
        arm.close()
        wait_for(lambda: len(robot.on("/arm/command")) == 2)

        with pytest.raises(NotReady, match="arm is not connected"):
            arm.send_action([0.0, 0.0, 0.0])

    def test_a_later_stop_sends_the_arm_nothing(self, arm, robot):
        """Somebody may have moved it since: it would be thrown back in one step."""
        commanded(arm, robot, [0.15, 0.1, 0.3])
        arm.stop()
        wait_for(lambda: len(robot.on("/arm/command")) == 2)
        robot.tell(change={"/arm/state": {"positions": [0.5, 9.0, 0.25, 0.2]}})
        wait_for(lambda: arm.get_state()[0] == 0.25)
        arm.stop()
        arm.close()
        settled(robot)

        assert [h["position"] for h in robot.on("/arm/command")] == [[0.15, 0.1, 0.3]] * 2

    def test_an_arm_that_was_commanded_again_is_held_again(self, arm, robot):
        for count in (1, 3):
            arm.send_action([0.15, 0.1, 0.3])
            wait_for(lambda n=count: len(robot.on("/arm/command")) == n)
            arm.stop()
            wait_for(lambda n=count: len(robot.on("/arm/command")) == n + 1)

    def test_no_stop_commands_an_arm_that_another_node_commands(self, arm, robot, drivers):
        commanded(arm, robot, [0.15, 0.1, 0.3])
        teleop = drivers([{**STATE, "topic": "/arm/command"}], name="teleop")
        wait_for(lambda: arm._fault)
        arm.stop()
        teleop.close()
        wait_for(lambda: not arm._fault)
        arm.stop()
        arm.close()
        settled(robot)

        ours = [h for h in robot.on("/arm/command") if tuple(h["name"]) == NAMES]
        assert [h["position"] for h in ours] == [[0.15, 0.1, 0.3]]
        assert arm.last_action is None

    def test_what_fails_while_stopping_is_logged_and_the_rest_is_done(self, arm, caplog):
        done = []
        arm.send_action([0.1, 0.2, 0.5])
        arm.publish_action = lambda action: 1 / 0
        arm.on_stop = lambda: done.append("base")
        arm.stop()

        assert done == ["base"]
        assert "arm: stopping failed: division by zero" in caplog.text

    def test_a_publisher_that_breaks_is_a_fault(self, arm):
        arm._publishers["/arm/command"].destroy()

        with pytest.raises(Faulted, match="a command on /arm/command could not be sent"):
            arm.send_action([0.1, 0.2, 0.5])

    def test_another_commander_is_refused_at_the_start(self, operators, robot, drivers):
        drivers([{**STATE, "topic": "/arm/command"}], name="teleop")

        # DDS may tell of a publisher before it tells whose it is.
        wait_for(lambda: "/teleop_" in rejection_of(operators).what)

    def test_another_commander_stops_the_commands_and_its_leaving_frees_them(self, arm, drivers):
        arm.send_action([0.1, 0.2, 0.5])
        teleop = drivers([{**STATE, "topic": "/arm/command"}], name="teleop")
        wait_for(lambda: arm._fault)
        with pytest.raises(Faulted, match="also publishes on /arm/command: two commanders"):
            arm.send_action([0.1, 0.2, 0.5])

        teleop.close()
        wait_for(lambda: not arm._fault)
        arm.send_action([0.1, 0.2, 0.5])


class TestFaults:
    @pytest.fixture
    def arm(self, operators, robot):
        """One that allows the half second of silence that a robot's operator does."""
        operator = operators(max_age_s=0.5)
        operator.connect()
        return operator

    def test_a_camera_that_falls_silent_is_named(self, arm, robot):
        robot.tell(fault="/cam/image=drop")
        error = frame_error(arm, "cam (/cam/image) is silent for ")

        assert error.what.endswith(" s; 0.5 s is allowed")
        assert (type(error), error.rule) == (Stale, "freshness")

    def test_reading_the_state_alone_notices_a_silent_camera_too(self, arm, robot):
        """The loop reads it after each command, and frames only when a policy is asked."""
        robot.tell(fault="/cam/image=drop")
        error = frame_error(arm, "cam (/cam/image) is silent", call=arm.get_state)

        assert isinstance(error, Stale)

    def test_a_camera_that_repeats_its_last_image_is_silent_too(self, arm, robot):
        robot.tell(fault="/cam/image=freeze")

        frame_error(arm, "cam (/cam/image) is silent for ")

    def test_joint_states_that_stop_are_named(self, arm, robot):
        robot.tell(fault="/arm/state=drop")

        frame_error(arm, "arm (/arm/state) is silent for ")

    @pytest.mark.parametrize(
        ("changes", "what"),
        [
            (
                {"/cam/image": {"height": 24, "width": 32}},
                "cam (/cam/image) sends 32x24 images, the embodiment says 64x48",
            ),
            (
                {"/cam/image": {"encoding": "16UC1"}},
                "cam (/cam/image) sends 16UC1 images, which have no colours",
            ),
            (
                {"/cam/image": {"encoding": "mono8"}},
                "cam (/cam/image) sends mono8 images, which have no colours",
            ),
            (
                {"/arm/state": {"names": ["elbow", "wrist"], "positions": [0.1, 0.2]}},
                "arm (/arm/state): no joint called grip; there are elbow, wrist",
            ),
        ],
    )
    def test_messages_that_change_are_a_fault(self, arm, robot, changes, what):
        robot.tell(change=changes)
        error = frame_error(arm, what)

        assert (type(error), error.rule) == (BadMessage, "frame")

    def test_other_encodings_and_orders_are_understood(self, arm, robot):
        robot.tell(
            change={
                "/cam/image": {"encoding": "bgr8"},
                "/arm/state": {"names": list(NAMES), "positions": [0.1, 0.2, 0.5]},
            }
        )
        for frame in frames_of(arm):
            assert (frame.images["cam"] == [10, 20, 30]).all()
            np.testing.assert_array_equal(frame.state, [0.1, 0.2, 0.5])

    def test_a_state_that_is_no_number_is_a_fault(self, arm, robot):
        robot.tell(fault="/arm/state=nan")

        frame_error(arm, "the position of elbow, wrist, grip is not a finite number")

    @pytest.mark.parametrize("fault", ["duplicate", "out_of_order"])
    def test_repeated_and_overtaken_messages_change_nothing(self, arm, robot, fault):
        robot.tell(fault=f"/arm/state={fault}")
        robot.tell(fault=f"/cam/image={fault}")
        stamps = [frame.stamps for frame in frames_of(arm, 30)]

        for name in ("state", "cam"):
            times = [stamp[name] for stamp in stamps]
            assert times == sorted(times)
            assert times[-1] > times[0]
        rings = [stream.ring for stream in arm._connection.streams.values()]
        assert all(ring.duplicates + ring.overtaken > 0 for ring in rings)

    def test_a_late_camera_is_named(self, arm, robot):
        """Not only its images are old then, but the state that belongs to them."""
        robot.tell(fault="/cam/image=delay:0.7")
        time.sleep(0.8)
        error = frame_error(arm, "cam is late: what belongs to its newest message arrived 0.")

        assert (type(error), error.rule) == (Stale, "freshness")

    @pytest.mark.parametrize("step", [-3600.0, 3600.0])
    def test_a_stepped_wall_clock_changes_nothing(self, arm, robot, step):
        robot.tell(fault=f"/cam/image=clock:{step}")
        robot.tell(fault=f"/arm/state=clock:{step}")

        frames_of(arm)
        wait_for(lambda: arm._connection.streams["cam"].ring.clock_steps)
        frames_of(arm)

        assert arm._connection.streams["cam"].ring.clock_steps == 1

    def test_clocks_that_differ_are_named_and_receipts_mend_it(self, arm, robot, operators):
        robot.tell(fault="/cam/image=clock:-100")
        error = frame_error(arm, "cam is 9")
        assert re.match(r"the clock that stamps cam is (99|100)\.\d\d s behind this", error.cause)
        arm.close()

        forgiving = operators(sync_on="receipt")
        forgiving.connect()
        assert frames_of(forgiving)

    def test_two_arms_whose_stamps_are_apart_are_no_one_reading(self, robot, ros_domain):
        two = TwoArms()
        try:
            two.connect()
            frames_of(two)
            robot.tell(fault="/second/state=clock:-0.2")
            error = frame_error(two, "second is stamped 0.")
            assert error.what.endswith(
                "earlier than arm, although they arrive together; at most 0.1 s is allowed"
            )
            assert error.cause.startswith("the clock that stamps second is 0.")
            assert (type(error), error.rule) == (Stale, "freshness")
            with pytest.raises(Stale, match="second is stamped"):
                two.get_state()
        finally:
            two.close()

    def test_a_flood_on_a_topic_changes_nothing(self, arm, drivers):
        flood = {**STATE, "hz": 2000, "names": [f"j{i}" for i in range(200)] + list(NAMES)}
        drivers([{**flood, "positions": [0.0] * 200 + [0.1, 0.2, 0.5]}], name="flood")
        wait_for(lambda: arm._connection.streams["arm"].ring.received > 1000)

        frames_of(arm)
        assert len(arm._connection.streams["arm"].ring.items()) <= 128

    def test_a_ros_thread_that_ended_is_a_fault(self, arm):
        def fail():
            raise RuntimeError("broken")

        arm._connection.every(0.01, fail)
        wait_for(lambda: arm._connection.failure)

        for call in (arm.get_frame, lambda: arm.send_action([0.1, 0.2, 0.5])):
            with pytest.raises(Faulted, match="the ROS thread of fluxvla_arm_"):
                call()


def test_a_second_connection_to_the_same_robot_is_refused(arm, operators):
    assert "/fluxvla_arm_" in rejection_of(operators).what
