"""The simulated robots as operators: the conformance kit, time, refusals, and the tasks."""

from __future__ import annotations

import subprocess
import sys
import threading
from typing import ClassVar

import numpy as np
import pytest
from fluxvla_aloha.embodiment import aloha_spec
from fluxvla_sim.aloha.arms import HOME, load_model
from fluxvla_sim.aloha.cube import AlohaScene, sample_cube
from fluxvla_sim.aloha.expert import Expert
from fluxvla_sim.aloha.world import ALOHA
from fluxvla_sim.operators import AlohaSimOperator, URSimOperator
from fluxvla_sim.ros2.operators import AlohaSimROSOperator
from fluxvla_sim.ur.expert import URExpert

from fluxvla_core.errors import ConfigError, Faulted, NotReady, Rejected
from fluxvla_core.spec import check_match
from fluxvla_core.testing import OperatorConformance

SMALL = {"height": 48, "width": 64}


class TestAlohaSimOperator(OperatorConformance):
    entry_point = "AlohaSimOperator"
    arguments: ClassVar = {"camera_names": ("top", "left_wrist"), **SMALL}
    heavy_modules = ("torch", "rclpy", "mujoco", "gymnasium", "cv2")


class TestAlohaSimOperatorInRealTime(OperatorConformance):
    entry_point = "AlohaSimOperator"
    arguments: ClassVar = {"realtime": True, **SMALL}


class TestURSimOperator(OperatorConformance):
    entry_point = "URSimOperator"
    arguments: ClassVar = {**SMALL}
    heavy_modules = ("torch", "rclpy", "mujoco", "gymnasium", "cv2")


@pytest.fixture
def aloha():
    operator = AlohaSimOperator(**SMALL)
    operator.connect()
    yield operator
    operator.close()


def test_a_simulation_that_diverges_is_a_fault_of_the_robot(aloha, tmp_path, monkeypatch):
    """MuJoCo resets itself: the arms would be at home in the next frame, as if nothing were."""
    monkeypatch.chdir(tmp_path)  # where MuJoCo leaves its log
    aloha.scene.data.qvel[:] = 1e12
    with pytest.raises(Faulted, match="the simulation diverged: MuJoCo warned of BADQVEL"):
        aloha.send_action(HOME)
    with pytest.raises(Faulted, match="the simulation diverged"):
        aloha.send_action(HOME)
    aloha.begin_episode("", 1)
    aloha.send_action(HOME)


@pytest.mark.parametrize("kind", [AlohaSimOperator, AlohaSimROSOperator])
def test_the_simulated_arms_are_known_and_no_others(kind):
    for operator in (kind(), kind(arms="viperx300")):
        assert operator.embodiment.joints == aloha_spec(arms="viperx300").joints
    with pytest.raises(ConfigError, match="has ViperX 300 arms, the config says arms='piper'"):
        kind(arms="piper")


def test_a_command_is_one_control_period(aloha):
    assert aloha.clock.now() == 0.0
    for step in range(1, 51):
        aloha.send_action(HOME)
        assert aloha.clock.now() == pytest.approx(step / 50)
    assert aloha.get_frame().stamps == {"state": aloha.clock.now(), "top": aloha.clock.now()}


@pytest.fixture
def live():
    operator = AlohaSimOperator(realtime=True, **SMALL)
    operator.connect()
    yield operator
    operator.close()


def test_in_real_time_the_world_goes_on_by_itself(live):
    assert not live.clock.lockstep
    target = HOME.copy()
    target[0] = 0.3
    before = live.get_state()
    live.send_action(target)
    threading.Event().wait(0.3)
    after = live.get_frame().state
    assert before[0] < 0.05
    assert after[0] > 0.1


def test_stop_holds_where_the_robot_is(live):
    target = HOME.copy()
    for target[0] in np.arange(0, 0.3, 0.02):
        live.send_action(target)
        threading.Event().wait(0.02)
    live.stop()
    stopped = live.get_state()[0]
    threading.Event().wait(0.3)
    assert stopped > 0.1
    assert live.get_state()[0] == pytest.approx(stopped, abs=0.06)


def test_a_later_stop_changes_nothing(live):
    target = HOME.copy()
    target[0] = 0.1
    live.send_action(target)
    live.stop()
    held = live._target.copy()
    threading.Event().wait(0.2)
    live.get_state()
    live.stop()
    np.testing.assert_array_equal(live._target, held)


def test_an_episode_begins_with_its_instructions_task_and_its_numbers_cube():
    aloha = AlohaSimOperator(seed=20, **SMALL)
    aloha.connect()
    np.testing.assert_array_equal(aloha._scene.cube, sample_cube(20))
    aloha.begin_episode("pick up the cube with the right arm and hold it", 1)
    assert aloha.task.name == "lift_hold"
    np.testing.assert_array_equal(aloha._scene.cube, sample_cube(21))
    aloha.begin_episode("dance", 2)
    assert aloha.task.name == "lift_hold", "an unknown instruction leaves the task"
    np.testing.assert_array_equal(aloha._scene.cube, sample_cube(22))
    aloha.close()


def test_the_state_alone_is_that_of_the_frame(aloha):
    aloha.send_action(HOME)
    np.testing.assert_array_equal(aloha.get_state(), aloha.get_frame().state)


