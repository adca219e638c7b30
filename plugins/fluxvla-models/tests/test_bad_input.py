"""Bad input to ACT, Diffusion Policy and parts of others: errors, from the command line."""

from __future__ import annotations

import math
import re
import shutil
from pathlib import Path

import pytest
import torch
from fluxvla_models.act import ACT
from fluxvla_models.diffusion_policy import DiffusionPolicy
from fluxvla_models.film_projector import FiLMProjector
from fluxvla_models.flow_matching_head import FlowMatchingHead
from fluxvla_models.llava_action_head import LlavaActionHead
from safetensors.torch import load_file, save_file

from fluxvla_core.errors import ConfigError
from tests.policies.refused import change_json, checked_with_transformers, import_refused

from .test_lerobot_format import ACT_FOLDER, DIFFUSION_FOLDER, weights
from .test_trained_alike import TABLES

FOLDERS = {"act": ACT_FOLDER, "diffusion": DIFFUSION_FOLDER}
MODELS = {"act": ACT, "diffusion": DiffusionPolicy}


@pytest.fixture(params=FOLDERS)
def source(request, tmp_path):
    made = tmp_path / request.param
    shutil.copytree(FOLDERS[request.param], made)
    prefix = "model." if request.param == "act" else "diffusion."
    named = {prefix + n.removeprefix("model."): t for n, t in weights(made).items()}
    save_file(named, made / "model.safetensors")
    return made


def test_a_setting_that_is_not_known(source, capsys):
    more = {"use_relative_ee": True, "optimizer_more": 1, "off": 0}
    change_json(source / "config.json", lambda c: c.update(more))
    said = import_refused(source, [], capsys)
    assert "config.json: use_relative_ee is 'True', and no setting of that name" in said


def change_statistics(source, change):
    for file in source.glob("policy_*.safetensors"):
        rows = {name: change(name, row) for name, row in load_file(file).items()}
        save_file({name: row for name, row in rows.items() if row is not None}, file)


def of_joints(name):
    return name.startswith(("observation.state.", "action."))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda name, row: None if name.startswith("action.") else row,
            "there are statistics of observation.state, and none of action",
        ),
        (
            lambda name, row: None if name.endswith((".std", ".max")) and of_joints(name) else row,
            "and the checkpoint's statistics have no",
        ),
        (
            lambda name, row: torch.full_like(row, math.nan) if of_joints(name) else row,
            "6 finite numbers are expected",
        ),
        (
            lambda name, row: row[:-1].clone() if of_joints(name) and row.ndim else row,
            "6 finite numbers are expected",
        ),
    ],
)
def test_statistics_that_are_wrong(source, capsys, change, words):
    change_statistics(source, change)
    said = import_refused(source, [], capsys)
    assert words in said
    assert said.startswith(str(source))


@pytest.mark.parametrize("kind", MODELS)
def test_states_of_another_width(kind):
    model = MODELS[kind](**{k: v for k, v in TABLES[kind].items() if k != "type"}).eval()
    batch = {"images": torch.zeros(1, 6, 32, 32), "states": torch.zeros(1, model.state_dim + 2)}
    if kind == "diffusion":
        batch["noise"] = torch.zeros(1, *model.action_shape)
    with pytest.raises(ConfigError, match=f"states have {model.state_dim + 2} numbers, state_dim"):
        model.predict_action(**batch)


def test_parts_refuse_another_width():
    head = LlavaActionHead(4, 3, 5, context_dim=8, width=16, num_heads=2, num_layers=1)
    hidden, masks = torch.zeros(1, 2, 8), torch.ones(1, 2, dtype=torch.bool)
    with pytest.raises(ConfigError, match="LlavaActionHead: states have 6 numbers, state_dim is 5"):
        head.sample(hidden, masks, torch.zeros(1, 6))
    projector = FiLMProjector(4, 4, 5, width=8)
    with pytest.raises(ConfigError, match="FiLMProjector: states have 4 numbers, state_dim is 5"):
        projector(torch.zeros(1, 4), torch.zeros(1, 4), torch.zeros(1, 4))
    chunks = FlowMatchingHead(4, 3, context_dim=8, width=16, blocks=1)
    actions = torch.zeros(1, 4, 2)
    with pytest.raises(ConfigError, match=r"actions are \(4, 2\) a sample, .* chunks \(4, 3\)"):
        chunks.errors(
            torch.zeros(1, 8), actions, torch.ones(1, 4), actions[:, None], torch.zeros(1, 1)
        )


@pytest.mark.parametrize("name", ["llava_aloha", "aloha_sim_transfer"])
def test_another_version_of_transformers(tmp_path, name):
    config = Path(__file__).parents[3] / "configs" / f"{name}.py"
    said = checked_with_transformers("4.40.0", config, tmp_path)
    assert re.search(rf"{name}\.py:\d+: model\.type: fluxvla-models", said)
    assert "needs transformers>=4.56,<6, but 4.40.0 is installed" in said
