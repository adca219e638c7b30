"""LeRobot's names and files: every name is mapped, old and new statistics, and what is refused."""

from __future__ import annotations

import json
import math
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from fluxvla_models.act import ACT
from fluxvla_models.diffusion_policy import DiffusionPolicy
from fluxvla_models.lerobot_format import LeRobotACT, LeRobotDiffusion
from fluxvla_models.lerobot_names import act_name, diffusion_name
from safetensors.torch import load_file, save_file

from fluxvla_core.build import RunContext, build_runner_from_cfg
from fluxvla_core.cli.main import main
from fluxvla_core.contracts.runner import SilentReporter
from fluxvla_core.errors import CheckpointError
from fluxvla_core.testing import training  # noqa: F401 - registers OneProcessRunner

TESTS = Path(__file__).parent
ACT_FOLDER = TESTS / "golden" / "lerobot_act"
DIFFUSION_FOLDER = TESTS / "golden" / "lerobot_diffusion"
NORMALIZER = "policy_preprocessor_step_3_normalizer_processor.safetensors"
# As LeRobot builds them for ALOHA and PushT; last the number of parameters.
FULL = {
    "lerobot_act": (ACT, act_name, {}, 51_613_582),
    "lerobot_diffusion": (
        DiffusionPolicy,
        diffusion_name,
        {"state_dim": 2, "action_dim": 2, "n_obs_steps": 2},
        262_709_026,
    ),
    "lerobot_diffusion_two_encoders": (
        DiffusionPolicy,
        diffusion_name,
        {
            "state_dim": 2,
            "action_dim": 2,
            "n_obs_steps": 2,
            "num_cameras": 2,
            "separate_encoders": True,
        },
        277_576_130,
    ),
}


@pytest.mark.parametrize("published", FULL)
def test_every_published_name_is_one_of_ours(published: str) -> None:
    kind, our_name, table, parameters = FULL[published]
    theirs = json.loads((TESTS / "keys" / f"{published}.json").read_text())
    settings = dict(table)
    if kind is DiffusionPolicy:
        settings["backbone_norm"] = "batch"
    with torch.device("meta"):
        model = kind(**settings)
    mapped = [(our_name(name), shape) for name, shape in theirs.items()]
    found = dict(pair for pair in mapped if pair[0] is not None)
    dropped = sorted(name for name in theirs if our_name(name) is None)
    assert len(found) + len(dropped) == len(theirs)
    assert all(name.endswith(("pos_grid", "vae_encoder_pos_enc")) for name in dropped)
    assert found == {name: list(t.shape) for name, t in model.state_dict().items()}
    assert sum(math.prod(p.shape) for p in model.parameters()) == parameters


def weights(folder: Path) -> dict[str, torch.Tensor]:
    """Any weights of the right names and shapes."""
    config = json.loads((folder / "config.json").read_text())
    format = LeRobotACT() if config["type"] == "act" else LeRobotDiffusion()
    table = format.model(config, str(folder))
    torch.manual_seed(0)
    model = {"ACT": ACT, "DiffusionPolicy": DiffusionPolicy}[table.pop("type")](**table)
    # None is what a new model would have.
    return {f"model.{name}": tensor + 0.125 for name, tensor in model.state_dict().items()}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "theirs"
    shutil.copytree(ACT_FOLDER, made)
    save_file(weights(made), made / "model.safetensors")
    return made


def change(path: Path, **values: object) -> None:
    path.write_text(json.dumps({**json.loads(path.read_text()), **values}))


def test_statistics_among_the_weights_are_the_same(folder: Path) -> None:
    """As LeRobot saved them before its version 0.4."""
    new = LeRobotACT().read(folder)
    among: dict[str, torch.Tensor] = {}
    for name, value in load_file(folder / NORMALIZER).items():
        feature, _, statistic = name.rpartition(".")
        buffer = f"buffer_{feature.replace('.', '_')}.{statistic}"
        groups = ("normalize_targets", "unnormalize_outputs")
        for group in groups if feature == "action" else ("normalize_inputs",):
            among[f"{group}.{buffer}"] = value.clone()
    save_file({**weights(folder), **among}, folder / "model.safetensors")
    for file in folder.glob("policy_*"):
        file.unlink()
    old = LeRobotACT().read(folder)
    assert old.statistics == new.statistics
    assert old.transforms == new.transforms
    assert set(old.tensors) == set(new.tensors)