@pytest.mark.parametrize("task", ["transfer_cube", "lift_hold"])
def test_the_expert_does_its_task_through_the_operator(task):
    operator = AlohaSimOperator(task=task, seed=11, **SMALL)
    operator.connect()
    expert = Expert(load_model(AlohaScene.file))
    for seed in (11, 12):
        operator.reset(seed)
        commands = expert.plan(task, operator._scene.cube)
        for command in commands[:-1]:
            operator.send_action(command)
        # Handing over ends an episode; holding has to last to its end.
        assert operator.task_done() == (task == "transfer_cube")
        operator.send_action(commands[-1])
        assert operator.task_done()
        assert operator.task_success(), seed
    operator.reset(13)
    assert not operator.task_success(), "a new episode begins with nothing done"
    operator.close()


def test_ur_picks_the_cube_up_through_the_operator():
    operator = URSimOperator(seed=5, **SMALL)
    operator.connect()
    expert = URExpert(operator._scene.model)
    joints = operator.embodiment.joints
    speed_limit = np.array([j.velocity for j in joints])
    acceleration_limit = np.array([j.acceleration for j in joints])
    for seed in (5, 6, 7):
        operator.reset(seed)
        plan = expert.plan("lift_cube", operator._scene.objects)
        speed = np.diff(np.vstack([operator.get_state(), plan]), axis=0)[1:] * 50
        assert (np.abs(speed).max(0) <= 0.95 * speed_limit).all()
        assert (np.abs(np.diff(speed, axis=0) * 50).max(0) <= 0.95 * acceleration_limit).all()
        for command in plan:
            operator.send_action(command)
        assert operator.task_success(), seed
    operator.reset(8)
    assert not operator.task_success()
    operator.close()


def test_the_embodiment_is_that_of_the_real_robot():
    operator = AlohaSimOperator(camera_names=("top",), **SMALL)
    check_match(aloha_spec(operator.embodiment.cameras), operator.embodiment, "robot", "simulation")
    assert operator.embodiment.rate_hz == 50.0


def test_the_cameras_are_those_of_the_scene():
    model = load_model(AlohaScene.file)
    names = {model.camera(index).name for index in range(model.ncam)}
    assert set(ALOHA.cameras) == names


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"task": "juggle"}, "no task 'juggle'; there are transfer_cube, lift_hold"),
        ({"camera_names": ("head",)}, "simulated ALOHA has no camera 'head'; it has top"),
        ({"height": 0}, "positive size, got 0x640"),
        ({"render": "best"}, "render 'best' is unknown; choose one of cheap, coarse, reference"),
    ],
)
def test_wrong_arguments_are_refused_before_anything_is_loaded(arguments, message):
    with pytest.raises(ConfigError, match=message):
        AlohaSimOperator(**arguments)


def test_wrong_arguments_of_the_ur_are_refused():
    with pytest.raises(ConfigError, match="UR5e has no camera 'top'; it has front, wrist"):
        URSimOperator(camera_names=("top",))


def test_refusals_name_the_joint_and_the_limit(aloha):
    beyond = HOME.copy()
    beyond[13] = 1.2
    with pytest.raises(Rejected, match=r"right_gripper: the command 1\.2 normalized is outside"):
        aloha.send_action(beyond)
    with pytest.raises(Rejected, match=r"actions of shape \(14,\), got \(7,\)"):
        aloha.send_action(HOME[:7])
    assert aloha.clock.now() == 0.0, "a refused command moves nothing"


def test_an_operator_that_is_not_connected_says_so():
    with pytest.raises(NotReady, match="AlohaSimOperator is not connected"):
        AlohaSimOperator().reset(0)


def test_a_machine_without_an_egl_driver_gets_one_clear_message():
    code = "from fluxvla_sim.aloha.cube import AlohaScene as S; s = S(); s.render('top', 48, 64)"
    nowhere = {"__EGL_VENDOR_LIBRARY_DIRS": "/nonexistent", "MUJOCO_GL": "egl"}
    run = subprocess.run(
        [sys.executable, "-c", code], env={**nowhere}, capture_output=True, text=True, check=False
    )
    assert run.returncode != 0
    assert "the simulator cannot draw: no OpenGL context could be made" in run.stderr
    assert "apt-get install -y libegl1 libegl-mesa0 libgl1-mesa-dri libopengl0" in run.stderr


def test_a_machine_without_egl_gets_one_clear_message():
    code = (
        "import ctypes; ctypes.CDLL = lambda name: (_ for _ in ()).throw(OSError(f'no {name}'));"
        "from fluxvla_sim.render import import_mujoco; import_mujoco()"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert run.returncode != 0
    assert "the simulator cannot draw: libEGL.so.1 cannot be loaded" in run.stderr
    assert "apt-get install -y libegl1" in run.stderr


def test_images_work_whoever_imported_mujoco_first():
    code = (
        "import mujoco; from fluxvla_sim.aloha.cube import AlohaScene;"
        "print(AlohaScene().render('top', 48, 64).shape)"
    )
    run = subprocess.run(
        [sys.executable, "-c", code], env={"PATH": ""}, capture_output=True, text=True, check=True
    )
    assert run.stdout.strip() == "(48, 64, 3)"
    assert "Traceback" not in run.stderr


def test_images_can_be_taken_from_any_thread(aloha):
    first = aloha.get_frame().images["top"]
    seen = []
    thread = threading.Thread(target=lambda: seen.append(aloha.get_frame().images["top"]))
    thread.start()
    thread.join(30.0)
    np.testing.assert_array_equal(seen[0], first)
    np.testing.assert_array_equal(aloha.get_frame().images["top"], first)


def test_an_episode_of_other_words_is_judged_by_nobody():
    operator = AlohaSimOperator(height=48, width=64)
    operator.connect()
    operator.begin_episode("wave the left arm", 0)
    assert operator.task_success() is None
    assert not operator.task_done()
    operator.begin_episode(operator.world.tasks[0].instruction, 1)
    assert operator.task_success() is False
    operator.close()
