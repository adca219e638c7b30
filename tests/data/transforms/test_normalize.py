from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from fluxvla_core import build_transform_from_cfg
from fluxvla_core.data.statistics import NORM_TYPES, as_lists, column_statistics, make_affine
from fluxvla_core.data.transforms.state_action import (
    DenormalizePrivateAction,
    NormalizeStatesAndActions,
)
from fluxvla_core.errors import ConfigError

D, T = 3, 4
values = st.floats(-100, 100, width=32)
norm_types = st.sampled_from(NORM_TYPES)


def stats_of(rows):
    return as_lists(column_statistics(rows))


def make_stats(seed=0, dim=D):
    rng = np.random.default_rng(seed)
    return {
        "proprio": stats_of(rng.normal(1, 2, (200, dim))),
        "action": stats_of(rng.normal(-1, 3, (200, dim))),
    }


def sample(seed=0, **extra):
    rng = np.random.default_rng(seed)
    states = rng.normal(size=D).astype(np.float32)
    actions = rng.normal(size=(T, D)).astype(np.float32)
    states.flags.writeable = actions.flags.writeable = False
    return {"states": states, "actions": actions, "stats": make_stats(), **extra}


@given(
    rows=hnp.arrays(np.float32, (20, D), elements=values),
    actions=hnp.arrays(np.float32, (T, D), elements=values),
    state=hnp.arrays(np.float32, D, elements=values),
    norm_type=norm_types,
    floor=st.sampled_from([0.02, 1.0]),
    mask=st.none() | st.lists(st.booleans(), min_size=D, max_size=D),
    relative=st.none() | st.lists(st.integers(0, 1), min_size=D, max_size=D),
    pad=st.integers(0, 3),
)
def test_denormalising_undoes_normalising(
    rows, actions, state, norm_type, floor, mask, relative, pad
):
    entry = {**stats_of(rows), **({} if relative is None else {"relative": relative})}
    stats = {"proprio": stats_of(rows), "action": entry}
    normalise = NormalizeStatesAndActions(
        norm_type=norm_type,
        std_floor=floor,
        action_norm_mask=mask,
        action_dim=D + pad,
        state_dim=D + pad,
    )
    out = normalise({"states": state, "actions": actions, "stats": stats})
    assert out["actions"].dtype == out["states"].dtype == np.float32
    assert out["actions"].shape == (T, D + pad)
    assert (out["actions"][:, D:] == 0).all()
    # One float32 rounding of the normalised value, times the scale, is all that may be lost.
    scale = max(1.0, float(np.abs(rows).max()), float(np.abs(actions).max()) * 2 + 200)
    undo = normalise.denormalizer({"private": stats})
    back = undo({"action": out["actions"][None], "states": state})
    np.testing.assert_allclose(back, actions, atol=2e-6 * scale)
    states = make_affine(stats["proprio"], norm_type, "test", floor).inverse(out["states"][:D])
    np.testing.assert_allclose(states, state, atol=2e-6 * scale)


def test_formulas_are_the_documented_ones():
    s = sample()
    x, a = (
        s["actions"].astype(np.float64),
        {k: np.array(v) for k, v in make_stats()["action"].items()},
    )
    for norm_type, expected in {
        "mean_std": (x - a["mean"]) / (a["std"] + 1e-6),
        "quantile": 2 * (x - a["q01"]) / (a["q99"] - a["q01"] + 1e-6) - 1,
        "min_max": 2 * (x - a["min"]) / (a["max"] - a["min"] + 1e-6) - 1,
        "none": x,
    }.items():
        got = NormalizeStatesAndActions(norm_type=norm_type)(s)["actions"]
        np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-6)


def test_statistics_for_each_step_of_the_chunk():
    rng = np.random.default_rng(0)
    chunks = rng.normal(np.arange(T)[:, None], 1 + np.arange(T)[:, None], (500, T, D))
    flat = stats_of(chunks.reshape(500, T * D))
    per_step = {k: np.reshape(v, (T, D)).tolist() for k, v in flat.items() if k != "count"}
    normalise = NormalizeStatesAndActions()
    stats = {"proprio": make_stats()["proprio"], "action": per_step}
    out = [
        normalise({"states": np.zeros(D), "actions": c, "stats": stats})["actions"] for c in chunks
    ]
    np.testing.assert_allclose(np.mean(out, 0), 0, atol=1e-4)
    np.testing.assert_allclose(np.std(out, 0), 1, atol=1e-4)


