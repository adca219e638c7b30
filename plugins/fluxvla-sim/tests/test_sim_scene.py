"""The ALOHA scene against stock gym-aloha, and the tasks' facts."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest
from fluxvla_aloha.embodiment import aloha_spec
from fluxvla_sim.aloha import arms
from fluxvla_sim.aloha.arms import ARM_JOINTS, ARMS, load_model, to_metres, to_normalized
from fluxvla_sim.aloha.cube import AlohaScene, Facts
from fluxvla_sim.aloha.world import ALOHA, CUBE, INSERTION
from fluxvla_sim.render import Renderer, import_mujoco
from fluxvla_sim.ur import CUBE as LIFT
from fluxvla_sim.world import CONTROL_HZ, SUBSTEPS, task_of

from fluxvla_core.errors import ConfigError, RunFailed


@pytest.fixture(scope="module")
def scene():
    scene = AlohaScene()
    yield scene
    scene.close()


@pytest.fixture
def stock(monkeypatch):
    """gym-aloha's own environment, without the images that it draws after every step."""
    import_mujoco()
    gymnasium = pytest.importorskip("gymnasium")
    import gym_aloha  # noqa: F401 - registers the environment
    from gym_aloha.tasks import sim

    def blind(self, physics):
        image = np.zeros((1, 1, 3), np.uint8)
        return {"qpos": self.get_qpos(physics), "images": {"top": image}}

    monkeypatch.setattr(sim.BimanualViperXTask, "get_observation", blind)

    def make(name):
        made = gymnasium.make(
            f"gym_aloha/{name}-v0", obs_type="pixels_agent_pos", disable_env_checker=True
        )
        return made.unwrapped

    return make


@pytest.mark.parametrize(
    ("world", "name", "seed"),
    [
        (CUBE, "AlohaTransferCube", 0),
        (CUBE, "AlohaTransferCube", 4_294_967_295),
        (INSERTION, "AlohaInsertion", 0),
    ],
)
def test_is_bit_identical_to_gym_aloha(stock, world, name, seed):
    scene, stock = world.open_scene("cheap"), stock(name)
    expert = world.open_expert(scene.model)
    observation, _ = stock.reset(seed=seed)
    scene.reset(seed)
    np.testing.assert_array_equal(scene.state, observation["agent_pos"])
    # The expert's commands reach every reward; noise makes the arms bump into things too.
    commands = expert.plan(world.tasks[0].name, scene.objects)
    commands[255:] += np.random.default_rng(seed).normal(0, 0.05, (45, 14)).cumsum(0)
    rewards = set()
    for command in commands:
        observation, reward, *_ = stock.step(command)
        scene.step(command)
        physics = stock._env.physics.data
        np.testing.assert_array_equal(scene.data.qpos, physics.qpos)
        np.testing.assert_array_equal(scene.data.qvel, physics.qvel)
        np.testing.assert_array_equal(scene.state, observation["agent_pos"])
        assert scene.reward() == reward
        rewards.add(reward)
    assert {0, 2, 4} <= rewards


@pytest.mark.parametrize(
    ("world", "name"), [(CUBE, "AlohaTransferCube"), (INSERTION, "AlohaInsertion")]
)
def test_reference_images_are_gym_alohas_byte_for_byte(stock, world, name):
    scene, stock = world.open_scene("reference"), stock(name)
    stock.reset(seed=5)
    scene.reset(5)
    theirs = stock._env.physics.render(height=480, width=640, camera_id="top")
    np.testing.assert_array_equal(scene.render("top", 480, 640), theirs)
    scene.close()


