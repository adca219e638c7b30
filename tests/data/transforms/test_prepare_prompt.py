"""Prompts of PI0 and PI0.5, and the normalisation around them."""

from __future__ import annotations

import numpy as np
import pytest

from fluxvla_core.build import build_transform_from_cfg
from fluxvla_core.data.transforms import prompts
from fluxvla_core.data.transforms.prompts import ProcessPrompts
from fluxvla_core.data.transforms.state_action import (
    DenormalizePrivateAction,
    NormalizeStatesAndActions,
)
from fluxvla_core.errors import ConfigError


def prompt(kind, text, states=(), **settings):
    sample = {"task_description": text, "states": np.asarray(states, np.float32)}
    return build_transform_from_cfg({"type": kind, **settings})(sample)["prompt"]


def test_the_instruction_and_a_newline():
    assert prompt("PreparePrompt", " put_it\naway ") == "put it away\n"
    assert prompt("PreparePrompt", "put_it away", clean=False) == "put_it away\n"
    assert prompt("PreparePrompt", "put it away\n", clean=False) == "put it away\n"


def test_the_state_in_words():
    states = [-1.0, -1.001, 0.0, 0.999999, 1.0, 7.0, -1 + 2 / 256, -1 + 1.999 / 256]
    found = prompt("PreparePromptWithState", " put_it\naway ", states)
    assert found == "Task: put it away, State: 0 -1 128 255 255 255 1 0;\nAction: "


def test_pi0_fast_says_action_itself():
    assert prompt("PreparePromptWithState", "go", [0.5], ending="") == "Task: go, State: 192;\n"


def test_padded_states_can_be_left_out():
    found = prompt("PreparePromptWithState", "go", [0.5, 0.0, 0.0], state_dim=1)
    assert found == "Task: go, State: 192;\nAction: "
    with pytest.raises(ConfigError, match="state_dim is 3, the sample has 2 states"):
        prompt("PreparePromptWithState", "go", [0.5, 0.0], state_dim=3)
    with pytest.raises(ConfigError, match="state_dim must be at least 1, got 0"):
        prompt("PreparePromptWithState", "go", [0.5], state_dim=0)


@pytest.mark.parametrize("kind", ["PreparePrompt", "PreparePromptWithState"])
def test_no_instruction(kind):
    for text in ("  ", None):
        with pytest.raises(ConfigError, match=f"{kind}: there is no instruction"):
            prompt(kind, text, [0.0])


class Letters:
    def encode(self, text):
        return list(text.encode())


def test_prompts_of_all_frames_are_not_kept(monkeypatch):
    monkeypatch.setattr(prompts, "KEPT", 3)
    transform = ProcessPrompts(Letters(), 8)
    for number in range(10):
        found = transform({"prompt": str(number)})
        assert found["lang_tokens"][0] == ord(str(number))
    assert len(transform._known) <= 3


STATS = {"mean": [0.5, 1.0], "std": [0.0, 2.0], "q01": [0.2, -1.0], "q99": [0.2, 3.0]}


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"norm_type": "mean_std"}, [0.0, (2 - 1) / (2 + 1e-6)]),
        ({"norm_type": "mean_std", "epsilon": 1e-8}, [0.0, (2 - 1) / (2 + 1e-8)]),
        ({"norm_type": "quantile"}, [2 * 0.3 / 1e-6 - 1, 2 * 3 / (4 + 1e-6) - 1]),
        (
            {"norm_type": "quantile", "epsilon": 1e-8, "epsilon_if_zero": True},
            [2 * 0.3 / 1e-8 - 1, 2 * 3 / 4 - 1],
        ),
    ],
)
def test_each_familys_epsilon_and_back(settings, expected):
    values = np.array([0.5, 2.0])
    stats = {"proprio": STATS, "action": STATS}
    normalize = NormalizeStatesAndActions(**settings)
    sample = normalize({"states": values, "actions": values[None], "stats": stats})
    np.testing.assert_allclose(sample["states"], expected, rtol=1e-6)
    np.testing.assert_allclose(sample["actions"][0], expected, rtol=1e-6)
    back = normalize.denormalizer({"private": stats})
    assert isinstance(back, DenormalizePrivateAction)
    np.testing.assert_allclose(back({"action": sample["actions"]})[0], values, rtol=1e-6)


def test_states_can_be_normalised_in_another_way():
    stats = {"proprio": STATS, "action": STATS}
    normalize = NormalizeStatesAndActions(norm_type="mean_std", state_norm_type="none")
    values = np.array([0.5, 2.0])
    sample = normalize({"states": values, "actions": values[None], "stats": stats})
    np.testing.assert_array_equal(sample["states"], values)
    assert sample["actions"][0, 1] == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"state_norm_type": "meanstd"}, "norm_type 'meanstd' is not one of"),
        ({"epsilon": -1.0}, "epsilon must be at least 0, got -1.0"),
        ({"epsilon": float("nan")}, "epsilon must be at least 0, got nan"),
    ],
)
def test_normalisations_that_mean_nothing(settings, words):
    with pytest.raises(ConfigError, match=words):
        NormalizeStatesAndActions(**settings)