def test_relative_actions_are_counted_from_the_state():
    stats = make_stats()
    entry = {**stats["action"], "mean": [0, 0, 0], "std": [1, 1, 1], "relative": [1, 1, 0]}
    s = sample(stats={"proprio": stats["proprio"], "action": entry})
    out = NormalizeStatesAndActions()(s)["actions"]
    np.testing.assert_allclose(out[:, :2], s["actions"][:, :2] - s["states"][:2], atol=1e-5)
    np.testing.assert_allclose(out[:, 2], s["actions"][:, 2], atol=1e-5)
    with pytest.raises(ConfigError) as caught:
        NormalizeStatesAndActions().denormalizer({"private": {"action": entry}})({"action": out})
    assert "counted from the present state, and no state was given" in str(caught.value)
    assert "data['states']" in str(caught.value)


def test_a_floor_keeps_a_still_joint_from_blowing_up():
    rows = np.ones((50, D), np.float32)
    stats = {"proprio": stats_of(rows), "action": stats_of(rows)}
    s = {"states": np.full(D, 1.01), "actions": np.full((T, D), 1.01), "stats": stats}
    for norm_type in ("mean_std", "quantile", "min_max"):
        bare = NormalizeStatesAndActions(norm_type=norm_type)(s)
        assert np.abs(bare["states"]).min() > 1000
        floored = NormalizeStatesAndActions(norm_type=norm_type, std_floor=0.02)(s)
        np.testing.assert_allclose(floored["states"], 0.5, rtol=1e-3)
        np.testing.assert_allclose(floored["actions"], 0.5, rtol=1e-3)


def test_at_inference_there_are_no_actions_and_padding_takes_its_value():
    s = sample()
    del s["actions"]
    out = NormalizeStatesAndActions(state_dim=5, pad_value=-7.0)(s)
    assert out["states"].shape == (5,)
    assert out["states"][3:].tolist() == [-7, -7]
    assert "actions" not in out


def test_built_from_configs_of_the_specification():
    undo = build_transform_from_cfg(
        {"type": "DenormalizePrivateAction", "norm_type": "mean_std", "action_dim": D},
        norm_stats={"private": make_stats()},
    )
    assert undo({"action": np.zeros((1, T, 8))}).shape == (T, D)


def test_statistics_come_from_a_checkpoints_file(tmp_path):
    path = tmp_path / "dataset_statistics.json"
    path.write_text(json.dumps({"private": make_stats()}))
    undo = DenormalizePrivateAction(str(path))
    np.testing.assert_allclose(
        undo({"action": np.zeros((2, D))}), [make_stats()["action"]["mean"]] * 2
    )


@pytest.mark.parametrize("cls", [NormalizeStatesAndActions, DenormalizePrivateAction])
def test_an_unknown_norm_type_is_refused_with_the_nearest(cls):
    with pytest.raises(ConfigError) as caught:
        cls(norm_type="meanstd")
    text, names = str(caught.value), "mean_std, quantile, min_max, none"
    assert f"{cls.__name__}: norm_type 'meanstd' is not one of {names}" in text
    assert "did you mean 'mean_std'?" in text
    with pytest.raises(ConfigError, match="norm_type 'proprio' is not one of"):
        cls(norm_type="proprio")


@pytest.mark.parametrize(
    ("arguments", "change", "message"),
    [
        ({"action_dim": 2}, {}, "action_dim 2 would cut the data's 3 dimensions"),
        ({"state_dim": 2}, {}, "state_dim 2 would cut the data's 3 dimensions"),
        ({"state_key": "eef"}, {}, "no entry 'eef'; they have action, proprio"),
        ({}, {"stats": None}, "no entry 'proprio'; they have nothing"),
        ({}, {"stats": {"proprio": [1]}}, "the statistics' entry 'proprio' is not a table"),
        ({}, {"stats": make_stats(dim=4)}, r"states have shape \(3,\), the statistics 'proprio'"),
        ({"action_norm_mask": [True]}, {}, "action_norm_mask has 1 entries, the statistics have 3"),
        (
            {"norm_type": "quantile"},
            {"stats": {k: {"mean": [0] * 3} for k in ("proprio", "action")}},
            "the statistics have no 'q01'; they have mean",
        ),
    ],
)
def test_what_does_not_fit_is_refused(arguments, change, message):
    with pytest.raises(ConfigError, match=message):
        NormalizeStatesAndActions(**arguments)({**sample(), **change})


@pytest.mark.parametrize(
    ("arguments", "action", "message"),
    [
        (
            {"norm_stats": None},
            np.zeros((T, D)),
            "DenormalizePrivateAction: there are no statistics",
        ),
        ({}, np.zeros((2, T, D)), r"one chunk \(T, D\) is expected, got shape \(2, 4, 3\)"),
        ({}, np.zeros((T, 2)), "the model gives 2 dimensions, the statistics describe 3"),
        ({"action_dim": 7}, np.zeros((T, 7)), "action_dim is 7, the statistics describe 3"),
        ({"statistic_name": "x"}, np.zeros((T, D)), "no entry 'x'; they have private"),
    ],
)
def test_denormalising_what_does_not_fit_is_refused(arguments, action, message):
    undo = DenormalizePrivateAction(**{"norm_stats": {"private": make_stats()}, **arguments})
    with pytest.raises(ConfigError, match=message):
        undo({"action": action})


