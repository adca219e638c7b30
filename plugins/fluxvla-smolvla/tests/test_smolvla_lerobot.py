"""LeRobot's folders: they act here as there, are trained on, and go back as they came."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from fluxvla_smolvla.lerobot_format import LeRobotSmolVLA
from safetensors.torch import load_file, save_file

from fluxvla_core import Camera, Continuation, EmbodimentSpec, Joint
from fluxvla_core.cli.main import main
from fluxvla_core.data import PrivateInferenceDataset
from fluxvla_core.errors import CheckpointError, ConfigError, FluxError, UsageError
from fluxvla_core.models import load_policy
from tests.oracles import fill
from tests.policies.benched import DIVIDED, stages_of

from .tiny import (
    ACTION,
    CAMERAS,
    GOLDEN,
    HORIZON,
    STATE,
    WIDTH,
    byte_tokenizer,
    lerobot_folder,
    published_weights,
    raw_observation,
    relative,
    tiny_model,
)

BEFORE = "policy_preprocessor"
FOLDED = f"{BEFORE}_step_5_normalizer_processor.safetensors"


def joints(count):
    return tuple(Joint(f"j{i}", "rad", -9.0, 9.0, 1.0, 1.0) for i in range(count))


ROBOT = EmbodimentSpec(
    "tiny",
    joints(ACTION),
    tuple(Camera(name, *shape) for name, shape in CAMERAS.items()),
    10.0,
    state_joints=joints(STATE),
)


@pytest.fixture(scope="module")
def golden():
    return load_file(GOLDEN / "smolvla.safetensors")


@pytest.fixture(scope="module")
def tokenizer(tmp_path_factory):
    return byte_tokenizer(tmp_path_factory.mktemp("tokenizer") / "bytes")


@pytest.fixture
def source(tmp_path):
    return lerobot_folder(tmp_path / "theirs")


def imported(source, target, tokenizer, *words):
    (target.parent / "robot.json").write_text(json.dumps(ROBOT.to_dict()))
    robot = ["--embodiment", str(target.parent / "robot.json"), "--rate", "10"]
    words = ["import-checkpoint", str(source), str(target), "--tokenizer", str(tokenizer), *words]
    assert main([*words, *robot]) == 0
    return target


def noise(seed=None, call=None):
    return fill.normal("noise", (1, HORIZON, WIDTH))


def as_buffers(source):
    """The folder as LeRobot wrote it before it had processors."""
    tensors = {
        n.replace("model.", "model._orig_mod.", 1): t for n, t in published_weights().items()
    }
    statistics = load_file(source / FOLDED)
    for prefix, feature in (
        ("normalize_inputs.buffer_observation_state", "observation.state"),
        ("normalize_targets.buffer_action", "action"),
        ("unnormalize_outputs.buffer_action", "action"),
    ):
        for name in ("mean", "std"):
            tensors[f"{prefix}.{name}"] = statistics[f"{feature}.{name}"].clone()
    save_file(tensors, source / "model.safetensors")
    for file in source.glob("policy_*"):
        file.unlink()
    return source


@pytest.mark.parametrize("layout", ["processors", "buffers"])
def test_it_acts_as_in_lerobot(source, tmp_path, tokenizer, golden, monkeypatch, layout, capsys):
    if layout == "buffers":
        as_buffers(source)
    out = imported(source, tmp_path / "ours", tokenizer)
    assert "SmolVLA, " in capsys.readouterr().out
    policy = load_policy(out)
    monkeypatch.setattr(policy, "_noise", noise)
    for number in (0, 1):
        chunk = policy.predict_action(raw_observation(number))
        expected = golden[f"act.{number}.actions"].double()
        assert chunk.shape == (HORIZON, ACTION)
        assert relative(torch.from_numpy(chunk), expected) < 1e-5
    assert stages_of(out, tmp_path / "measured") == DIVIDED


def test_in_bf16_it_acts_as_lerobot_does_in_bf16(source, tmp_path, tokenizer, golden, monkeypatch):
    out = imported(source, tmp_path / "ours", tokenizer)
    policy = load_policy(out, mixed_precision_dtype="bf16")
    monkeypatch.setattr(policy, "_noise", noise)
    for number in (0, 1):
        found = torch.from_numpy(policy.predict_action(raw_observation(number)))
        exact, lower = (golden[f"{kind}act.{number}.actions"].double() for kind in ("", "bf16."))
        assert 0 < relative(lower, exact) < 5e-2
        assert 0 < relative(found, exact) < 5e-2
        assert relative(found, lower) < 5e-2


def test_a_camera_that_the_robot_lacks_is_as_one_that_is_masked(
    source, tmp_path, tokenizer, monkeypatch, capsys
):
    first, *others = CAMERAS
    policy = load_policy(
        imported(source, tmp_path / "ours", tokenizer, "--camera", f"{first}=none")
    )
    assert f"cameras {', '.join(others)}; " in capsys.readouterr().out
    act, look, asked = policy.model.predict_action, policy.model.observe, []
    monkeypatch.setattr(policy.model, "observe", lambda **b: asked.append(b) or look(**b))
    policy.predict_action(raw_observation(0))
    monkeypatch.undo()
    batch = {**asked[0], "noise": torch.ones(1, *policy.model.action_shape)}
    gone = -torch.ones_like(batch["images"][:, :3])
    masks = torch.cat([torch.zeros(1, 1, dtype=torch.bool), batch["img_masks"].bool()], 1)
    with torch.no_grad():
        images = torch.cat([gone, batch["images"]], 1)
        torch.testing.assert_close(
            act(**batch), act(**{**batch, "images": images, "img_masks": masks})
        )
    with pytest.raises(UsageError, match=f"no such camera; it has {', '.join(CAMERAS)}"):
        LeRobotSmolVLA().read(source, str(tokenizer), absent=("none_such",))


def test_a_policy_continues_a_chunk(source, tmp_path, tokenizer):
    policy = load_policy(imported(source, tmp_path / "ours", tokenizer))
    policy.reset(0)
    free = policy.predict_action(raw_observation(0))
    rest = Continuation(actions=free + 0.1, weights=np.array([1, 1, 0.5, 0.2, 0, 0, 0]), frozen=2)
    assert policy.continues
    policy.reset(0)
    kept = policy.continue_action(raw_observation(0), rest)
    np.testing.assert_allclose(kept[:2], free[:2] + 0.1, atol=1e-5)
    assert np.abs(kept[2] - free[2] - 0.1).mean() < np.abs(free[2] - free[2] - 0.1).mean()


def test_observations_are_prepared_as_in_lerobot(source, tokenizer, golden):
    found = LeRobotSmolVLA().read(source, str(tokenizer))
    for number in range(3):
        observation = raw_observation(number)
        prepare = PrivateInferenceDataset(
            img_keys=tuple(observation["images"]),
            transforms=found.transforms,
            norm_stats=found.statistics,
        )
        batch = prepare(observation)
        assert torch.equal(batch["states"][0], golden[f"act.{number}.states"])
        tokens = batch["lang_tokens"][0][batch["lang_masks"][0]]
        assert torch.equal(tokens, golden[f"act.{number}.tokens"])
        assert torch.equal(batch["img_masks"][0], golden[f"act.{number}.img_masks"])
        if number == 0:
            images = batch["images"].unflatten(1, (-1, 3))[0][:, :, ::2, ::2]
            torch.testing.assert_close(images, golden["act.0.images"], rtol=0, atol=1e-6)
        model = tiny_model()
        with torch.no_grad():
            actions = model.predict_action(**batch, noise=torch.from_numpy(noise()))
        assert relative(actions[0, :, :ACTION], golden[f"act.{number}.normalized"]) < 1e-5


def test_the_model_resizes_as_the_transform_does(source, tokenizer):
    """Cameras of one size travel as they are, and the model resizes them."""
    settings = {"type": "SmolVLAImages", "empty_cameras": 1}
    observation = raw_observation(0)
    observation["images"]["wrist"] = observation["images"]["front"][::-1].copy()
    found = LeRobotSmolVLA().read(source, str(tokenizer))
    model, results = tiny_model(), []
    for table in (settings, {**settings, "height": 64, "width": 64}):
        transforms = [table, *found.transforms[1:]]
        prepare = PrivateInferenceDataset(tuple(CAMERAS), transforms, found.statistics)
        batch = prepare(observation)
        with torch.no_grad():
            results.append(model.predict_action(**batch, noise=torch.from_numpy(noise())))
    assert batch["images"].shape == (1, 9, 64, 64)
    assert relative(*results) < 1e-5


def test_it_goes_back_as_it_came(source, tmp_path, tokenizer, capsys):
    mixed = {
        name: tensor.bfloat16() if "vlm.model" in name else tensor
        for name, tensor in published_weights().items()
    }
    save_file(mixed, source / "model.safetensors")
    out = imported(source, tmp_path / "ours", tokenizer)
    assert main(["export", str(out), str(tmp_path / "back"), "--format", "lerobot"]) == 0

    back = tmp_path / "back"
    assert {p.name for p in back.iterdir()} == {p.name for p in source.iterdir()}
    for file in sorted(back.glob("*.safetensors")):
        ours, theirs = load_file(file), load_file(source / file.name)
        assert ours.keys() == theirs.keys()
        for name, tensor in theirs.items():
            assert ours[name].dtype == tensor.dtype
            assert torch.equal(ours[name], tensor), name
    for name in (BEFORE, "policy_postprocessor"):
        ours, theirs = (json.loads((f / f"{name}.json").read_text()) for f in (back, source))
        assert ours == theirs
    ours, theirs = (json.loads((f / "config.json").read_text()) for f in (back, source))
    assert {name: theirs[name] for name in ours} == ours
    once, again = LeRobotSmolVLA().read(source), LeRobotSmolVLA().read(back)
    assert (once.model, once.transforms, once.statistics) == (
        again.model,
        again.transforms,
        again.statistics,
    )


def edited(source, **changes):
    config = json.loads((source / "config.json").read_text())
    (source / "config.json").write_text(json.dumps({**config, **changes}))
    return source


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"adapt_to_pi_aloha": True}, "adapt_to_pi_aloha is True, False is known here"),
        ({"add_image_special_tokens": True}, "add_image_special_tokens is True, False"),
        ({"n_obs_steps": 2}, "n_obs_steps is 2, 1 is known"),
        ({"chunk_size": "many"}, "chunk_size is 'many', a whole number is expected"),
        (
            {"resize_imgs_with_padding": [32, 48]},
            r"is \[32, 48\], the vision tower is for \[64, 64",
        ),
        ({"num_vlm_layers": 8}, "num_vlm_layers is 8, the weights have 4"),
        ({"input_features": {}}, "there is no camera"),
    ],
)
def test_settings_of_another_model_are_refused(source, change, words):
    with pytest.raises(CheckpointError, match=words):
        LeRobotSmolVLA().read(edited(source, **change))


def processors(source, change):
    path = source / f"{BEFORE}.json"
    content = json.loads(path.read_text())
    change(content["steps"])
    path.write_text(json.dumps(content))
    return source


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda steps: steps.append({"registry_name": "relative"}), "the step 'relative' of"),
        (
            lambda steps: steps[5]["config"].update(eps=1e-5),
            "eps is 1e-05; .* with 1e-08",
        ),
        (lambda steps: steps[5].update(state_file="../x"), r"'../x' is not a file next to it"),
        (
            lambda steps: steps[5]["config"]["norm_map"].update(VISUAL="MEAN_STD"),
            "images are normalised by MEAN_STD",
        ),
        (
            lambda steps: steps[5]["config"]["norm_map"].update(STATE="LOG"),
            "'LOG' of STATE is not one of MEAN_STD",
        ),
    ],
)
def test_processors_that_do_something_else_are_refused(source, change, words):
    with pytest.raises(CheckpointError, match=words):
        LeRobotSmolVLA().read(processors(source, change))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"model.state_proj.bias": None}, "1 missing: model.state_proj.bias"),
        ({"model.other.bias": torch.zeros(1)}, "1 unexpected: model.other.bias"),
    ],
)
def test_other_tensors_are_refused_by_name(tmp_path, change, words):
    source = lerobot_folder(tmp_path / "theirs", **change)
    with pytest.raises(CheckpointError, match=words):
        LeRobotSmolVLA().read(source)


def test_a_tensor_of_another_shape_is_refused_at_import(tmp_path, tokenizer, capsys):
    source = lerobot_folder(tmp_path / "theirs", **{"model.state_proj.bias": torch.zeros(7)})
    words = ["import-checkpoint", str(source), str(tmp_path / "o"), "--tokenizer", str(tokenizer)]
    assert main(words) == 2
    assert "state_proj.bias: (7,) in the" in capsys.readouterr().err


def test_without_the_tokenizer_the_import_says_what_is_missing(source, tmp_path, capsys):
    assert main(["import-checkpoint", str(source), str(tmp_path / "ours")]) == 2
    assert "model_path 'a tiny SmolVLM' does not exist" in capsys.readouterr().err


def test_a_base_model_without_statistics_can_be_trained_on_and_drives_nothing(source, tokenizer):
    as_buffers(source)
    tensors = load_file(source / "model.safetensors")
    save_file(
        {n: t for n, t in tensors.items() if "normalize" not in n}, source / "model.safetensors"
    )
    found = LeRobotSmolVLA().read(source, str(tokenizer))
    assert found.notes == ("it has no statistics: it can be trained on, and drives no robot",)
    prepare = PrivateInferenceDataset(tuple(CAMERAS), found.transforms, found.statistics)
    with pytest.raises(ConfigError, match="the statistics have no entry 'proprio'"):
        prepare(raw_observation(0))


def test_where_nothing_is_normalised_no_statistics_are_needed(source, tmp_path, tokenizer):
    nothing = {"VISUAL": "IDENTITY", "STATE": "IDENTITY", "ACTION": "IDENTITY"}
    for name in (BEFORE, "policy_postprocessor"):
        file = source / f"{name}.json"
        content = json.loads(file.read_text())
        for step in content["steps"]:
            if step.pop("state_file", None):
                step["config"]["norm_map"] = nothing
        file.write_text(json.dumps(content))
    found = LeRobotSmolVLA().read(source, str(tokenizer))
    assert found.notes == ()
    prepare = PrivateInferenceDataset(tuple(CAMERAS), found.transforms, found.statistics)
    observation = raw_observation(0)
    states = prepare(observation)["states"][0, :STATE]
    assert np.array_equal(states.numpy(), observation["qpos"])
    policy = load_policy(imported(source, tmp_path / "ours", tokenizer))
    assert policy.predict_action(raw_observation(0)).shape == (HORIZON, ACTION)


def leaves(tree, path=()):
    """Paths to everything in a JSON tree."""
    items = tree.items() if isinstance(tree, dict) else enumerate(tree)
    for key, value in items:
        yield (*path, key)
        if isinstance(value, dict | list):
            yield from leaves(value, (*path, key))


WRONG = (None, -3, 1.5, "other", [], {}, [[]], {"a": 1}, True)


@pytest.mark.parametrize(
    "shift", [0, *(pytest.param(n, marks=pytest.mark.slow) for n in range(1, len(WRONG)))]
)
def test_whatever_the_files_hold_is_read_or_refused(source, shift):
    refused = 0
    for file in ("config.json", f"{BEFORE}.json", "policy_postprocessor.json"):
        text = (source / file).read_text()
        for number, path in enumerate(leaves(json.loads(text))):
            changed = json.loads(text)
            place = changed
            for key in path[:-1]:
                place = place[key]
            place[path[-1]] = WRONG[(number + shift) % len(WRONG)]
            (source / file).write_text(json.dumps(changed))
            try:
                LeRobotSmolVLA().read(source)
            except FluxError:
                refused += 1
        (source / file).write_text(text)
    assert refused > 20


def test_what_is_not_smolvlas_is_not_recognized(tmp_path):
    (tmp_path / "config.json").write_text('{"type": "act"}')
    assert not LeRobotSmolVLA().recognizes(tmp_path)
    (tmp_path / "config.json").write_text("[" * 10_000)
    assert not LeRobotSmolVLA().recognizes(tmp_path)
    assert not LeRobotSmolVLA().recognizes(tmp_path / "nowhere")


@pytest.mark.parametrize("norm", ["mean_std", "min_max", "quantile", "quantile10", "none"])
def test_normalisation_is_undone(norm):
    from fluxvla_smolvla.normalization import SmolVLANormalize

    rng = np.random.default_rng(0)
    low = rng.normal(size=4)
    table = {"mean": low, "min": low, "q01": low, "q10": low}
    high = {"std": abs(low), "max": low + 2, "q99": low + 1, "q90": low + 0.5}
    table = {name: values.tolist() for name, values in {**table, **high}.items()}
    stats = {"proprio": table, "action": table}
    transform = SmolVLANormalize(state_norm=norm, action_norm=norm)
    actions = rng.normal(size=(3, 4))
    sample = {"states": actions[0], "actions": actions, "stats": stats}
    found = transform(sample)
    assert found["states"].shape == (32,)
    assert found["actions"].shape == (3, 32)
    assert (found["actions"][:, 4:] == 0).all()
    back = transform.denormalizer({"private": stats})({"action": found["actions"][None]})
    np.testing.assert_allclose(back, actions, atol=1e-5)
