"""A local policy that goes on from a chunk: what its model is given, in the model's own scale."""

from __future__ import annotations

import numpy as np
import pytest

from fluxvla_core.contracts.policy import Continuation
from fluxvla_core.control.joiners import soft_mask
from fluxvla_core.data.transforms.state_action import DenormalizePrivateAction
from fluxvla_core.errors import ConfigError
from fluxvla_core.policies.local import scaling_of
from fluxvla_core.spec import EmbodimentSpec, Joint

torch = pytest.importorskip("torch")

T, D, WIDTH = 5, 2, 4
ARM = EmbodimentSpec(
    "arm", (Joint("a", "rad", -3, 3, 1, 1), Joint("b", "rad", -3, 3, 1, 1)), (), 50.0
)
ROW = {
    "mean": [0.1, -0.2],
    "std": [0.5, 2.0],
    "min": [-1, -3],
    "max": [1, 3],
    "q01": [-0.9, -2],
    "q99": [1, 3],
}


class Obedient(torch.nn.Module):
    """Answers with what it is told to go on from, else with ones; remembers the mode it ran in."""

    action_shape = (T, WIDTH)

    def predict_action(
        self, states, prev_actions=None, prefix_weights=None, prefix_len=None,
        max_guidance_weight=None,
    ):  # fmt: skip
        self.given = (prev_actions, prefix_weights, prefix_len, max_guidance_weight)
        self.inference_mode = torch.is_inference_mode_enabled()
        return torch.ones(1, T, WIDTH) if prev_actions is None else prev_actions


class Stubborn(torch.nn.Module):
    action_shape = (T, WIDTH)

    def predict_action(self, states):
        return torch.ones(1, T, WIDTH)


def policy(model, denormalize=None, **arguments):
    from fluxvla_core.policies.local import LocalPolicy

    def prepare(observation):
        return {"states": torch.zeros(1, WIDTH)}

    scale = denormalize or DenormalizePrivateAction(norm_stats={"private": {"action": ROW}})
    return LocalPolicy(model, prepare, scale, ARM, (), 10.0, T, **arguments)


def observation(pose=(0.3, -0.4)):
    return {"qpos": np.array(pose, np.float32), "images": {}, "task_description": "x"}


def rest(frozen=2, known=4):
    actions = np.random.default_rng(0).uniform(-1, 1, (T, D))
    return Continuation(actions, soft_mask(T, frozen, known), frozen, 3.5)


@pytest.mark.parametrize("norm_type", ["mean_std", "min_max", "quantile", "none"])
def test_what_it_goes_on_from_arrives_in_the_models_scale(norm_type):
    scale = DenormalizePrivateAction(norm_stats={"private": {"action": ROW}}, norm_type=norm_type)
    local = policy(Obedient(), scale)
    given = rest()

    chunk = local.continue_action(observation(), given)

    np.testing.assert_allclose(chunk, given.actions, atol=1e-5)
    previous, weights, frozen, most = local.model.given
    assert previous.shape == (1, T, WIDTH)
    assert (previous[..., D:] == 0).all(), "padding"
    np.testing.assert_allclose(weights[0], given.weights, atol=1e-6)
    assert (frozen.tolist(), most.tolist()) == ([2], [3.5])


def test_actions_relative_to_the_state_are_scaled_by_the_present_state():
    class Relative:
        """Chunks as differences from the state, each step in a scale of its own."""

        def __call__(self, data):
            steps = np.arange(1, T + 1)[:, None]
            return np.asarray(data["action"])[0][:, :D] * 0.1 * steps + data["states"]

    local = policy(Obedient(), Relative())
    for pose in ((0.3, -0.4), (1.0, 2.0)):
        given = rest()
        chunk = local.continue_action(observation(pose), given)
        np.testing.assert_allclose(chunk, given.actions, atol=1e-5)


def test_the_rest_of_a_relative_chunk_is_moved_to_the_present_state():
    """A chunk counted from one state goes on as counted from the next one.

    What is handed over is where the arm is going to be, so each relative joint is counted anew;
    one that is not relative (a gripper) keeps its value; each step has its own scale.
    """
    rows = {"mean": [[0.1, -0.2]] * T, "std": [[0.1 * (j + 1), 2.0] for j in range(T)]}
    entry = {**rows, "relative": [1, 0]}
    scale = DenormalizePrivateAction(norm_stats={"private": {"action": entry}})
    local = policy(Obedient(), scale)
    then, now = np.array([0.3, -0.4]), np.array([0.8, 0.1])
    normalized = np.random.default_rng(1).uniform(-1, 1, (T, D))
    going = scale({"action": normalized, "states": then})

    chunk = local.continue_action(observation(now), Continuation(going, np.ones(T), 2))

    previous = local.model.given[0][0, :, :D].numpy()
    shift = (then - now)[0] / np.array(rows["std"])[:, 0]
    np.testing.assert_allclose(previous[:, 0], normalized[:, 0] + shift, rtol=1e-4)
    np.testing.assert_allclose(previous[:, 1], normalized[:, 1], atol=1e-5)
    np.testing.assert_allclose(chunk, going, atol=1e-5)


def test_its_model_may_differentiate_only_when_it_is_guided():
    local = policy(Obedient())
    local.predict_action(observation())
    assert local.model.inference_mode
    local.continue_action(observation(), rest())
    assert not local.model.inference_mode


def test_calls_are_counted_together():
    class Noisy(Obedient):
        def predict_action(self, states, noise, prev_actions=None, prefix_weights=None,
                           prefix_len=None, max_guidance_weight=None):  # fmt: skip
            return noise[..., :WIDTH]

    local = policy(Noisy())
    local.reset(1)
    first = local.predict_action(observation())
    second = local.continue_action(observation(), rest())
    local.reset(1)

    np.testing.assert_array_equal(local.continue_action(observation(), rest()), first)
    np.testing.assert_array_equal(local.predict_action(observation()), second)


def test_what_cannot_go_on_says_so_beforehand():
    def rounding(data):
        return np.round(np.asarray(data["action"])[0][:, :D])

    assert policy(Obedient()).continues
    assert not policy(Stubborn()).continues
    assert not policy(Obedient(), rounding).continues


@pytest.mark.parametrize("model", [Stubborn, Obedient])
def test_asked_all_the_same_it_is_an_error(model):
    def mixing(data):
        rows = np.asarray(data["action"])[0][:, :D]
        return rows * rows.mean()

    local = policy(model(), mixing if model is Obedient else None, source="step-100")
    with pytest.raises(ConfigError, match="the policy of step-100 cannot continue a chunk"):
        local.continue_action(observation(), rest())


def test_a_value_that_never_changes_is_no_obstacle():
    """A joint that stood still in all recordings has no scale; any normalised value will do."""

    def fixed(data):
        return np.asarray(data["action"])[0][:, :D] * [2.0, 0.0] + [0.0, 7.0]

    scaling = scaling_of(fixed, (T, WIDTH), np.zeros(2))

    normalized = scaling.normalized(np.full((T, D), 3.0))
    np.testing.assert_allclose(normalized, np.tile([1.5, 0, 0, 0], (T, 1)), atol=1e-6)
