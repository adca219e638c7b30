"""The configs of ``configs/``: checked at full size, and run with tiny models up to acting."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch

from fluxvla_core import build_vla_from_cfg, load_policy
from fluxvla_core.cli.main import main
from fluxvla_core.config.load import load_config
from fluxvla_core.data import LeRobotWriter
from fluxvla_core.operators import Camera, EmbodimentSpec, Joint
from tests.policies.benched import DIVIDED, WHOLE, stages_of

from . import published, tiny

CONFIGS = Path(__file__).parents[3] / "configs"
NAMES = ("openvla_libero", "openvla_oft_libero", "openvla_oft_aloha", "openvla_oft_ur")


def values(name):
    return load_config(CONFIGS / f"{name}.py").tree


@pytest.mark.parametrize("name", NAMES)
def test_a_config_is_without_fault(name, capsys):
    assert main(["config", "check", str(CONFIGS / f"{name}.py")]) == 0
    words = ["run", "--config", str(CONFIGS / f"{name}.py"), "--section", "runner", "--dry-run"]
    assert main(words) == 0
    assert "OpenVLA" in capsys.readouterr().out


@pytest.mark.parametrize("name", NAMES)
def test_its_adapters_are_on_every_layer_that_is_used(name):
    tree = values(name)
    with torch.device("meta"):
        model = build_vla_from_cfg(tree["model"])
    own = ("action_head", "proprio_projector", "noisy_action_projector")
    wanted = {
        layer
        for layer, module in model.named_modules()
        if isinstance(module, torch.nn.Linear | torch.nn.Conv2d)
        and module.weight.requires_grad
        and layer.partition(".")[0] not in own
        and layer.rpartition(".")[2] not in ("scale", "shift")
    }
    lora = tree["runner"]["lora"]
    found = {n for n, _ in model.named_modules() if re.fullmatch(lora["target_modules"], n)}
    assert found == wanted
    assert (lora["rank"], lora["alpha"]) == (32, 16)


def recorded(folder, cameras, actions, states):
    """Two episodes of six frames."""

    def joints(letter, count):
        return tuple(Joint(f"{letter}{i}", "rad", -3.0, 3.0, 9.0, 9.0) for i in range(count))

    spec = EmbodimentSpec(
        "arm",
        joints("a", actions),
        tuple(Camera(name, 32, 48) for name in cameras),
        20.0,
        state_joints=joints("s", states) if states != actions else None,
    )
    rng = np.random.default_rng(0)
    with LeRobotWriter(folder, 20, spec) as writer:
        for episode in range(2):
            for _ in range(6):
                images = {c: rng.integers(0, 255, (32, 48, 3)).astype(np.uint8) for c in cameras}
                state = rng.uniform(-1, 1, states)
                action = rng.uniform(-1, 1, actions)
                writer.add_frame(images, state, action, ("pick up", "put down")[episode])
            writer.save_episode()
    return spec


BOTH = ("image", "wrist_image")
ALOHA = ("cam_high", "cam_left_wrist", "cam_right_wrist")


@pytest.mark.parametrize(
    ("name", "cameras", "actions", "states", "start"),
    [
        ("openvla_libero", ("image",), 7, 8, None),
        ("openvla_oft_libero", BOTH, 7, 8, "--robot libero"),
        ("openvla_oft_aloha", ALOHA, 14, 14, "--robot aloha --film"),
        ("openvla_oft_ur", ("front", "wrist"), 7, 7, "--robot aloha --cameras 2 --horizon 10"),
    ],
)
def test_it_trains_from_published_weights_and_acts(
    tmp_path, capsys, name, cameras, actions, states, start
):
    recorded(tmp_path / "data", cameras, actions, states)
    base = tmp_path / "openvla"
    published.openvla(base)
    if start is not None:
        words = [str(base), str(tmp_path / "start"), *start.split()]
        words += ["--action-dim", str(actions), "--state-dim", str(states)]
        base = tmp_path / "start"
        assert main(["openvla-oft", *words]) == 0
    tokenizer = json.dumps(str(base))
    settings = {
        "model.image_size": 28,
        "train_dataloader.dataset.transforms.0.size": 28,
        "train_dataloader.dataset.transforms.6.tokenizer.model_path": tokenizer,
        "train_dataloader.dataset.data_root_path": json.dumps(str(tmp_path / "data")),
        "train_dataloader.per_device_num_workers": 0,
        "train_dataloader.per_device_batch_size": 2,
        "runner.init_from": tokenizer,
        "runner.max_steps": 2,
        "runner.enable_mixed_precision_training": "false",
    }
    for part in ("dino", "siglip"):
        settings[f"model.{part}"] = table(tiny.TOWERS[part])
    settings["model.language"] = table(tiny.LANGUAGE)
    words = ["run", "--config", str(CONFIGS / f"{name}.py"), "--section", "runner"]
    words += ["--work-dir", str(tmp_path / "work")]
    for key, value in settings.items():
        words += ["--set", f"{key}={value}"]
    assert main(words) == 0
    capsys.readouterr()
    policy = load_policy(tmp_path / "work")
    policy.reset(1)
    chunk = policy.predict_action(
        {
            "qpos": np.zeros(states, np.float32),
            "images": {camera: np.full((32, 48, 3), 9, np.uint8) for camera in cameras},
            "task_description": "Pick up",
        }
    )
    horizon = values(name).get("HORIZON", 1)
    assert chunk.shape == (horizon, actions)
    assert np.isfinite(chunk).all()
    assert np.abs(chunk).max() <= 3.0
    stages = stages_of(tmp_path / "work", tmp_path / "measured")
    assert stages == (WHOLE if name == "openvla_libero" else DIVIDED)


def table(values):
    return "{" + ", ".join(f"{k} = {v}" for k, v in values.items()) + "}"