@pytest.mark.parametrize("mode", ["MEAN_STD", "MIN_MAX", "QUANTILES", "QUANTILE10", "IDENTITY"])
def test_normalising_by_each_mode(folder: Path, mode: str) -> None:
    """The transform gives LeRobot's formula, written out here, and its inverse gives commands."""
    from fluxvla_core.data import Pipeline

    stats = load_file(folder / NORMALIZER)
    for low, high in (("q01", "q99"), ("q10", "q90")):
        stats[f"action.{low}"] = stats["action.min"] / 2
        stats[f"action.{high}"] = stats["action.max"] / 2
    for name in ("min", "max", "q01", "q99", "q10", "q90"):  # one that never moves
        stats[f"action.{name}"][2] = stats["action.mean"][2]
    save_file(stats, folder / NORMALIZER)
    after = folder / "policy_postprocessor_step_0_unnormalizer_processor.safetensors"
    save_file(stats, after)
    modes = {"VISUAL": "MEAN_STD", "STATE": "IDENTITY", "ACTION": mode}
    for file in ("policy_preprocessor.json", "policy_postprocessor.json"):
        content = json.loads((folder / file).read_text())
        for step in content["steps"]:
            if "norm_map" in step.get("config", {}):
                step["config"]["norm_map"] = modes
        change(folder / file, **content)
    found = LeRobotACT().read(folder)
    pipeline = Pipeline([found.transforms[-1]])
    entry = found.statistics["private"]
    actions = np.random.default_rng(0).normal(size=(8, 6)).astype(np.float32)
    actions[:, 2] = stats["action.mean"][2]
    states = np.arange(6, dtype=np.float32)
    sample = pipeline({"states": states, "actions": actions, "stats": entry})
    own = {k.removeprefix("action."): v.numpy() for k, v in stats.items() if k.startswith("action")}
    if mode == "MEAN_STD":
        expected = (actions - own["mean"]) / (own["std"] + 1e-8)
    elif mode == "IDENTITY":
        expected = actions
    else:
        low, high = {"MIN_MAX": ("min", "max"), "QUANTILES": ("q01", "q99")}.get(
            mode, ("q10", "q90")
        )
        wide = own[high] - own[low]
        expected = 2 * (actions - own[low]) / np.where(wide == 0, 1e-8, wide) - 1
        assert (expected[:, 2] == -1).all()
    np.testing.assert_allclose(sample["actions"], expected, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(sample["states"], states, rtol=1e-6)


@pytest.mark.parametrize(
    ("change_config", "told"),
    [
        ({"n_obs_steps": 2}, "n_obs_steps is 2, only 1 is built here"),
        ({"replace_final_stride_with_dilation": True}, "replace_final_stride_with_dilation is Tr"),
        ({"vision_backbone": "resnet50"}, "'resnet50' of a residual network is not one of resnet1"),
        ({"latent_dim": 7}, "of another size"),
        ({"output_features": {}}, "output_features has no action; it has nothing"),
        ({"input_features": {}}, "cameras with images of one size .* has none"),
    ],
)
def test_what_is_not_built_here_is_refused_in_words(
    folder: Path, tmp_path: Path, capsys, change_config: dict, told: str
) -> None:
    change(folder / "config.json", **change_config)
    assert main(["import-checkpoint", str(folder), str(tmp_path / "ours")]) == 2
    assert re.search(told, capsys.readouterr().err)
    assert not (tmp_path / "ours").exists()


@pytest.mark.parametrize("steps", [0, 9, "2", None])
def test_numbers_of_observations_that_make_no_sense(tmp_path: Path, steps: object) -> None:
    made = tmp_path / "theirs"
    shutil.copytree(TESTS / "golden" / "lerobot_diffusion_history", made)
    change(made / "config.json", n_obs_steps=steps)
    with pytest.raises(CheckpointError, match=rf"n_obs_steps is {steps!r}, not .* to horizon 8"):
        LeRobotDiffusion().read(made)


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({"input_features": [1]}, "input_features is no table"),
        (
            {"output_features": {"action": {"shape": "6"}}},
            r"output_features\.action is .* not a sh",
        ),
        ({"output_features": {"action": {"shape": [2, 3]}}}, r"action is \(2, 3\), a vector is"),
        ({"chunk_size": "long"}, "chunk_size"),
        ({"normalization_mapping": 3}, "normalization_mapping is no table"),
    ],
)
def test_a_config_that_nobody_wrote(folder: Path, values: dict, told: str) -> None:
    change(folder / "config.json", **values)
    with pytest.raises(CheckpointError, match=told):
        LeRobotACT().read(folder)


def test_processors_that_nobody_wrote(folder: Path) -> None:
    file = folder / "policy_preprocessor.json"
    content = json.loads(file.read_text())
    for values, told in (
        ({"config": 3}, "config is no table"),
        ({"config": {"eps": "x"}}, "eps is 'x'; a normalizer with 1e-08 is read"),
        ({"config": {"eps": 1e-5}}, "eps is 1e-05; a normalizer with 1e-08 is read"),
        (
            {"config": {"normalize_observation_keys": []}},
            r"normalize_observation_keys is \[\]; a normalizer with None is read",
        ),
        ({"state_file": "../x.safetensors"}, "not a file next to it"),
        ({"state_file": "x.safetensors"}, r"x\.safetensors"),
    ):
        steps = [{**step, **values} if "state_file" in step else step for step in content["steps"]]
        change(file, steps=steps)
        with pytest.raises(CheckpointError, match=told):
            LeRobotACT().read(folder)
    for text in ("[]", "{", '{"steps": 3}'):
        file.write_text(text)
        with pytest.raises(CheckpointError, match=r"policy_preprocessor\.json"):
            LeRobotACT().read(folder)


