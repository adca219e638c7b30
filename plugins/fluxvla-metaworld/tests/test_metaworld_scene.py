"""Episodes and images against Meta-World's own; outcomes that follow from task and seed."""

from __future__ import annotations

import numpy as np
import pytest
from fluxvla_metaworld.environment import CAMERAS, MetaWorldEnvironment
from fluxvla_metaworld.expert import MetaWorldExpert
from fluxvla_metaworld.tasks import INSTRUCTIONS, MT10

from fluxvla_core.errors import ConfigError, RunFailed
from fluxvla_core.operators import Camera

MOVING = ("push-v3", "door-open-v3")  # a free puck; a body that stands elsewhere in each episode


def act(environment, task, seed, steps=None):
    """An episode of the expert: success, steps, and the final state."""
    expert = MetaWorldExpert()
    expert.enter(environment)
    environment.reset(seed, task)
    expert.reset(seed)
    taken, found = 0, None
    while taken < (steps or 500) and (found is None or not found.ended):
        found = environment.step(expert.predict_action({})[0])
        taken += 1
    return found.success, taken, environment.state_hash()


def test_tasks_and_names_are_the_packages(metaworld):
    from metaworld.env_dict import MT10_V3

    assert {f"{name}-goal-observable" for name in INSTRUCTIONS} == set(metaworld)
    assert tuple(MT10_V3) == MT10


@pytest.mark.parametrize("task", MOVING)
def test_an_episode_follows_from_task_and_seed_and_leaves_nothing_behind(environment, task):
    first = act(environment, task, 3)
    act(environment, task, 4, steps=20)
    assert act(environment, task, 3) == first
    assert act(environment, task, 4)[2] != first[2]
    anew = MetaWorldEnvironment()
    assert act(anew, task, 3) == first
    anew.close()


def test_an_episode_goes_as_in_meta_worlds_own_environment(environment, metaworld):
    own = metaworld["push-v3-goal-observable"](seed=0)
    own._freeze_rand_vec, own.seeded_rand_vec = False, True
    own.seed(11)
    seen, _ = own.reset()
    environment.reset(11, "push-v3")
    np.testing.assert_array_equal(environment.privileged, seen)
    rng = np.random.default_rng(0)
    for _ in range(30):
        action = rng.uniform(-1, 1, 4)
        seen, reward, _, _, _ = own.step(action)
        found = environment.step(action)
        assert found.reward == reward
    np.testing.assert_array_equal(environment.privileged, seen)
    np.testing.assert_array_equal(environment.state, seen[:4])
    qpos = environment.observe(())["qpos"]
    assert qpos.dtype == np.float32
    np.testing.assert_allclose(qpos, seen[:4], atol=1e-6)
    own.close()


@pytest.mark.parametrize("camera", ["corner2", "topview"])
def test_reference_images_are_meta_worlds_own(metaworld, camera):
    own = metaworld["push-v3-goal-observable"](seed=0, render_mode="rgb_array")
    own._freeze_rand_vec, own.seeded_rand_vec = False, True
    own.mujoco_renderer.width, own.mujoco_renderer.height = 96, 80
    own.mujoco_renderer.camera_id = own.model.camera(camera).id
    own.seed(2)
    own.reset()
    made = MetaWorldEnvironment(render="reference")
    made.reset(2, "push-v3")
    for _ in range(3):
        own.step(np.zeros(4))
        made.step(np.zeros(4))
    expected = own.render()
    if camera == "corner2":
        expected = expected[::-1, ::-1]
    image = made.observe([Camera(camera, 80, 96)])["images"][camera]
    assert image.std() > 10
    np.testing.assert_array_equal(image, expected)
    own.close()
    made.close()


def test_every_camera_shows_something_at_no_cost_to_the_physics(environment):
    environment.reset(5, "push-v3")
    before = environment.state_hash()
    seen = environment.observe([Camera(name, 32, 40) for name in CAMERAS])
    assert seen["task_description"] == "push the puck to the goal"
    assert all(p.shape == (32, 40, 3) and p.dtype == np.uint8 for p in seen["images"].values())
    assert all(image.std() > 5 for image in seen["images"].values())
    assert environment.state_hash() == before
    with pytest.raises(ConfigError, match="no camera 'front'"):
        environment.observe([Camera("front", 32, 32)])


def test_the_first_image_shows_this_episodes_goal_and_not_the_last_ones(environment):
    """Meta-World moves the goal's marker only when the simulation goes on."""
    camera = [Camera("topview", 96, 96)]

    def goal():
        image = environment.observe(camera)["images"]["topview"].astype(int)
        green = (image[..., 1] > 120) & (image[..., 0] < 80) & (image[..., 2] < 80)
        assert green.sum() > 2, "the marker is seen"
        return np.argwhere(green).mean(0)

    places = []
    for seed in (1, 2, 3):
        environment.reset(seed, "push-v3")
        at_first = goal()
        environment.step(np.zeros(4))
        assert np.abs(at_first - goal()).max() < 1.0
        places.append(at_first)
    assert np.abs(places[0] - places[1]).max() > 2, "goals differ between episodes"


def test_an_episode_ends_with_its_first_success_or_with_the_steps(environment):
    assert act(environment, "reach-v3", 0)[0] is True
    environment.reset(0, "push-v3")
    for _ in range(499):
        assert not environment.step(np.zeros(4)).ended
    assert environment.step(np.zeros(4)).ended
    with pytest.raises(RunFailed, match="the episode is over; reset begins another one"):
        environment.step(np.zeros(4))


@pytest.mark.parametrize("action", [np.zeros(3), np.full(4, np.nan), np.zeros((1, 4))])
def test_impossible_actions_are_refused(environment, action):
    environment.reset(0, "push-v3")
    with pytest.raises(RunFailed, match="Meta-World takes 4 finite numbers"):
        environment.step(action)


def test_a_task_of_another_set_is_refused(environment):
    few = MetaWorldEnvironment(tasks=["push-v3"])
    with pytest.raises(ConfigError, match="'reach-v3' is not a task of this environment"):
        few.reset(0, "reach-v3")
    with pytest.raises(RunFailed, match="the episode is over"):
        few.step(np.zeros(4))


def test_closing_twice_and_going_on_is_fine(metaworld):
    made = MetaWorldEnvironment()
    made.close()
    made.reset(0, "reach-v3")
    made.observe([Camera("corner", 32, 32)])
    first = made.state_hash()
    made.close()
    made.close()
    made.reset(0, "reach-v3")
    assert made.state_hash() == first
    made.close()
