"""The scripted experts: success on seeds that nobody looked at, within the real arms' limits."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from fluxvla_aloha.embodiment import aloha_spec
from fluxvla_sim.aloha.arms import HOME
from fluxvla_sim.aloha.cube import CUBE_HIGH, CUBE_LOW, MAX_STEPS, AlohaScene, Expert, Facts, arm_ik
from fluxvla_sim.aloha.world import ALOHA, CUBE, INSERTION
from fluxvla_sim.motion import minimum_jerk, quaternion_product, quaternion_share, turn
from fluxvla_sim.ur import HOME as UR_HOME
from fluxvla_sim.ur import UR5E, LiftFacts

TASKS = {task.name: task for task in CUBE.tasks}
CORNERS = [
    np.array([x, y, 0.05, 1, 0, 0, 0])
    for x in (CUBE_LOW[0], CUBE_HIGH[0])
    for y in (CUBE_LOW[1], CUBE_HIGH[1])
]


@pytest.fixture(scope="module")
def scene():
    return AlohaScene()


@pytest.fixture(scope="module")
def expert(scene):
    return Expert(scene.model)


@pytest.mark.parametrize("task", TASKS)
def test_succeeds_wherever_the_cube_can_be(scene, expert, task):
    seeds = range(7_000_000, 7_000_008)
    other = next(name for name in TASKS if name != task)
    for place in [*CORNERS, *seeds]:
        scene.reset(place) if isinstance(place, int) else scene.reset_to(place)
        facts = Facts()
        for command in expert.plan(task, scene.cube):
            scene.step(command)
            facts = facts.after(scene)
        assert TASKS[task].success(facts), (place, facts)
        assert not TASKS[other].success(facts), (place, facts)


@pytest.mark.parametrize("task", TASKS)
def test_commands_keep_the_embodiments_limits_with_room_to_spare(expert, task):
    joints = aloha_spec(()).joints
    speed_limit = np.array([j.velocity for j in joints])
    acceleration_limit = np.array([j.acceleration for j in joints])
    for cube in CORNERS:
        plan = expert.plan(task, cube)
        assert plan.shape == (MAX_STEPS, 14)
        assert (plan >= [j.lower for j in joints]).all()
        assert (plan <= [j.upper for j in joints]).all()
        speed = np.diff(np.vstack([HOME, plan]), axis=0) * 50
        acceleration = np.diff(np.vstack([np.zeros(14), speed]), axis=0) * 50
        assert (np.abs(speed).max(0) <= 0.95 * speed_limit).all()
        assert (np.abs(acceleration).max(0) <= 0.75 * acceleration_limit).all()


def test_a_plan_is_a_function_of_the_cube_alone(scene, expert):
    first = expert.plan("transfer_cube", CORNERS[0])
    expert.plan("lift_hold", CORNERS[3])
    np.testing.assert_array_equal(expert.plan("transfer_cube", CORNERS[0]), first)
    np.testing.assert_array_equal(Expert(scene.model).plan("transfer_cube", CORNERS[0]), first)


def test_wrist_and_forearm_of_the_picking_arm_never_roll(expert):
    """A neighbouring cube never flips a roll joint by half a turn, which nothing could learn."""
    for cube in CORNERS:
        rolls = expert.plan("lift_hold", cube)[:, [10, 12]]
        assert np.abs(rolls).max() < 1e-3


def plans_within_limits(robot, plan, home, share=0.95):
    joints = robot.embodiment(()).joints
    speed = np.diff(np.vstack([home, plan]), axis=0) * 50
    acceleration = np.diff(np.vstack([np.zeros_like(home), speed]), axis=0) * 50
    assert (plan >= [j.lower for j in joints]).all()
    assert (plan <= [j.upper for j in joints]).all()
    assert (np.abs(speed).max(0) <= [share * j.velocity for j in joints]).all()
    assert (np.abs(acceleration).max(0) <= [share * j.acceleration for j in joints]).all()


def test_peg_and_socket_meet_wherever_they_lie():
    scene = INSERTION.open_scene("cheap")
    expert = INSERTION.open_expert(scene.model)
    (task,) = INSERTION.tasks
    upright = [1.0, 0, 0, 0]
    far = np.array([0.2, 0.6, 0.05, *upright, -0.2, 0.4, 0.05, *upright])
    near = np.array([0.1, 0.4, 0.05, *upright, -0.1, 0.6, 0.05, *upright])
    for objects in (far, near):
        scene.reset_to(objects)
        facts = INSERTION.begin()
        for command in expert.plan(task.name, scene.objects):
            scene.step(command)
            facts = facts.after(scene)
        assert task.success(facts), (objects, facts)
        assert task.done(facts)
    scene.reset(7_000_000)
    plans_within_limits(ALOHA, expert.plan(task.name, scene.objects), HOME, share=1.0)


def test_the_ur5e_lifts_the_cube_wherever_it_lies():
    (world,) = UR5E.worlds
    (task,) = world.tasks
    scene = world.open_scene("cheap")
    expert = world.open_expert(scene.model)
    for seed in range(7_000_000, 7_000_004):
        scene.reset(seed)
        facts = world.begin()
        plan = expert.plan(task.name, scene.objects)
        plans_within_limits(UR5E, plan, UR_HOME)
        for command in plan[: task.record_steps]:
            scene.step(command)
            facts = facts.after(scene)
        assert task.success(facts), (seed, facts)


def test_a_cube_that_is_only_tossed_up_is_not_held():
    (task,) = UR5E.worlds[0].tasks
    tossed, lifts = LiftFacts(), SimpleNamespace(lifted=lambda: tossed.steps % 10 != 9)
    for _ in range(60):
        tossed = tossed.after(lifts)
    assert not task.success(tossed), "never held for longer than nine steps on end"
    lifts.lifted = lambda: True
    for _ in range(10):
        tossed = tossed.after(lifts)
    assert task.success(tossed)


@pytest.mark.parametrize("world", [*ALOHA.worlds, *UR5E.worlds])
def test_noise_leaves_grippers_alone_and_begins_at_rest(world):
    noise = world.noise(np.random.default_rng(0))
    joints = (ALOHA if world in ALOHA.worlds else UR5E).embodiment(()).joints
    assert noise.shape == (world.max_steps, len(joints))
    grippers = [index for index, joint in enumerate(joints) if joint.kind == "gripper"]
    assert np.abs(noise[0]).max() == np.abs(noise[:, grippers]).max() == 0.0
    assert 0.5 < noise[:40].std() * 2 < 3


@pytest.mark.parametrize("arm", ["left", "right"])
def test_inverse_kinematics_finds_reachable_poses(scene, arm):
    ik = arm_ik(scene.model, arm)
    rng = np.random.default_rng(3)
    for _ in range(5):
        wanted = HOME[:6] + rng.uniform(-0.3, 0.3, 6)
        position, quaternion = ik.forward(wanted)
        joints, error = ik.solve(HOME[:6], position, quaternion)
        assert error < 1e-4
        reached, turned = ik.forward(joints)
        assert np.linalg.norm(reached - position) < 1e-4
        assert abs(turned @ quaternion) > 1 - 1e-6


def test_inverse_kinematics_says_how_far_off_it_stays(scene):
    ik = arm_ik(scene.model, "left")
    _, error = ik.solve(HOME[:6], np.array([5.0, 0.0, 0.0]), np.array([1.0, 0, 0, 0]))
    assert error > 3.0


def test_minimum_jerk_starts_and_ends_at_rest():
    share = minimum_jerk(50)
    assert share[-1] == 1.0
    steps = np.diff(np.concatenate([[0.0], share]))
    assert (steps > 0).all()
    assert steps[0] < 1e-3
    assert steps[-1] < 1e-3


def test_quaternions_turn_the_right_way_round():
    quarter = turn((0, 0, 1), 90)
    half = quaternion_product(quarter, quarter)
    np.testing.assert_allclose(half, turn((0, 0, 1), 180), atol=1e-12)
    tilted = quaternion_product(turn((0, 0, 1), 180), turn((0, 1, 0), 60))
    np.testing.assert_allclose(tilted, [0, -0.5, 0, np.sqrt(0.75)], atol=1e-12)


def test_a_share_of_a_turn_goes_the_short_way_round():
    quarter = turn((0, 0, 1), 90)
    np.testing.assert_allclose(quaternion_share(quarter, 0.5), turn((0, 0, 1), 45), atol=1e-12)
    np.testing.assert_allclose(quaternion_share(-quarter, 0.5), turn((0, 0, 1), 45), atol=1e-12)
    np.testing.assert_allclose(quaternion_share(np.array([1.0, 0, 0, 0]), 0.5), [1, 0, 0, 0])
