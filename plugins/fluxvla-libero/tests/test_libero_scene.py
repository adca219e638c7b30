"""A scene against LIBERO's own environment: resets, states and images are the same."""

from __future__ import annotations

import os

import numpy as np
import pytest
from fluxvla_libero.embodiment import NO_OP, axis_angle
from fluxvla_libero.environment import LiberoEnvironment
from fluxvla_libero.scene import SHOWN_GROUPS, LiberoScene
from fluxvla_libero.suites import (
    MAX_STEPS,
    SUITES,
    can_be_done_in,
    choose_tasks,
    goal,
    init_states,
    suite_tasks,
)
from fluxvla_mujoco import Drawing

from fluxvla_core.errors import ConfigError, RunFailed


def shake(scene, seed, steps=12):
    rng = np.random.default_rng(seed)
    for _ in range(steps):
        scene.step(np.clip(rng.normal(size=7), -1, 1))
    return scene.state_hash()


@pytest.mark.early
def test_an_episode_goes_as_in_liberos_own_environment(stock, scene):
    """After other episodes in the scene, and from a model that LIBERO built again."""
    init = init_states("libero_object", 2)
    scene.reset(init[1])
    shake(scene, 1)
    scene.reset(init[0])
    env = stock(scene.task, size=64)
    seen = env.set_init_state(init[0])
    rng = np.random.default_rng(0)
    for _ in range(12):
        action = np.clip(rng.normal(size=7), -1, 1)
        seen, _, done, _ = env.step(action)
        scene.step(action)
    data = env.sim.data
    np.testing.assert_array_equal(scene.data.qpos, data.qpos)
    np.testing.assert_array_equal(scene.data.qvel, data.qvel)
    assert not scene.done()
    assert not done
    expected = [
        seen["robot0_eef_pos"],
        axis_angle(seen["robot0_eef_quat"]),
        seen["robot0_gripper_qpos"],
    ]
    np.testing.assert_array_equal(scene.state, np.concatenate(expected))
    from robosuite.utils.transform_utils import quat2axisangle

    robosuites = quat2axisangle(seen["robot0_eef_quat"].copy())
    np.testing.assert_allclose(scene.state[3:6], robosuites, atol=1e-12)
    # What robosuite shows, turned by 180 degrees as everybody does it.
    drawing = Drawing(scene.model, "reference", SHOWN_GROUPS)
    scene.model.vis.quality.shadowsize = env.sim.model.vis.quality.shadowsize
    scene.model.vis.quality.offsamples = env.sim.model.vis.quality.offsamples
    for camera in ("agentview", "robot0_eye_in_hand"):
        image = drawing.image(scene._shown, camera, 64, 64)[:, ::-1]
        turned = seen[f"{camera}_image"][::-1, ::-1]
        assert image.std() > 10, "something is seen"
        np.testing.assert_array_equal(image, turned)
    drawing.close()
    env.close()


def test_what_cannot_move_stands_where_libero_puts_it(stock):
    """libero_goal has a cabinet and a stove, which the fixed states say nothing about."""
    task = suite_tasks("libero_goal")[0]
    state = init_states("libero_goal", 0)[3]
    scene = LiberoScene(task)
    scene.reset(seed=5)
    shake(scene, 2, 3)
    scene.reset(state)
    env = stock(task)
    env.set_init_state(state)
    np.testing.assert_array_equal(scene.model.body_pos, env.sim.model.body_pos)
    for _ in range(5):
        scene.step(NO_OP)
        env.step(NO_OP)
    np.testing.assert_array_equal(scene.data.qpos, env.sim.data.qpos)
    judged = [t.index for t in suite_tasks("libero_goal") if scene.can_check(t)]
    assert judged == list(range(10)), "all tasks share the scene"
    env.close()
    scene.close()
    scene.close()


def openvla_loop(libero, task, states, episodes, actions):
    """Where everything stood and ended in the first episodes of a task as OpenVLA evaluates it,
    by LIBERO's own classes: one environment, seeded once, reset before each episode."""
    from fluxvla_libero.require import quiet

    with quiet():
        env = libero.envs.OffScreenRenderEnv(
            bddl_file_name=str(task.bddl), camera_heights=16, camera_widths=16
        )
    for name, observable in env.env._observables.items():  # drawing is what takes the time
        observable.set_enabled("image" not in name)
    env.seed(0)
    kept = []
    for episode in range(episodes):
        env.reset()
        env.set_init_state(states[episode])
        model, data = env.sim.model, env.sim.data
        fixtures = model.body_pos.copy(), model.body_quat.copy()
        for action in (*[NO_OP] * 10, *actions):
            env.step(action)
        kept.append((*fixtures, data.qpos.copy(), data.qvel.copy()))
    env.close()
    return kept


