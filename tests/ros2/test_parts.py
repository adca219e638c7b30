"""One robot in two processes: one part commands and has no cameras, the other reads only."""

from __future__ import annotations

import time

import numpy as np
import pytest

from fluxvla_core.errors import NotReady, Rejected
from fluxvla_core.operators import Part
from fluxvla_core.ros2 import IMAGE, JOINT_STATE, Stale
from fluxvla_core.ros2.connection import WATCH_S
from tests.ros2.arm import CAMERA, COMMANDS, STATE, Arm, wait_for

TARGET = np.array([0.3, -0.2, 0.8])


class Wired(Arm):
    """Its constructor makes things that refer to it, and its hooks are counted."""

    def __init__(self, **settings):
        super().__init__(**settings)
        self.called = []
        self.wave = lambda: self.publish_action(TARGET)

    def on_connected(self, connection):
        self.called.append("on_connected")

    def on_stop(self):
        self.called.append("on_stop")

    def check_command(self, action):
        self.called.append("check_command")


@pytest.fixture
def robot(drivers):
    follows = {**STATE, "follows": COMMANDS["topic"]}
    return drivers([follows, CAMERA], [COMMANDS], name="robot")


@pytest.fixture
def parts(ros_domain):
    """Makes both parts of a robot, each of an operator of its own as in two processes."""
    made = []

    def make(kind=Wired, **settings):
        both = kind(**settings).without_cameras(), kind(**settings).without_commands()
        made.extend(both)
        return both

    yield make
    for part in made:
        part.close()


@pytest.fixture
def both(parts, robot):
    """Both, connected, and patient with a busy machine."""
    control, cameras = parts(max_age_s=2.0)
    cameras.connect()
    control.connect()
    return control, cameras


def says_silent(part, what):
    """Whether the part's state is refused because of a stream, ``what``, that fell silent."""
    try:
        part.get_state()
    except Stale as error:
        return f"{what} is silent for" in error.what
    return False


def heard(robot):
    return robot.on(COMMANDS["topic"])


def test_both_parts_read_the_same_state_and_one_of_them_the_images(both):
    control, cameras = both
    frame = cameras.get_frame()

    np.testing.assert_array_equal(frame.state, [0.1, 0.2, 0.5])
    assert frame.images["cam"].shape == (48, 64, 3)
    np.testing.assert_array_equal(control.get_state(), cameras.get_state())
    assert cameras.images_after("cam", 0.0)[1] > 0
    assert time.monotonic() - control.state_stamp() < 2.0

    assert set(control._connection.streams) == {"arm"}
    assert control.images_after("cam", 0.0) == ([], 0)
    assert control.newest("cam") is None
    assert control.history("cam") == ()
    with pytest.raises(NotReady, match="this part of arm has no cameras, and so no frames"):
        control.get_frame()


def test_the_graph_shows_which_node_is_which_and_that_one_publishes_nothing(both):
    control, cameras = (part._connection for part in both)

    assert control.name.startswith("fluxvla_arm_control_")
    assert cameras.name.startswith("fluxvla_arm_cameras_")
    topics = [name for name, _ in control.node.get_topic_names_and_types()]
    publishers = {
        topic: [p.node_name for p in control.node.get_publishers_info_by_topic(topic)]
        for topic in topics
    }
    assert publishers[COMMANDS["topic"]] == [control.name]
    assert [topic for topic in topics if cameras.name in publishers[topic]] in (
        [],
        ["/parameter_events"],
    )


def test_what_one_part_commands_the_other_sees_and_neither_is_another_commander(both, robot):
    control, cameras = both
    control.send_action(TARGET)
    wait_for(lambda: np.array_equal(cameras.get_state(), TARGET))
    # A frame's state is that of its images, which come less often.
    wait_for(lambda: np.array_equal(cameras.get_frame().state, TARGET))

    time.sleep(3 * WATCH_S)
    control.send_action(TARGET)
    np.testing.assert_array_equal(control.last_action, TARGET)
    assert cameras.last_action is None