def test_unreadable_statistics(tmp_path):
    with pytest.raises(ConfigError, match=r"norm_stats: .*missing\.json does not exist"):
        DenormalizePrivateAction(tmp_path / "missing.json")
    (tmp_path / "bad.json").write_text("{")
    with pytest.raises(ConfigError, match=r"bad\.json: invalid JSON"):
        DenormalizePrivateAction(tmp_path / "bad.json")
    (tmp_path / "list.json").write_text("[]")
    with pytest.raises(ConfigError, match=r"list\.json: input should be an object"):
        DenormalizePrivateAction(tmp_path / "list.json")


JOINTS = ("waist", "wrist", "gripper")


def seldom():
    """A joint that moves, one that is held, and a gripper that opens in 5 of 1000 frames."""
    rows = np.random.default_rng(0).normal(size=(1000, 3)).astype(np.float32)
    rows[:, 1:] = 0.25, 0.0
    rows[500:505, 2] = 0.08
    entry = stats_of(rows)
    return {"proprio": entry, "action": entry}


def test_what_hardly_moves_is_named_with_its_scale():
    (said,) = NormalizeStatesAndActions().warnings(seldom(), JOINTS, JOINTS)
    assert "NormalizeStatesAndActions(norm_type='mean_std', std_floor=0)" in said
    assert said.endswith(
        ": state wrist (range 0, divided by 1e-06); --set <NormalizeStatesAndActions>.std_floor="
        "0.01 or so, in the data's units: nothing is divided by less; or another norm_type"
    )
    (said,) = NormalizeStatesAndActions(std_floor=1e-5).warnings(seldom())
    assert ": state 1 (range 0, divided by 1.1e-05);" in said


def test_moves_that_would_be_blown_up_are_refused():
    """The gripper's 8 cm became 160000: its quantiles are equal."""
    with pytest.raises(ConfigError) as caught:
        NormalizeStatesAndActions(norm_type="quantile").warnings(seldom(), JOINTS, JOINTS)
    words = str(caught.value)
    for what in ("state", "action"):
        assert f"{what} gripper (range 0.08, divided by 5e-07)" in words
    assert "waist" not in words
    assert "wrist" not in words
    assert ".std_floor=0.01 or so" in words


@pytest.mark.parametrize(
    "settings",
    [
        {"std_floor": 0.01},
        {"std_floor": 0.01, "norm_type": "quantile"},
        {"norm_type": "none"},
    ],
)
def test_a_floor_leaves_no_warnings(settings):
    assert NormalizeStatesAndActions(**settings).warnings(seldom(), JOINTS, JOINTS) == []


def test_what_is_not_normalised_is_not_doubted():
    stats = {**seldom(), "proprio": make_stats()["proprio"]}
    mask = [True, True, False]
    quantile = {"norm_type": "quantile", "action_norm_mask": mask}
    assert NormalizeStatesAndActions(**quantile).warnings(stats) == []
    # A held joint is one that no action moves, whatever a model says of it.
    assert NormalizeStatesAndActions().warnings(stats) == []


def test_rare_moves_far_from_the_rest_are_doubted_not_refused():
    rows = np.zeros((100_000, 1), np.float32)
    rows[7] = 1.0
    stats = {"proprio": make_stats(dim=1)["proprio"], "action": stats_of(rows)}
    (said,) = NormalizeStatesAndActions().warnings(stats, ["lift"], ["lift"])
    assert ": action lift (range 1, divided by 0.0032);" in said


def test_each_dimension_is_doubted_at_the_step_where_it_moves_least():
    rows = [np.random.default_rng(j).normal(size=(300, 2)) for j in range(3)]
    rows[1][:, 1] = 0.0
    rows[1][3, 1] = 1.0
    each = [stats_of(r) for r in rows]
    action = {name: [e[name] for e in each] for name in each[0]}
    stats = {"proprio": make_stats(dim=2)["proprio"], "action": action}
    with pytest.raises(ConfigError, match=r"action 1 \(range 1, divided by 5e-07\)"):
        NormalizeStatesAndActions(norm_type="quantile").warnings(stats)


def test_statistics_without_extremes_are_not_doubted():
    bare = {"mean": [0.0], "std": [0.0]}
    assert NormalizeStatesAndActions().warnings({"proprio": bare, "action": bare}) == []