@pytest.mark.parametrize("world", [CUBE, LIFT], ids=["aloha", "ur5e"])
@pytest.mark.parametrize("substeps", [1, 5])
def test_a_period_in_parts_is_the_same_period(world, substeps):
    whole, parts = world.open_scene("cheap"), world.open_scene("cheap")
    whole.reset(2)
    parts.reset(2)
    for command in world.open_expert(whole.model).plan(world.tasks[0].name, whole.objects)[:100]:
        whole.step(command)
        for _ in range(SUBSTEPS // substeps):
            parts.advance(command, substeps)
        np.testing.assert_array_equal(whole.data.qpos, parts.data.qpos)
        np.testing.assert_array_equal(whole.data.qvel, parts.data.qvel)


@pytest.mark.parametrize(
    ("world", "camera"), [(CUBE, "top"), (CUBE, "left_wrist"), (LIFT, "front"), (LIFT, "wrist")]
)
def test_depth_is_how_far_a_ray_goes(world, camera):
    scene, height, width = world.open_scene("cheap"), 96, 128
    scene.reset(3)
    renderer = Renderer(scene.model)
    image, metres = renderer.render_with_depth(scene.data, camera, height, width)
    np.testing.assert_array_equal(image, renderer.render(scene.data, camera, height, width))
    renderer.close()
    assert metres.dtype == np.float32
    points = [(row, column) for row in range(4, height, 13) for column in range(5, width, 17)]
    off = [
        metres[point] - along_the_axis(scene, camera, (height, width), point) for point in points
    ]
    assert np.isnan(metres).any(), "something is out of reach"
    # A ray at an object's edge may pass by where the image's pixel does not.
    assert np.mean(np.abs(off) < 1e-3) + np.mean(np.isnan(off)) > 0.95
    assert np.mean(np.abs(off) < 1e-3) > 0.3


def along_the_axis(scene, camera, size, point):
    """Metres along the camera's axis to what the pixel at ``point`` shows; NaN for nothing."""
    model, data, index = scene.model, scene.data, scene.model.camera(camera).id
    focal = size[0] / 2 / np.tan(np.radians(model.cam_fovy[index]) / 2)
    row, column = point
    way = np.array([(column + 0.5 - size[1] / 2) / focal, (size[0] / 2 - row - 0.5) / focal, -1.0])
    ahead = data.cam_xmat[index].reshape(3, 3) @ way / np.linalg.norm(way)
    geom = np.zeros(1, np.int32)
    start = data.cam_xpos[index]
    met = import_mujoco().mj_ray(model, data, start, ahead, None, 1, -1, geom)
    return met / np.linalg.norm(way) if met >= 0 else np.nan


def test_constants_are_gym_alohas():
    constants = pytest.importorskip("gym_aloha.constants")
    assert constants.PUPPET_GRIPPER_POSITION_CLOSE == arms.FINGER_CLOSED
    assert constants.PUPPET_GRIPPER_POSITION_OPEN == arms.FINGER_OPEN
    assert constants.DT * CONTROL_HZ == 1.0
    assert constants.START_ARM_POSE[:7] == [*arms.HOME_ARM, arms.HOME_FINGER]


def test_gripper_scale_is_its_own_inverse():
    assert to_normalized(to_metres(0.25)) == pytest.approx(0.25)
    assert to_normalized(arms.FINGER_CLOSED) == 0.0
    assert to_normalized(arms.FINGER_OPEN) == 1.0


def test_limits_of_the_embodiment_are_within_the_models(scene):
    joints = {joint.name: joint for joint in aloha_spec(()).joints}
    for arm in ARMS:
        for name in ARM_JOINTS:
            lower, upper = scene.model.joint(f"vx300s_{arm}/{name}").range
            joint = joints[f"{arm}_{name}"]
            assert lower - 1e-4 <= joint.lower < joint.upper <= upper + 1e-4


def test_state_has_the_embodiments_order(scene):
    scene.reset(0)
    names = aloha_spec(()).joint_names
    for index, name in enumerate(names):
        before = scene.state
        arm, _, joint = name.partition("_")
        target = "left_finger" if joint == "gripper" else joint
        address = scene.model.joint(f"vx300s_{arm}/{target}").qposadr[0]
        scene.data.qpos[address] += 0.01
        changed = np.flatnonzero(scene.state != before)
        assert changed.tolist() == [index]


def test_images_have_any_size(scene):
    scene.reset(0)
    for size in ((33, 47), (480, 640), (600, 900), (48, 64)):
        image = scene.render("top", *size)
        assert image.shape == (*size, 3)
        assert image.dtype == np.uint8
        red = (image[..., 0] > 150) & (image[..., 1] < 100)
        assert red.any(), "the red cube is in sight"


def test_an_unknown_camera_is_named_with_those_that_exist(scene):
    with pytest.raises(ValueError, match=r"no camera 'head'; it has .*top.*left_wrist"):
        scene.render("head", 48, 64)


def test_cheap_images_leave_out_shadows_and_multisampling():
    cheap, reference = (load_model(AlohaScene.file, name) for name in ("cheap", "reference"))
    quality = cheap.vis.quality
    assert (quality.shadowsize, quality.offsamples) == (0, 0)
    quality = reference.vis.quality
    assert (quality.shadowsize, quality.offsamples) == (4096, 4), "as the model file asks"
    with pytest.raises(ConfigError, match="render 'best' is unknown; choose one of"):
        load_model(AlohaScene.file, "best")


def test_cheap_images_show_the_same_scene():
    images = []
    for quality in ("cheap", "reference"):
        drawn = AlohaScene(quality)
        drawn.reset(4)
        images.append(drawn.render("top", 96, 128).astype(int))
        drawn.close()
    assert np.abs(images[0] - images[1]).mean() < 12
    assert (images[0] != images[1]).any()


def test_a_missing_gym_aloha_is_named_with_its_install_command(monkeypatch):
    monkeypatch.setattr(arms.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(RunFailed, match="not installed") as caught:
        arms.load_model(AlohaScene.file)
    assert "pip install --no-deps gym-aloha" in str(caught.value)


def test_loading_the_model_leaves_gymnasium_alone():
    import subprocess

    code = (
        "import sys; from fluxvla_sim.aloha.cube import AlohaScene; AlohaScene();"
        "print(sorted({'gymnasium', 'dm_control', 'torch'} & set(sys.modules)))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


def test_tasks_judge_facts():
    transfer, lift = CUBE.tasks
    held = Facts(steps=300, best_reward=2, right_touches=True, height=0.2)
    handed = Facts(steps=190, best_reward=4, left_touched=True, right_touches=True, height=0.2)
    assert lift.success(held)
    assert lift.done(held)
    assert not transfer.success(held)
    assert not transfer.done(held)
    assert transfer.success(handed)
    assert transfer.done(handed)
    assert not lift.success(replace(held, left_touched=True)), "the left gripper touched it"
    assert not lift.success(replace(held, height=0.05)), "not high enough"
    assert not lift.success(replace(held, right_touches=False)), "thrown, not held"
    assert not lift.success(replace(held, steps=299)), "holding is judged at the end"


def test_an_instruction_finds_its_task():
    assert task_of(CUBE, "Hand the cube  over to the left arm").name == "transfer_cube"
    assert task_of(CUBE, "dance") is None


def test_an_unknown_task_is_refused_with_those_that_exist():
    with pytest.raises(ConfigError, match="no task 'juggle'; there are transfer_cube, lift_hold"):
        ALOHA.find("juggle")
