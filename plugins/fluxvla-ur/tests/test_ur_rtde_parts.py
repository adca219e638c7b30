"""URRTDEOperator divided: what its part with the commands does, and its part with the cameras."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest
from fluxvla_ur.embodiment import ACCELERATION
from fluxvla_ur.rtde import URRTDEOperator

from fluxvla_core.errors import Faulted, NotReady, Rejected

from .fake_ur import FakeUR
from .rtde_robot import PATIENT, POSE, connect, robot, wait_for

__all__ = ["connect", "robot"]

client = pytest.importorskip("rtde_control", reason="pip install ur-rtde")
pytestmark = pytest.mark.network


class TestParts:
    """One robot in two processes; here two operators, each with connections of its own."""

    @pytest.fixture
    def part(self):
        made = []

        def make(fake, divide, **arguments):
            operator = getattr(URRTDEOperator(fake.ip, **{**PATIENT, **arguments}), divide)()
            made.append(operator)
            operator.connect()
            return operator

        yield make
        for operator in made:
            operator.close()

    def test_what_one_part_commands_the_other_sees(self, robot, part):
        cameras = part(robot, "without_commands")
        control = part(robot, "without_cameras")
        np.testing.assert_allclose(control.get_state(), cameras.get_state())
        target = POSE.copy()
        target[0], target[6] = 0.1, 0.25
        control.send_action(target)

        wait_for(lambda: np.allclose(cameras.get_frame().state, target, atol=0.003))
        assert time.monotonic() - cameras.state_stamp() < PATIENT["max_age_s"]
        with pytest.raises(NotReady, match="this part of ur5e has no cameras, and so no frames"):
            control.get_frame()

    def test_the_part_without_commands_leaves_the_controller_alone(self, robot, part):
        cameras = part(robot, "without_commands", max_age_s=0.5)
        found = robot.ask()
        assert (found["running"], found["watchdog_hz"], found["gripper"]) == (False, 0.0, [])

        robot.tell(slack_s=0.0)
        time.sleep(1.0)
        with pytest.raises(Rejected, match="this part of ur5e sends no commands"):
            cameras.send_action(POSE)
        assert cameras.last_action is None
        cameras.stop()
        cameras.close()
        cameras.stop()
        with pytest.raises(NotReady, match="is not connected"):
            cameras.get_state()
        assert robot.ask() == found

    def test_closing_the_part_without_commands_leaves_the_other_one_its_script(self, robot, part):
        cameras = part(robot, "without_commands")
        control = part(robot, "without_cameras")
        control.send_action(POSE)
        wait_for(lambda: robot.ask()["servo"])
        cameras.close()

        found = robot.ask()
        assert (found["running"], found["stops"], found["ended"]) == (True, [], "")
        control.send_action(POSE)
        control.close()
        assert robot.ask()["stops"] == [ACCELERATION]

    def test_a_stop_of_the_robot_does_not_end_the_reading(self, part):
        with FakeUR(safety_mode=3) as robot:
            assert part(robot, "without_commands").get_state().shape == (7,)
            with pytest.raises(Faulted, match="the robot is in protective stop"):
                part(robot, "without_cameras")

    def test_the_part_without_cameras_opens_none(self, robot, part):
        cameras = {"top": "/nowhere.avi"}
        control = part(robot, "without_cameras", cameras=cameras, height=48, width=64)
        assert control.embodiment.camera_names == ("top",)
        assert control.get_state().shape == (7,)

        pytest.importorskip("cv2")
        with pytest.raises(NotReady, match=r"camera top \(/nowhere\.avi\) cannot be opened"):
            part(robot, "without_commands", cameras=cameras, height=48, width=64)

    def test_the_gripper_is_activated_by_the_part_that_moves_it(self, part):
        with FakeUR(gripper_status=0) as robot:
            for divide in ("without_commands", "without_cameras"):
                with pytest.raises(NotReady, match="the gripper is not activated"):
                    part(robot, divide)
            assert robot.ask()["gripper"] == []
            read = []
            reader = threading.Thread(
                target=lambda: read.append(
                    part(robot, "without_commands", activate_gripper=True).get_state()
                )
            )
            reader.start()
            time.sleep(0.5)
            assert robot.ask()["gripper"] == []
            part(robot, "without_cameras", activate_gripper=True)
            reader.join(20.0)

            assert read[0][6] == 1.0
            asked = robot.ask()["gripper"]
            assert asked == ["SET ACT 1", "SET GTO 1 SPE 255 FOR 128"]

    def test_an_arm_without_a_gripper_is_not_divided(self):
        """Its gripper's number is the last command, which only one of the parts would know."""
        operator = URRTDEOperator("192.168.0.9", gripper=False)

        assert operator.without_cameras() is None
        assert operator.without_commands() is None

    def test_an_operator_is_one_part_for_good(self, robot, connect):
        operator = URRTDEOperator("192.168.0.9").without_commands()
        with pytest.raises(Rejected, match="it is the part without commands already"):
            operator.without_cameras()
        with pytest.raises(Rejected, match="it is connected already"):
            connect(robot).without_cameras()
