"""LeRobot's checkpoints: they act here as there, and go back as they came."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from fluxvla_pi import lerobot_write
from fluxvla_pi.lerobot_format import LeRobotPiFormat
from fluxvla_pi.names import LEROBOT
from safetensors.torch import load_file, save_file

from fluxvla_core import build_runner_from_cfg
from fluxvla_core.checkpoints.foreign import read_foreign
from fluxvla_core.cli.main import main
from fluxvla_core.data import PrivateInferenceDataset
from fluxvla_core.errors import CheckpointError, ConfigError, UsageError
from fluxvla_core.models import load_policy
from fluxvla_core.operators import RunContext
from fluxvla_core.testing.training import OneProcessRunner
from fluxvla_core.training.export import export_foreign
from tests.policies.benched import DIVIDED, stages_of

from .oracles import pi_inputs
from .published_folders import (
    GOLDEN,
    lerobot_folder,
    observation,
    robot_file,
    tokenizer_folder,
    weights,
)

FAMILIES = ("pi0", "pi05")
assert OneProcessRunner  # registers itself


@pytest.fixture
def bring(tmp_path):
    """Import a checkpoint for the robot."""
    words = tokenizer_folder(tmp_path / "words")
    robot = robot_file(tmp_path / "robot.json")

    def run(source, *more):
        out = tmp_path / "ours"
        told = ["--tokenizer", str(words), "--embodiment", str(robot), "--rate", "10", *more]
        assert main(["import-checkpoint", str(source), str(out), *told]) == 0
        return out

    return run


@pytest.mark.parametrize("family", FAMILIES)
def test_it_acts_as_there_from_images_and_joints_to_commands(tmp_path, bring, family):
    golden = load_file(GOLDEN / f"lerobot061_{family}_policy.safetensors")
    out = bring(lerobot_folder(tmp_path / "theirs", family))
    policy = load_policy(out)
    policy.reset(pi_inputs.SEED)
    found = policy.predict_action(observation(family))
    expected = golden["commands"][0].double().numpy()
    assert found.shape == expected.shape == (pi_inputs.HORIZON, pi_inputs.ROBOT_ACTIONS)
    assert np.abs(found - expected).max() < 1e-5 * np.abs(expected).max()
    assert stages_of(out, tmp_path / "measured") == DIVIDED


@pytest.mark.parametrize("family", FAMILIES)
def test_in_bf16_it_differs_no_more_than_there(tmp_path, bring, family):
    golden = load_file(GOLDEN / f"lerobot061_{family}_policy.safetensors")
    source, theirs = lerobot_folder(tmp_path / "theirs", family), weights(family, LEROBOT)
    narrow = dict(zip(sorted(theirs), golden["bf16.dtypes"].tolist(), strict=True))
    assert 0 < sum(narrow.values()) < len(narrow)
    mixed = {name: t.bfloat16() if narrow[name] else t for name, t in theirs.items()}
    save_file(mixed, source / "model.safetensors", {"format": "pt"})
    policy = load_policy(bring(source))
    policy.reset(pi_inputs.SEED)
    found = policy.predict_action(observation(family))
    exact, expected = (golden[n][0].double().numpy() for n in ("commands", "bf16.commands"))
    rounding = np.abs(expected - exact).max()
    assert rounding < 5e-2 * np.abs(exact).max()
    assert 0 < np.abs(found - exact).max() < 2 * rounding
    assert np.abs(found - expected).max() < 2 * rounding


@pytest.mark.parametrize("family", FAMILIES)
def test_what_the_model_gets_is_what_it_gets_there(tmp_path, family):
    golden = load_file(GOLDEN / f"lerobot061_{family}_policy.safetensors")
    words = tokenizer_folder(tmp_path / "words")
    read = LeRobotPiFormat().read(lerobot_folder(tmp_path / "theirs", family), str(words))
    prepare = PrivateInferenceDataset(read.img_keys, read.transforms, read.statistics)
    batch = prepare(observation(family))
    assert torch.equal(batch["lang_tokens"], golden["tokens"])
    assert torch.equal(batch["lang_masks"], golden["token_masks"])
    count = len(read.img_keys)
    assert count == 2
    for i, image in enumerate(batch["images"][0].unflatten(0, (count, 3))):
        torch.testing.assert_close(image, golden[f"picture.{i}"][0], rtol=0, atol=2e-6)
        assert golden[f"picture_mask.{i}"].all()
    masks = [golden[name] for name in golden if name.startswith("picture_mask.")]
    assert not any(mask.any() for mask in masks[count:])  # cameras that are never there
    states = batch["states"][:, : pi_inputs.ROBOT_STATES]
    torch.testing.assert_close(states, golden["normalized_states"], rtol=1e-5, atol=1e-6)
    actions = {"states": pi_inputs.observation()[1], "actions": pi_inputs.chunk()[0]}
    normalize = prepare.pipeline.transforms[2]
    found = normalize({**actions, "stats": read.statistics["private"]})["actions"]
    assert found.shape == (pi_inputs.HORIZON, pi_inputs.ACTIONS)
    assert not found[:, pi_inputs.ROBOT_ACTIONS :].any()
    expected = golden["normalized_actions"][0].numpy()
    # One action never moved: what it is divided by is 1e-8, and float32 has no digits left of it.
    moves = np.arange(pi_inputs.ROBOT_ACTIONS) != 2
    np.testing.assert_allclose(
        found[:, : pi_inputs.ROBOT_ACTIONS][:, moves], expected[:, moves], rtol=1e-5, atol=2e-6
    )


@pytest.mark.parametrize("family", FAMILIES)
def test_it_goes_back_as_it_came(tmp_path, bring, monkeypatch, family):
    source = lerobot_folder(tmp_path / "theirs", family)
    out = bring(source)
    model = LeRobotPiFormat().read(source).model
    sizes = {key: model[key] for key in ("variant", "expert_variant", "vision_variant")}
    monkeypatch.setattr(lerobot_write, "_VARIANTS", sizes)
    monkeypatch.setattr(lerobot_write, "VOCABULARY", pi_inputs.VOCABULARY)
    assert main(["export", str(out), str(tmp_path / "back"), "--format", "lerobot"]) == 0

    ours, theirs = load_file(tmp_path / "back" / "model.safetensors"), weights(family, LEROBOT)
    assert ours.keys() == theirs.keys()
    free = {LEROBOT.head, *LEROBOT.unused}
    assert all(torch.equal(ours[name], theirs[name]) for name in ours.keys() - free)
    embedding = LEROBOT.theirs("llm_backbone.embed_tokens.weight")
    assert torch.equal(ours[LEROBOT.head], theirs[embedding])

    config, written = (
        json.loads((f / "config.json").read_text()) for f in (source, tmp_path / "back")
    )
    cameras = [key for key in written["input_features"] if "images" in key]
    assert cameras == [k for k in config["input_features"] if "images" in k and "empty" not in k]
    for table in (config["input_features"], written["input_features"]):
        table.pop("observation.images.empty_camera_0", None)
    assert {key: config[key] for key in written} == written
    for name in ("policy_preprocessor", "policy_postprocessor"):
        before, after = (
            json.loads((f / f"{name}.json").read_text()) for f in (source, tmp_path / "back")
        )
        for step in before["steps"]:
            step["config"].get("features", {}).pop("observation.images.empty_camera_0", None)
        assert after == before
    for file in source.glob("policy_*.safetensors"):
        one, other = load_file(file), load_file(tmp_path / "back" / file.name)
        assert one.keys() == other.keys()
        for key in one:
            torch.testing.assert_close(one[key], other[key], rtol=0, atol=0)


@pytest.mark.parametrize("family", FAMILIES)
def test_statistics_among_the_weights(tmp_path, family):
    """As LeRobot before 0.4 saved them, with infinity where there were none."""
    source = lerobot_folder(tmp_path / "theirs", family)
    expected = LeRobotPiFormat().read(source).statistics["private"]
    stats = pi_inputs.statistics()
    names = ("mean", "std") if family == "pi0" else ("min", "max")
    buffers = {}
    for name in names:
        state, action = (torch.from_numpy(stats[key][name]) for key in stats)
        buffers[f"normalize_inputs.buffer_observation_state.{name}"] = state
        buffers[f"normalize_targets.buffer_action.{name}"] = action
        buffers[f"unnormalize_outputs.buffer_action.{name}"] = action.clone()
    save_file({**weights(family, LEROBOT), **buffers}, source / "model.safetensors")
    for file in source.glob("policy_*"):
        file.unlink()
    config = json.loads((source / "config.json").read_text())
    mode = "MEAN_STD" if family == "pi0" else "MIN_MAX"
    config["normalization_mapping"] = {"VISUAL": "IDENTITY", "STATE": mode, "ACTION": mode}
    (source / "config.json").write_text(json.dumps(config))
    read = LeRobotPiFormat().read(source)
    numbers = next(t for t in read.transforms if t["type"] == "NormalizeStatesAndActions")
    assert numbers["norm_type"] == numbers["state_norm_type"] == mode.lower()
    assert numbers["epsilon_if_zero"] is False
    for entry in ("proprio", "action"):
        for name in names:
            assert read.statistics["private"][entry][name] == expected[entry][name]


def test_a_camera_that_the_robot_lacks(tmp_path, bring, capsys):
    out = bring(lerobot_folder(tmp_path / "theirs", "pi05"), "--camera", "wrist=none")
    assert "cameras front; " in capsys.readouterr().out
    policy = load_policy(out)
    policy.reset(pi_inputs.SEED)
    chunk = policy.predict_action(observation("pi05"))
    assert chunk.shape == (pi_inputs.HORIZON, pi_inputs.ROBOT_ACTIONS)
    with pytest.raises(UsageError, match="no such camera; it has front, wrist"):
        LeRobotPiFormat().read(tmp_path / "theirs", absent=("top",))
    with pytest.raises(UsageError, match=r"--robot x: .* is of one robot, which has no name"):
        read_foreign(tmp_path / "theirs", "lerobot", robot="x")


def test_a_base_model_without_statistics_drives_nothing(tmp_path, bring, monkeypatch):
    source = lerobot_folder(tmp_path / "theirs", "pi05")
    for name in ("policy_preprocessor.json", "policy_postprocessor.json"):
        changed(source / name, lambda c: [step.pop("state_file", None) for step in c["steps"]])
    read = LeRobotPiFormat().read(source)
    assert "it is a base model, to be fine-tuned; it drives no robot" in read.notes[0]
    out = bring(source)
    with pytest.raises(ConfigError, match=r"the statistics have no entry 'proprio'.*nothing") as no:
        load_policy(out)
    assert no.value.where == str(out)
    sizes = {key: read.model[key] for key in ("variant", "expert_variant", "vision_variant")}
    monkeypatch.setattr(lerobot_write, "_VARIANTS", sizes)
    monkeypatch.setattr(lerobot_write, "VOCABULARY", pi_inputs.VOCABULARY)
    with pytest.raises(CheckpointError, match="has no statistics of proprio, action"):
        export_foreign(out, tmp_path / "back", "lerobot")


def changed(file, change):
    content = json.loads(file.read_text())
    change(content)
    file.write_text(json.dumps(content))


def step(content, name):
    return next(s for s in content["steps"] if s["registry_name"] == name)


def test_cameras_that_lerobot_renames_have_the_robots_names(tmp_path):
    """Here each of the two is called as the policy calls the other one."""
    source = lerobot_folder(tmp_path / "theirs", "pi05")
    images = [f"observation.images.{name}" for name in ("front", "wrist")]
    swapped = dict(zip(images, reversed(images), strict=True))
    changed(
        source / "policy_preprocessor.json",
        lambda c: step(c, "rename_observations_processor")["config"].update(rename_map=swapped),
    )
    assert LeRobotPiFormat().read(source).img_keys == tuple(reversed(images))


def test_what_makes_physical_actions_has_the_last_word(tmp_path):
    source = lerobot_folder(tmp_path / "theirs", "pi05")
    (file,) = source.glob("policy_postprocessor*.safetensors")
    stats = load_file(file)
    save_file({name: row + 1 for name, row in stats.items()}, file)
    read = LeRobotPiFormat().read(source).statistics["private"]
    assert read["action"]["q01"] == pytest.approx((stats["action.q01"] + 1).tolist())
    assert read["proprio"]["q01"] == pytest.approx(stats["observation.state.q01"].tolist())


@pytest.mark.parametrize(
    ("file", "change", "words"),
    [
        (
            "policy_postprocessor.json",
            lambda c: step(c, "absolute_actions_processor")["config"].update(enabled=True),
            "enabled of absolute_actions_processor is True, of relative_actions_processor False",
        ),
        ("config.json", lambda c: c.update(use_peft=True), "use_peft is True; False is read"),
        ("config.json", lambda c: c.update(max_period=2.0), "max_period is 2.0; 4.0 is read"),
        ("config.json", lambda c: c.update(chunk_size="x"), "chunk_size is 'x', not a number"),
        ("config.json", lambda c: c.update(type="pi0"), "type is pi0, the weights are .* pi05"),
        ("config.json", lambda c: c["input_features"].pop("observation.state"), "no shape of one"),
        ("config.json", lambda c: c.update(input_features=[]), "input_features is no table"),
        ("config.json", lambda c: c["output_features"].update(action=3), "is no table of features"),
        ("config.json", lambda c: c.update(image_resolution=224), "is 224, not two numbers"),
        (
            "policy_preprocessor.json",
            lambda c: step(c, "tokenizer_processor")["config"].update(max_length="long"),
            "max_length is 'long'",
        ),
        (
            "policy_preprocessor.json",
            lambda c: step(c, "normalizer_processor")["config"].update(eps=None),
            "eps is None",
        ),
        ("policy_preprocessor.json", lambda c: c.update(steps=3), "no list of steps"),
        (
            "policy_preprocessor.json",
            lambda c: c["steps"].append({"class": "their.Step", "config": {}}),
            "the step 'their.Step' of the processors is not known",
        ),
        (
            "policy_postprocessor.json",
            lambda c: c["steps"].append({"registry_name": "their_clip", "config": {}}),
            "the step 'their_clip' of the processors is not known",
        ),
        (
            "policy_preprocessor.json",
            lambda c: c["steps"].remove(step(c, "normalizer_processor")),
            "there is no step normalizer_processor",
        ),
        (
            "policy_preprocessor.json",
            lambda c: step(c, "normalizer_processor")["config"]["norm_map"].update(
                STATE="QUANTILE10"
            ),
            "'STATE': 'QUANTILE10'.* are not known here",
        ),
        (
            "policy_preprocessor.json",
            lambda c: step(c, "normalizer_processor").update(state_file="../x.safetensors"),
            "'../x.safetensors' is not a file next to it",
        ),
        (
            "policy_preprocessor.json",
            lambda c: step(c, "normalizer_processor").update(state_file="x.safetensors"),
            "state_file x.safetensors is missing",
        ),
    ],
)
def test_what_cannot_be_read_is_told(tmp_path, file, change, words):
    source = lerobot_folder(tmp_path / "theirs", "pi05")
    changed(source / file, change)
    with pytest.raises(CheckpointError, match=words):
        LeRobotPiFormat().read(source)


def test_other_folders_are_not_recognised(tmp_path):
    assert LeRobotPiFormat().recognizes(lerobot_folder(tmp_path / "theirs", "pi0"))
    (tmp_path / "config.json").write_text('{"type": "act"}')
    assert not LeRobotPiFormat().recognizes(tmp_path)
    (tmp_path / "config.json").write_text("[")
    assert not LeRobotPiFormat().recognizes(tmp_path)
    assert not LeRobotPiFormat().recognizes(tmp_path / "nowhere")


def test_a_training_starts_from_it(tmp_path):
    source = lerobot_folder(tmp_path / "theirs", "pi05")
    read = LeRobotPiFormat().read(source)
    config = {
        "model": {**read.model, "pretrained_name_or_path": str(source)},
        "train_dataloader": {"per_device_batch_size": 1},
        "runner": {
            "type": "OneProcessRunner",
            "learning_rate": 1e-3,
            "max_steps": 1,
            "collator": {"type": "DictCollator", "keys": ["images"]},
        },
    }
    context = RunContext(config=config, section="runner", work_dir=tmp_path / "run")
    runner = build_runner_from_cfg(config["runner"], context)
    runner.run_setup(4)
    theirs, ours = weights("pi05", LEROBOT), runner.vla.state_dict()
    assert all(torch.equal(ours[name], theirs[LEROBOT.theirs(name)]) for name in ours)