@pytest.mark.parametrize(
    ("suite", "index", "episodes"),
    [
        ("libero_goal", 0, 2),
        pytest.param("libero_goal", 0, 5, marks=pytest.mark.slow),
        pytest.param("libero_10", 3, 5, marks=pytest.mark.slow),
        pytest.param("libero_spatial", 1, 5, marks=pytest.mark.slow),
    ],
)
def test_openvlas_protocol_to_the_last_bit(libero, monkeypatch, suite, index, episodes):
    """Also when episodes are run in another order, and after others of the other protocol."""
    if os.environ.get("CUDA_VISIBLE_DEVICES") == "":
        monkeypatch.delenv("CUDA_VISIBLE_DEVICES")
    task, states = suite_tasks(suite)[index], init_states(suite, index)
    actions = np.random.default_rng(1).uniform(-1, 1, (4, 7))
    theirs = openvla_loop(libero, task, states, episodes, actions)
    ours = LiberoEnvironment(suite, tasks=[index], protocol="openvla")
    usual = LiberoEnvironment(suite, tasks=[index])
    assert ours.spec.details["protocol"] == "openvla"
    assert usual.spec.details["protocol"] == "fluxvla"
    for episode in reversed(range(episodes)):
        ours.reset(episode, task.name)
        for action in actions:
            ours.step(action)
        model, data = ours.scene.model, ours.scene.data
        for found, expected in zip(
            (model.body_pos, model.body_quat, data.qpos, data.qvel), theirs[episode], strict=True
        ):
            np.testing.assert_array_equal(found, expected)
        if episode == episodes - 1:
            last = model.body_pos.copy()
    ours.close()
    usual.reset(episodes - 1, task.name)
    assert np.abs(usual.scene.model.body_pos - last).max() > 1e-3, "the protocols differ"
    usual.reset(0, task.name)
    np.testing.assert_array_equal(usual.scene.model.body_pos, theirs[0][0])
    usual.close()


def test_a_reset_leaves_nothing_of_the_episode_before(scene):
    init = init_states("libero_object", 2)
    scene.reset(init[4])
    first = shake(scene, 4)
    scene.reset(seed=9)
    placed = scene.state_hash()
    shake(scene, 5)
    scene.reset(init[4])
    assert shake(scene, 4) == first
    scene.reset(seed=9)
    assert scene.state_hash() == placed
    scene.reset(seed=10)
    assert scene.state_hash() != placed
    assert scene.steps == 0


def test_waiting_steps_do_not_count(scene):
    scene.reset(init_states("libero_object", 2)[0])
    scene.settle(4)
    assert scene.steps == 0
    scene.step(NO_OP)
    assert scene.steps == 1


def test_cheap_images_show_the_same_without_shadows(scene):
    scene.reset(init_states("libero_object", 2)[0])
    image = scene.render("agentview", 48, 80)
    assert image.shape == (48, 80, 3)
    assert image.dtype == np.uint8
    assert image.std() > 10
    np.testing.assert_array_equal(image, scene.render("agentview", 48, 80))
    assert scene.model.vis.quality.shadowsize == 0


def test_the_basket_is_on_the_left_as_in_the_public_datasets(scene):
    """It stands at positive y; upright and not mirrored it would be on the right."""
    scene.reset(init_states("libero_object", 2)[0])
    image = scene.render("agentview", 64, 64).astype(int)
    column = image[30:42].std(axis=(0, 2))
    assert column[5:20].mean() > 1.5 * column[48:62].mean(), "the basket's wicker"


@pytest.mark.parametrize(
    "action", [np.zeros(6), np.full(7, np.nan), np.full(7, np.inf), np.zeros((1, 7))]
)
def test_impossible_actions_are_refused(scene, action):
    with pytest.raises(RunFailed, match="LIBERO takes 7 finite numbers"):
        scene.step(action)


def test_a_state_of_another_model_is_refused(scene):
    with pytest.raises(RunFailed, match="an initial state has 110 numbers"):
        scene.reset(np.zeros(92))


def test_suites_have_their_tasks_goals_and_states(libero):
    tasks = suite_tasks("libero_object")
    assert [t.index for t in tasks] == list(range(10))
    assert tasks[4].language == "pick up the ketchup and place it in the basket"
    assert goal(tasks[4]) == (("in", "ketchup_1", "basket_1_contain_region"),)
    assert init_states("libero_object", 4).shape[0] == 50
    assert len(suite_tasks("libero_90")) == 90


def test_reworded_suites_say_it_in_other_words(libero):
    if "libero_object_lan" not in libero.benchmark.get_benchmark_dict():
        pytest.skip("the classic LIBERO has no LIBERO-PRO suites")
    plain, reworded = (suite_tasks(suite)[0] for suite in ("libero_object", "libero_object_lan"))
    assert reworded.language != plain.language


@pytest.mark.parametrize("suite", SUITES)
def test_every_suite_is_whole(libero, suite):
    if suite not in libero.benchmark.get_benchmark_dict():
        assert suite not in MAX_STEPS, "only LIBERO-PRO's may be missing, from the classic LIBERO"
        with pytest.raises(ConfigError, match=f"the installed LIBERO has no suite '{suite}'"):
            suite_tasks(suite)
        return
    tasks = suite_tasks(suite)
    assert len(tasks) == (90 if suite == "libero_90" else 10)
    assert len({task.name for task in tasks}) == len(tasks)
    assert all(task.bddl.is_file() and task.language and goal(task) for task in tasks)
    assert len(init_states(suite, len(tasks) - 1)) == 50


def test_tasks_are_chosen_by_index_and_name(libero):
    tasks = suite_tasks("libero_object")
    assert choose_tasks("libero_object", None) == tasks
    assert choose_tasks("libero_object", [3, tasks[1].name]) == (tasks[3], tasks[1])
    with pytest.raises(ConfigError, match=r"libero_object has no task 10; it has 0 \(pick_up_the"):
        choose_tasks("libero_object", [10])
    with pytest.raises(ConfigError, match="must name each task once"):
        choose_tasks("libero_object", [1, 1])
    with pytest.raises(ConfigError, match="must name each task once"):
        choose_tasks("libero_object", [])


def test_what_can_be_done_where_is_read_from_the_files(libero, scene):
    tasks = suite_tasks("libero_object")
    from_files = [t.index for t in tasks if can_be_done_in(t, tasks[2])]
    assert from_files == [t.index for t in tasks if scene.can_check(t)]
    assert from_files == [0, 1, 2, 4, 5, 7]