def test_the_part_without_commands_sends_nothing_and_its_hooks_are_not_called(both, robot):
    control, cameras = both
    control.send_action(TARGET)
    wait_for(lambda: heard(robot))
    before = len(heard(robot))

    for send in (lambda: cameras.send_action(TARGET), cameras.wave):
        with pytest.raises(Rejected, match="this part of arm sends no commands") as refused:
            send()
        assert refused.value.next == "call send_action() of the part without cameras"
    cameras.stop()
    cameras.close()
    cameras.stop()
    time.sleep(2 * WATCH_S)

    assert len(heard(robot)) == before
    assert cameras.called == []
    np.testing.assert_array_equal(control.last_action, TARGET)
    control.wave()
    control.close()
    wait_for(lambda: len(heard(robot)) > before)
    assert control.called == ["on_connected", "check_command", "on_stop"]


def test_a_camera_that_falls_silent_is_noticed_where_it_is_read(both, robot):
    control, cameras = both
    robot.tell(fault=f"{CAMERA['topic']}=drop")
    wait_for(lambda: says_silent(cameras, "cam (/cam/image)"))

    control.send_action(TARGET)
    wait_for(lambda: np.array_equal(control.get_state(), TARGET))


def test_joint_states_that_fall_silent_are_noticed_in_both(both, robot):
    robot.tell(fault=f"{STATE['topic']}=drop")

    for part in both:
        wait_for(lambda part=part: says_silent(part, "arm (/arm/state)"))


def test_the_part_without_cameras_needs_no_camera_and_no_image_type(parts, drivers, monkeypatch):
    from fluxvla_core.ros2 import startup as module

    asked, import_it = [], module.message_class
    monkeypatch.setattr(module, "message_class", lambda t: asked.append(t) or import_it(t))
    drivers([STATE], [COMMANDS])
    control, cameras = parts(connect_timeout_s=2.0)
    control.connect()

    assert set(asked) == {JOINT_STATE}
    with pytest.raises(NotReady, match=r"no publisher on /cam/image"):
        cameras.connect()
    assert IMAGE in asked


def test_the_part_without_commands_needs_no_listener_and_minds_no_commander(parts, drivers):
    drivers([STATE, CAMERA, {**STATE, "topic": COMMANDS["topic"]}])
    control, cameras = parts(connect_timeout_s=2.0, rate_window_s=0.5)
    cameras.connect()

    assert cameras.get_frame().state.shape == (3,)
    with pytest.raises((NotReady, Rejected), match=COMMANDS["topic"]):
        control.connect()


def test_an_operator_is_one_part_for_good():
    arm = Arm()
    control = arm.without_cameras()

    assert control is arm.without_cameras()
    with pytest.raises(Rejected, match="arm cannot become the part without commands: it is the p"):
        arm.without_commands()


def test_a_connected_operator_is_not_divided(operators, robot):
    operator = operators()
    operator.connect()

    for divide in (operator.without_cameras, operator.without_commands):
        with pytest.raises(Rejected, match="it is connected already"):
            divide()


@pytest.mark.parametrize("part", Part)
def test_a_part_does_what_it_has_and_refuses_the_rest(part):
    for has, check, error in (
        (part.cameras, part.check_cameras, NotReady),
        (part.commands, part.check_commands, Rejected),
    ):
        if has:
            check("arm")
        else:
            with pytest.raises(error, match="this part of arm"):
                check("arm")


def test_deprecated_names_still_work():
    with pytest.warns(DeprecationWarning, match="Old.admit is deprecated, name it check_command"):

        class Old(Wired):
            def admit(self, action):
                checked.append(action)

    arm, checked = Old(), []
    arm.check_command(TARGET)
    assert checked == [TARGET]
    with pytest.warns(DeprecationWarning, match="use history"):
        assert arm.kept("cam") == arm.history("cam") == ()
    with pytest.warns(DeprecationWarning, match="use images_after"):
        assert arm.pictures_after("cam", 0.0) == arm.images_after("cam", 0.0) == ([], 0)
    with pytest.warns(DeprecationWarning, match="Older.pictures_after is deprecated, name it ima"):

        class Older(Wired):
            def pictures_after(self, camera, after):
                return super().pictures_after(camera, after)[0], 3

    with pytest.warns(DeprecationWarning, match="use images_after"):
        assert Older().images_after("cam", 0.0) == ([], 3)