@pytest.mark.parametrize("stem", ["policy_preprocessor", "policy_postprocessor"])
def test_a_step_that_is_not_done_here_is_refused(folder: Path, stem: str) -> None:
    """It would change what the robot is told, and be lost without a word."""
    file = folder / f"{stem}.json"
    steps = json.loads(file.read_text())["steps"]
    more = {"registry_name": "absolute_actions_processor", "config": {"enabled": True}}
    change(file, steps=[*steps, more])
    with pytest.raises(CheckpointError, match=r"'absolute_actions_processor' .* not known here"):
        LeRobotACT().read(folder)


def test_what_makes_physical_actions_has_the_last_word(folder: Path) -> None:
    (file,) = folder.glob("policy_postprocessor*_processor.safetensors")
    stats = load_file(file)
    moved = {name: stats[name] + 1.0 for name in ("action.mean", "observation.state.mean")}
    save_file({**stats, **moved}, file)
    read = LeRobotACT().read(folder).statistics["private"]
    assert read["action"]["mean"] == pytest.approx(moved["action.mean"].tolist())
    assert read["proprio"]["mean"] == pytest.approx(stats["observation.state.mean"].tolist())


def test_a_missing_statistic_and_a_missing_file(folder: Path) -> None:
    stats = load_file(folder / NORMALIZER)
    for path in folder.glob("policy_*_processor.safetensors"):
        save_file({k: v for k, v in stats.items() if k != "action.std"}, path)
    with pytest.raises(CheckpointError, match=r"action is normalised by MEAN_STD.*no std; they "):
        LeRobotACT().read(folder)
    for path in folder.glob("policy_*"):
        path.unlink()
    with pytest.raises(CheckpointError, match=r"neither policy_pre.* nor statistics"):
        LeRobotACT().read(folder)


def test_missing_extra_and_misshapen_tensors_are_listed(
    folder: Path, tmp_path: Path, capsys
) -> None:
    tensors = weights(folder)
    del tensors["model.action_head.bias"]
    tensors["model.surplus"] = torch.zeros(1)
    tensors["model.decoder_pos_embed.weight"] = torch.zeros(9, 32)
    save_file(tensors, folder / "model.safetensors")
    assert main(["import-checkpoint", str(folder), str(tmp_path / "ours")]) == 2
    told = capsys.readouterr().err
    for words in ("action_head.bias", "surplus", "decoder_pos_embed.weight: (9, 32)"):
        assert words in told


@pytest.mark.parametrize("by_model", [True, False])
def test_a_training_starts_from_lerobots_weights(
    folder: Path, tmp_path: Path, by_model: bool
) -> None:
    model = LeRobotACT().model(json.loads((folder / "config.json").read_text()), str(folder))
    runner = {"type": "OneProcessRunner", "max_steps": 1, "learning_rate": 1e-3}
    keys = ["images", "states", "actions", "action_masks", "latent_noise"]
    runner["collator"] = {"type": "DictCollator", "keys": keys}
    place = {"pretrained_name_or_path": str(folder)} if by_model else {}
    config = {
        "model": {**model, **place},
        "train_dataloader": {"per_device_batch_size": 2},
        "runner": runner if by_model else {**runner, "init_from": str(folder)},
    }
    context = RunContext(
        config=config,
        section="runner",
        work_dir=tmp_path / "work",
        resume=None,
        reporter=SilentReporter(),
    )
    built = build_runner_from_cfg(config["runner"], context)
    built.run_setup(4)
    found = {f"model.{name}": tensor for name, tensor in built.vla.state_dict().items()}
    expected = weights(folder)
    assert found.keys() == expected.keys()
    assert all(torch.equal(found[name], expected[name]) for name in expected)


def test_folders_of_other_things_are_not_recognised(tmp_path: Path, folder: Path) -> None:
    assert LeRobotACT().recognizes(folder)
    assert not LeRobotDiffusion().recognizes(folder)
    assert LeRobotDiffusion().recognizes(DIFFUSION_FOLDER)
    assert not LeRobotACT().recognizes(tmp_path)
    for content in ("", "[]", '{"type": "act"}', "\xff"):
        (tmp_path / "config.json").write_text(content, encoding="latin-1")
        assert not LeRobotACT().recognizes(tmp_path)


def test_cameras_that_lerobot_renames_keep_the_robots_name(folder: Path) -> None:
    content = json.loads((folder / "policy_preprocessor.json").read_text())
    names = {"observation.images.top": "observation.images.front"}
    content["steps"][0]["config"]["rename_map"] = names
    change(folder / "policy_preprocessor.json", **content)
    assert LeRobotACT().read(folder).img_keys == (
        "observation.images.top",
        "observation.images.wrist",
    )


def test_what_lerobot_executes_is_told(folder: Path) -> None:
    assert LeRobotACT().read(folder).notes == (
        "LeRobot executes 5 of 8 actions: execute_horizon=5",
    )
    change(folder / "config.json", temporal_ensemble_coeff=0.01)
    assert "temporal_ensemble" in LeRobotACT().read(folder).notes[0]
