"""``configs/pi0_fast_libero.py`` but for its sizes: published weights, data, training, acting."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from fluxvla_models.fast_tokenizer import fit
from fluxvla_pi.names import LEROBOT
from fluxvla_pi.pi0_fast import PI0FAST
from safetensors.torch import save_file

from fluxvla_core import Camera, EmbodimentSpec, Joint
from fluxvla_core.cli.main import main
from fluxvla_core.data import LeRobotWriter
from fluxvla_core.models import load_policy
from tests.policies.benched import WHOLE, stages_of

from .oracles import pi_inputs as tiny
from .published_folders import GOLDEN

ROOT = Path(__file__).parents[3]
CAMERAS = ("agentview", "robot0_eye_in_hand")
ARM = EmbodimentSpec(
    "panda",
    tuple(Joint(f"joint{i}", "rad", -9.0, 9.0, 9.0, 9.0) for i in range(7)),
    tuple(Camera(name, 48, 64) for name in CAMERAS),
    20.0,
)
VISION = {**tiny.VISION, "depth": 1, "image_size": 224}
WORDS = {**tiny.ACTION_WORDS, "vocab_size": 1024}
TABLES = {
    "variant": {**tiny.GEMMA, "depth": 2, "_delete_": True},
    "vision_variant": {**VISION, "_delete_": True},
    "vocab_size": 1024,
    "words": WORDS,
    "max_decoding_steps": 12,
}
CONFIG = f"""
_base_ = {str(ROOT / "configs" / "pi0_fast_libero.py")!r}

model = {TABLES!r}
train_dataloader = dict(per_device_batch_size=2, per_device_num_workers=1)
runner = dict(max_steps=2, save_iter_interval=2)
"""


def record(root):
    rng = np.random.default_rng(0)
    with LeRobotWriter(root, 20, ARM) as writer:
        for key in range(2):
            for _ in range(14):
                images = {c: rng.integers(0, 256, (48, 64, 3), np.uint8) for c in CAMERAS}
                state, action = rng.normal(size=(2, 7)).astype(np.float32)
                writer.add_frame(images, state, action, "put the red cube into the box")
            writer.save_episode(key=key)


def publish(folder):
    """Tiny weights and files as LeRobot has them, and a tokenizer of actions."""
    torch.manual_seed(0)
    chunks = np.random.default_rng(1).normal(size=(100, 10, 7))
    fast = fit(chunks, folder / "fast-action-tokenizer", vocab_size=400)
    model = PI0FAST(
        {"type": "FastTokenizer", "model_path": str(fast.folder)},
        variant={**tiny.GEMMA, "depth": 2},
        vision_variant=VISION,
        vocab_size=1024,
        words=WORDS,
        tied_head=False,
    )
    state = model.state_dict()
    save_file({LEROBOT.theirs(name): t for name, t in state.items()}, folder / "model.safetensors")
    before = "lerobot061_pi0_fast-"
    for file in GOLDEN.glob(f"{before}*"):
        shutil.copyfile(file, folder / file.name.removeprefix(before))
    return state


@pytest.mark.timeout(300)
def test_it_trains_from_published_weights_and_acts(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    record(tmp_path / "datasets" / "libero_object")
    text = tmp_path / "checkpoints" / "paligemma-3b-pt-224"
    text.mkdir(parents=True)
    tiny.fast_text_tokenizer().save(str(text / "tokenizer.json"))
    (text / "tokenizer_config.json").write_text(json.dumps({"pad_token": "<pad>"}))
    before = publish(tmp_path / "checkpoints" / "pi0fast_base")
    (tmp_path / "tiny.py").write_text(CONFIG)
    words = ["run", "--config", "tiny.py", "--section", "runner", "--work-dir", "out"]
    # One letter a token, and actions that are noise: far more tokens than there are of real ones.
    toml = ", ".join(f"{key} = {value}" for key, value in WORDS.items())
    told = ("4.max_len=200", "5.max_len=200", f"5.words={{{toml}}}")
    sets = [w for text in told for w in ("--set", f"train_dataloader.dataset.transforms.{text}")]
    assert main([*words, *sets]) == 0

    # It acts where the checkpoint is all that there is.
    shutil.rmtree(tmp_path / "checkpoints")
    shutil.rmtree(tmp_path / "datasets")
    policy = load_policy(tmp_path / "out")
    after = policy.model.state_dict()
    moved = {name for name in after if not torch.equal(after[name], before[name])}
    assert {"lm_head.weight", "llm_backbone.norm.weight", "projector.bias"} <= moved
    assert all((after[name] - before[name]).abs().max() < 1e-4 for name in after)
    rng = np.random.default_rng(1)
    policy.reset(3)
    found = policy.predict_action(
        {
            "images": {c: rng.integers(0, 256, (48, 64, 3), np.uint8) for c in CAMERAS},
            "qpos": rng.normal(size=7),
            "task_description": "put the red cube into the box",
        }
    )
    assert found.shape == (10, 7)
    assert np.isfinite(found).all()
    assert stages_of(tmp_path / "out", tmp_path / "measured") == WHOLE
