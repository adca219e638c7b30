"""URRTDEOperator: ``ur-rtde``'s own client against a fake controller on loopback."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from contextlib import contextmanager

import numpy as np
import pytest
from fluxvla_ur.embodiment import ACCELERATION, ur_spec
from fluxvla_ur.rtde import URRTDEOperator
from fluxvla_ur.runner import URInferenceRunner
from fluxvla_ur.video import VideoCamera

from fluxvla_core.errors import ConfigError, Faulted, LoadFailed, NotReady
from fluxvla_core.operators import Camera, RunContext
from fluxvla_core.ros2 import BadMessage, Stale
from fluxvla_core.testing import OperatorConformance

from .fake_ur import FakeUR
from .rtde_robot import PATIENT, POSE, connect, robot, said, wait_for

__all__ = ["connect", "robot"]

# Where the watchdog is to end the program: for a machine that stalls for a second.
SLACK_S = 1.5

client = pytest.importorskip("rtde_control", reason="pip install ur-rtde")
pytestmark = pytest.mark.network


class TestConfig:
    def test_the_embodiment_is_the_models(self):
        operator = URRTDEOperator("192.168.0.9", "ur10e", 125.0, {"top": 0}, 96, 128)

        assert operator.embodiment == ur_spec("ur10e", [Camera("top", 96, 128)], 125.0)

    @pytest.mark.parametrize(
        ("arguments", "what"),
        [
            ({"model": "ur99"}, "unknown UR model 'ur99'"),
            ({"lookahead_time": 0.5}, "lookahead_time is from 0.03 to 0.2, got 0.5"),
            ({"gain": 50}, "gain is from 100 to 2000, got 50"),
            ({"watchdog_hz": 0}, "watchdog_hz is from 1 to 100, got 0"),
            ({"publish_rate": 0}, "URRTDEOperator: rate_hz must be positive, got 0"),
        ],
    )
    def test_values_out_of_range_are_named(self, arguments, what):
        with pytest.raises(ConfigError, match=what):
            URRTDEOperator("192.168.0.9", **arguments)


class TestConnecting:
    def test_nobody_there(self):
        with pytest.raises(
            NotReady, match=r"no UR controller can be used at 127\.99\.9\.9: "
        ) as hit:
            URRTDEOperator("127.99.9.9", connect_timeout_s=0.5).connect()
        assert "Remote Control" in hit.value.next

    def test_without_the_client_the_message_says_how_to_get_it(self, monkeypatch):
        monkeypatch.setitem(sys.modules, "rtde_control", None)
        with pytest.raises(LoadFailed, match="needs ur-rtde, which cannot be imported") as hit:
            URRTDEOperator("127.99.9.9").connect()
        assert hit.value.next == "pip install 'fluxvla-ur[rtde]'"

    def test_a_stopped_robot_is_named_and_left_alone(self, connect):
        with FakeUR(safety_mode=7) as robot:
            with pytest.raises(Faulted, match="the robot is in robot emergency stop"):
                connect(robot)
            assert not robot.ask()["running"]

    def test_a_robot_that_is_in_local_control(self, connect):
        with (
            FakeUR(remote=False) as robot,
            pytest.raises(NotReady, match="no UR controller can be"),
        ):
            connect(robot)

    def test_a_gripper_that_is_not_activated_is_not_moved_by_surprise(self, connect):
        with FakeUR(gripper_status=0) as robot:
            with pytest.raises(NotReady, match="the gripper is not activated") as hit:
                connect(robot)
            assert "--set <URRTDEOperator>.activate_gripper=true" in hit.value.next
            assert robot.ask()["gripper"] == []
            connect(robot, activate_gripper=True)
            assert robot.ask()["gripper"][0] == "SET ACT 1"

    def test_a_gripper_that_does_not_answer(self, robot, connect):
        with pytest.raises(NotReady, match="no gripper answers on 127") as hit:
            connect(robot, gripper_port=9, connect_timeout_s=2.0)
        assert "--set <URRTDEOperator>.gripper=false" in hit.value.next
        operator = connect(robot, gripper_port=9, gripper=False)
        assert operator.get_state()[6] == 1.0


class TestDriving:
    def test_servoj_has_the_documented_parameters_and_the_gripper_its_raw_range(
        self, robot, connect
    ):
        operator = connect(robot, publish_rate=50.0, lookahead_time=0.05, gain=500.0)
        np.testing.assert_allclose(operator.get_frame().state, POSE)
        target = POSE.copy()
        for step in range(1, 11):
            target[0], target[6] = 0.01 * step, 0.25
            operator.send_action(target)
            time.sleep(0.02)
        wait_for(lambda: np.allclose(operator.get_state(), target, atol=0.003))

        found = robot.ask()
        _, q, seconds, lookahead, gain = found["servo"][-1]
        np.testing.assert_allclose(q, target[:6])
        assert (seconds, lookahead, gain) == (0.02, 0.05, 500.0)
        assert found["gripper"] == ["SET GTO 1 SPE 255 FOR 128", "SET GTO 1 POS 191"]
        assert found["watchdog_hz"] == 1.0

    def test_a_stop_decelerates_within_the_limit_and_holds(self, robot, connect):
        operator = connect(robot)
        operator.stop()
        assert robot.ask()["stops"] == []
        operator.send_action(POSE)
        operator.stop()
        operator.stop()
        wait_for(lambda: robot.ask()["stops"])

        assert robot.ask()["stops"] == [ACCELERATION]
        wait_for(lambda: "SET GTO 0" in robot.ask()["gripper"])
        operator.send_action(POSE)

    def test_a_robot_that_holds_for_long_is_still_listening(self, robot, connect):
        operator = connect(robot)
        robot.tell(slack_s=2.0)
        time.sleep(4.0)

        assert robot.ask()["running"]
        operator.send_action(POSE)

    def test_what_the_speed_slider_says(self, robot, connect):
        operator = connect(robot)
        robot.tell(target_speed_fraction=0.2)

        wait_for(lambda: operator.speed_scaling == pytest.approx(0.2))

    def test_after_a_stop_the_arm_is_held_where_it_came_to_rest(self, robot, connect):
        operator = connect(robot)
        assert operator.last_action is None
        told = POSE.copy()
        told[0] += 0.1
        operator.send_action(told)
        np.testing.assert_array_equal(operator.last_action, told)

        operator.stop()
        wait_for(lambda: robot.ask()["stops"])
        held, state = operator.last_action, operator.get_state()
        np.testing.assert_allclose(held[:6], state[:6], atol=1e-6)
        assert held[6] == told[6]


def commanded(operator):
    """Send a command; a reading may be late for a moment."""

    def sent():
        try:
            operator.send_action(POSE)
        except Stale:
            return False
        return True

    wait_for(sent)


@contextmanager
def driving(program, robot):
    """A program of its own, given the robot's address, once it has said that the arm moves; it is
    killed in the end."""
    command = [sys.executable, "-c", program, robot.ip]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as other:
        try:
            assert other.stdout.readline() == "moving\n"
            yield other
        finally:
            other.kill()


class TestFaults:
    """Each ends the commands; its name is what a person reads."""

    @pytest.mark.parametrize(
        ("facts", "what"),
        [
            ({"safety_mode": 3}, "the robot is in protective stop, and ignores commands"),
            ({"safety_mode": 5}, "the robot is in safeguard stop"),
            ({"safety_mode": 9}, "the robot is in fault"),
            ({"target_speed_fraction": 0.0}, "the robot is paused: its speed scaling is 0"),
            ({"gripper_fault": 8}, "the gripper reports fault 8"),
        ],
    )
    def test_what_the_robot_says_is_obeyed(self, robot, connect, facts, what):
        operator = connect(robot)
        operator.send_action(POSE)
        robot.tell(**facts)
        if "gripper_fault" in facts:
            wait_for(lambda: operator._gripper._problem is not None)
            with pytest.raises(Faulted, match=what):
                operator.get_state()
            return
        assert what in said(operator).what

    def test_a_controller_that_hangs_is_stale(self, robot, connect):
        operator = connect(robot, max_age_s=0.5)
        robot.tell(frozen=True)
        wait_for(lambda: time.monotonic() - operator._newest.receipt > 0.5)

        with pytest.raises(Stale, match=r"controller is silent for \d\.\d\d s; 0.5 s is allowed"):
            operator.get_state()

    def test_a_controller_that_hangs_does_not_keep_the_program(self, robot, connect, caplog):
        operator = connect(robot, max_age_s=0.5)
        commanded(operator)
        wait_for(lambda: robot.ask()["servo"])
        robot.tell(frozen=True)
        wait_for(operator._silent)

        def end():
            operator.stop()
            operator.stop()
            operator.close()

        ending = threading.Thread(target=end, daemon=True)
        ending.start()
        # Without a bound the client waits for ever, and with one in each of its calls 8 s. Silence
        # that is known takes under a second; 7 s are for a machine that is busy.
        ending.join(7.0)
        assert not ending.is_alive()
        assert [r.message for r in caplog.records if "does not answer" in r.message] == [
            f"{robot.ip}: the controller does not answer; its watchdog stops the arm"
        ]
        wait_for(lambda: robot.ask()["stops"])

    def test_an_arm_that_nobody_sees_is_left_to_the_controllers_watchdog(self, connect):
        with FakeUR(slack_s=SLACK_S) as robot:
            operator = connect(robot, max_age_s=0.5)
            commanded(operator)
            time.sleep(0.5 + SLACK_S + 1.0 / PATIENT["watchdog_hz"])
            assert robot.ask()["running"]
            robot.tell(frozen=True)
            wait_for(lambda: robot.ask()["ended"] == "watchdog")

    def test_a_controller_that_is_gone(self, robot):
        # In a program of its own: the client's threads still look for controllers of other tests,
        # and may crash the process in which they are.
        program = (
            "import sys, time\n"
            "from fluxvla_core.errors import Faulted\n"
            "from fluxvla_core.ros2 import Stale\n"
            "from fluxvla_ur.rtde import URRTDEOperator\n"
            f"operator = URRTDEOperator(sys.argv[1], **{PATIENT!r})\n"
            "operator.connect()\n"
            "pose = operator.get_state()\n"
            "try:\n"
            "    while True:\n"
            "        operator.send_action(pose)\n"
            "        print('moving', flush=True)\n"
            "        time.sleep(0.02)\n"
            "except (Stale, Faulted) as error:\n"
            "    print('refused:', error.what, flush=True)\n"
            "operator.stop()\n"
            "print('stopped', flush=True)\n"
            "time.sleep(60)\n"
        )
        with driving(program, robot) as other:
            robot.kill()
            # The client prints, too.
            refused = next((line for line in other.stdout if "refused: " in line), "nothing")
            assert "silent" in refused or "has ended" in refused
            assert any(line.endswith("stopped\n") for line in other.stdout)

    def test_the_controller_stops_the_arm_of_a_program_that_was_killed(self):
        robot = FakeUR(slack_s=SLACK_S)
        program = (
            "import sys, time\n"
            "from fluxvla_ur.rtde import URRTDEOperator\n"
            f"operator = URRTDEOperator(sys.argv[1], watchdog_hz={PATIENT['watchdog_hz']})\n"
            "operator.connect()\n"
            "state = operator.get_state()\n"
            "print('moving', flush=True)\n"
            "while True:\n"
            "    state[0] += 0.001\n"
            "    operator.send_action(state)\n"
            "    time.sleep(0.02)\n"
        )
        with driving(program, robot):
            wait_for(lambda: len(robot.ask()["servo"]) > 5)
            assert robot.ask()["running"]
        wait_for(lambda: not robot.ask()["running"])

        assert robot.ask()["ended"] == "watchdog"
        robot.close()


class Turner:
    """A policy that turns the base."""

    action_rate_hz, horizon = 10.0, 5

    def __init__(self, embodiment, robot, facts):
        self.embodiment, self.robot, self.facts = embodiment, robot, facts
        self.asked = 0

    def reset(self, seed):
        self.asked = 0

    def predict_action(self, observation):
        self.asked += 1
        if self.asked == 4:
            self.robot.tell(**self.facts)
        chunk = np.tile(observation["qpos"].astype(np.float64), (self.horizon, 1))
        chunk[:, 0] += 0.03 * np.arange(1, self.horizon + 1)
        return np.clip(chunk, -6.0, 1.0 + 6.0 * (np.arange(7) < 6))


def run(robot, tmp_path, facts):
    operator = URRTDEOperator(robot.ip, **PATIENT)
    runner = URInferenceRunner(
        policy=Turner(operator.embodiment, robot, facts),
        operator=operator,
        task_descriptions={"1": "turn"},
        prepare_pose=(0.05, *POSE[1:]),
        max_publish_step=60,
        safety={"max_age_s": 4.0, "max_skew_s": 2.0, "starvation_s": 20.0},
        context=RunContext(work_dir=tmp_path, task="1", section="inference"),
        record_fps=None,
    )
    runner.run_setup()
    return runner, runner.run


def test_the_runner_of_the_ros_operator_drives_this_one_too(robot, tmp_path):
    _, go = run(robot, tmp_path, {})

    assert go()["outcome"] == "max_steps"
    assert robot.ask()["q"][0] > 0.05


def test_a_protective_stop_ends_a_run_by_its_name(robot, tmp_path):
    runner, go = run(robot, tmp_path, {"safety_mode": 3})
    with pytest.raises(Faulted, match="the robot is in protective stop") as hit:
        go()

    assert hit.value.exit_code == 1
    assert runner.latch.tripped.rule == "operator"


class TestCameras:
    @pytest.fixture
    def film(self, tmp_path):
        cv2 = pytest.importorskip("cv2")
        path = tmp_path / "film.avi"
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 30, (64, 48))
        for _ in range(30):
            writer.write(np.full((48, 64, 3), (30, 20, 200), np.uint8))
        writer.release()
        return str(path)

    def test_images_are_rgb_and_a_camera_that_ends_is_silent(self, robot, connect, film):
        operator = connect(robot, cameras={"top": film}, height=48, width=64)
        image = operator.get_frame().images["top"]
        assert image.shape == (48, 64, 3)
        assert abs(image.mean(axis=(0, 1)) - [200, 20, 30]).max() < 8

        wait_for(lambda: time.monotonic() - operator._cameras[0].newest()[0] > 2.0)
        with pytest.raises(Stale, match=r"top is silent for \d"):
            operator.get_frame()

    def test_images_of_another_size_are_refused(self, film):
        camera = VideoCamera(Camera("top", 96, 128), film)
        camera.connect()
        wait_for(lambda: camera._newest)
        with pytest.raises(BadMessage, match=r"camera top gives \(48, 64, 3\) images, the emb"):
            camera.newest()
        camera.close()

    def test_a_camera_that_is_not_there_is_named(self):
        pytest.importorskip("cv2")
        with pytest.raises(NotReady, match=r"camera top \(/nowhere\.avi\) cannot be opened"):
            VideoCamera(Camera("top", 48, 64), "/nowhere.avi").connect()


class TestConformance(OperatorConformance):
    entry_point = "URRTDEOperator"
    heavy_modules = ("torch", "rclpy", "rtde_control", "rtde_receive", "cv2")

    @pytest.fixture(scope="class", autouse=True)
    @classmethod
    def robot(cls):
        with FakeUR() as fake:
            cls.arguments, cls.fake = {"robot_ip": fake.ip, **PATIENT}, fake
            yield fake

    def commands_heard(self, operator):
        heard = self.fake.ask()
        return len(heard["servo"]) + len(heard["stops"])
