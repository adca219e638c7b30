"""Checkpoints as openpi and LeRobot publish them, tiny, made in a test."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import torch
from fluxvla_pi.names import LEROBOT, OPENPI, published
from safetensors.torch import save_file

from fluxvla_core import Camera, EmbodimentSpec, Joint
from tests.oracles import fill

from .oracles import pi_inputs
from .tiny import fast_model, model_of

GOLDEN = Path(__file__).parent / "golden"
ROBOT = EmbodimentSpec(
    "arm",
    tuple(
        Joint(name, "rad", -9.0, 9.0, 9.0, 9.0)
        for name in (*(f"joint{i}" for i in range(6)), "gripper")
    ),
    tuple(Camera(name, h, w) for name, (h, w) in pi_inputs.SIZES_OF_CAMERAS.items()),
    10.0,
)


def weights(family, layout):
    """Every published tensor, by its own name; LeRobot's twins are not alike."""
    names = published(list(model_of(family).state_dict()), layout)
    state = model_of(family).state_dict()
    shapes = {theirs: tuple(state[ours].shape) for theirs, ours in names.items()}
    width = pi_inputs.EXPERT["width"]
    shapes |= dict.fromkeys(layout.unused, (pi_inputs.VOCABULARY, width))
    return {name: torch.from_numpy(fill.weight(name, shape)) for name, shape in shapes.items()}


def lerobot_folder(folder, family):
    """What LeRobot's ``save_pretrained`` wrote of a tiny policy, and weights by their names."""
    folder.mkdir(parents=True)
    before = f"lerobot061_{family}-"
    for file in GOLDEN.glob(f"{before}*"):
        shutil.copyfile(file, folder / file.name.removeprefix(before))
    save_file(weights(family, LEROBOT), folder / "model.safetensors", {"format": "pt"})
    return folder


def fast_folder(folder):
    """What LeRobot's ``save_pretrained`` wrote of a tiny PI0-FAST, weights by their names, and the
    tokenizer of actions."""
    folder.mkdir(parents=True)
    before = "lerobot061_pi0_fast-"
    for file in GOLDEN.glob(f"{before}*"):
        shutil.copyfile(file, folder / file.name.removeprefix(before))
    state = {LEROBOT.theirs(name): t for name, t in fast_model().state_dict().items()}
    save_file(state, folder / "model.safetensors", {"format": "pt"})
    shutil.copytree(GOLDEN / "fast", folder / "fast-action-tokenizer")
    return folder


def fast_words_folder(folder):
    """The text tokenizer of PI0-FAST, as a published one is stored."""
    folder.mkdir(parents=True)
    pi_inputs.fast_text_tokenizer().save(str(folder / "tokenizer.json"))
    (folder / "tokenizer_config.json").write_text(json.dumps({"pad_token": "<pad>"}))
    return folder


def openpi_folder(folder, family):
    """As openpi's ``train_pytorch`` saves, with the ``config.json`` of its conversion."""
    stats = {
        theirs: {name: pi_inputs.statistics()[key][name].tolist() for name in names}
        for theirs, key in (("state", "observation.state"), ("actions", "action"))
        for names in [("mean", "std", "q01", "q99")]
    }
    for rows in stats.values():  # some of openpi's are padded to the model's width
        for name in rows:
            rows[name] += [0.0]
    assets = folder / "assets" / "acme" / "arm"
    assets.mkdir(parents=True)
    (assets / "norm_stats.json").write_text(json.dumps({"norm_stats": stats}))
    config = {"action_dim": pi_inputs.ACTIONS, "action_horizon": pi_inputs.HORIZON}
    (folder / "config.json").write_text(json.dumps(config))
    save_file(weights(family, OPENPI), folder / "model.safetensors", {"format": "pt"})
    return folder


def tokenizer_folder(folder):
    """The tokenizer of single letters, as a published one is stored."""
    folder.mkdir(parents=True)
    pi_inputs.tokenizer().save(str(folder / "tokenizer.json"))
    (folder / "tokenizer_config.json").write_text(json.dumps({"pad_token": "<pad>"}))
    return folder


def robot_file(file):
    """A file that describes the robot."""
    file.write_text(json.dumps(ROBOT.to_dict()))
    return file


def observation(family):
    """What the robot sees, as a policy here gets it."""
    images, state = pi_inputs.observation()
    return {"images": images, "qpos": state, "task_description": pi_inputs.TASKS[family]}
