"""``configs/pi05_aloha.py`` but for its sizes: published weights, data, training, acting."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from fluxvla_pi.names import OPENPI, published
from fluxvla_pi.pi05 import PI05FlowMatching
from safetensors.torch import save_file

from fluxvla_core import Camera, EmbodimentSpec, Joint
from fluxvla_core.build import build_transform_from_cfg, build_vla_from_cfg
from fluxvla_core.cli.main import main
from fluxvla_core.config.load import load_config
from fluxvla_core.data import LeRobotWriter
from fluxvla_core.models import load_policy
from tests.policies.benched import DIVIDED, stages_of

from .oracles.pi_inputs import EXPERT, GEMMA, VISION, VOCABULARY
from .published_folders import tokenizer_folder

ROOT = Path(__file__).parents[3]
CAMERAS = ("cam_high", "cam_left_wrist", "cam_right_wrist")
ALOHA = EmbodimentSpec(
    "aloha",
    tuple(Joint(f"joint{i}", "rad", -9.0, 9.0, 9.0, 9.0) for i in range(14)),
    tuple(Camera(name, 48, 64) for name in CAMERAS),
    50.0,
)
SIZES = {
    "variant": {**GEMMA, "depth": 2},
    "expert_variant": {**EXPERT, "depth": 2},
    "vision_variant": {**VISION, "depth": 1, "image_size": 224},
    "vocab_size": VOCABULARY,
}
# A table replaces what was no table only if it says so.
TABLES = {k: {**v, "_delete_": True} if isinstance(v, dict) else v for k, v in SIZES.items()}
CONFIG = f"""
_base_ = {str(ROOT / "configs" / "pi05_aloha.py")!r}

model = {TABLES!r}
train_dataloader = dict(per_device_batch_size=2, per_device_num_workers=0)
runner = dict(max_steps=2, save_iter_interval=2)
"""


def record(root):
    rng = np.random.default_rng(0)
    with LeRobotWriter(root, 50, ALOHA) as writer:
        for key in range(2):
            for _ in range(6):
                images = {c: rng.integers(0, 256, (48, 64, 3), np.uint8) for c in CAMERAS}
                state, action = rng.normal(size=(2, 14)).astype(np.float32)
                writer.add_frame(images, state, action, "put the red cube into the box")
            writer.save_episode(key=key)


def publish(folder):
    """Tiny weights as openpi has them."""
    torch.manual_seed(0)
    state = PI05FlowMatching(**SIZES).state_dict()
    tensors = {theirs: state[ours] for theirs, ours in published(list(state), OPENPI).items()}
    tensors |= {name: torch.zeros(VOCABULARY, EXPERT["width"]) for name in OPENPI.unused}
    (folder / "assets" / "trossen").mkdir(parents=True)
    row = dict.fromkeys(("mean", "std", "q01", "q99"), tuple(range(1, 15)))
    stats = {"norm_stats": {"state": row, "actions": row}}
    (folder / "assets" / "trossen" / "norm_stats.json").write_text(json.dumps(stats))
    save_file(tensors, folder / "model.safetensors")
    return state


@pytest.mark.timeout(300)
def test_it_trains_from_published_weights_and_acts(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    record(tmp_path / "datasets" / "aloha_example")
    tokenizer_folder(tmp_path / "checkpoints" / "paligemma-3b-pt-224")
    before = publish(tmp_path / "checkpoints" / "pi05_base")
    (tmp_path / "tiny.py").write_text(CONFIG)
    words = ["run", "--config", "tiny.py", "--section", "runner", "--work-dir", "out"]
    assert main(words) == 0

    policy = load_policy(tmp_path / "out")
    assert policy.embodiment.joints == ALOHA.joints
    after = policy.model.state_dict()
    moved = {name for name in after if not torch.equal(after[name], before[name])}
    assert "llm_expert.layers.0.self_attn.q_proj.weight" in moved
    assert "llm_backbone.norm.weight" not in moved
    # Two steps of at most 2.5e-5 each: what it has learned is near what it began with.
    assert all((after[name] - before[name]).abs().max() < 1e-4 for name in after)

    rng = np.random.default_rng(1)
    policy.reset(3)
    found = policy.predict_action(
        {
            "images": {c: rng.integers(0, 256, (48, 64, 3), np.uint8) for c in CAMERAS},
            "qpos": rng.normal(size=14),
            "task_description": "put the red cube into the box",
        }
    )
    assert found.shape == (50, 14)
    assert np.isfinite(found).all()
    assert stages_of(tmp_path / "out", tmp_path / "measured") == DIVIDED


TINY = ROOT / "configs" / "aloha_sim_pi05_tiny.py"


def test_nothing_is_wrong_with_the_tiny_one(capsys):
    pytest.importorskip("fluxvla_sim")
    assert main(["config", "check", str(TINY)]) == 0
    assert "no problems" in capsys.readouterr().out
    model = load_config(TINY).tree["model"]
    count = sum(p.numel() for p in build_vla_from_cfg(model).parameters())
    assert f"{count / 1e6:.1f} million parameters" in TINY.read_text()


@pytest.mark.parametrize("value", [-9.0, -0.5, 9.0])
def test_prompts_of_any_state_fit_the_tiny_one(value):
    tree = load_config(TINY).tree
    tables = tree["train_dataloader"]["dataset"]["transforms"]
    (prompt, tokens) = (build_transform_from_cfg(t) for t in tables if "Prompt" in t["type"])
    for text in tree["inference"]["task_descriptions"].values():
        sample = prompt({"task_description": text, "states": np.full(14, value)})
        assert tokens(sample)["lang_masks"].sum() <= tables[-2]["max_len"]


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_the_tiny_one_learns_the_demos_tasks(tmp_path):
    """As its first lines say, and far above what an untrained one reaches."""
    pytest.importorskip("fluxvla_sim")
    dataset, work = tmp_path / "dataset", tmp_path / "work"
    assert main(["collect", "aloha", "--out", str(dataset), "--episodes", "240"]) == 0
    sets = {
        "runner": [f"train_dataloader.dataset.data_root_path={dataset}"],
        "eval": ["eval.episodes=20", "eval.instruction_swap=false"],
    }
    for section, words in sets.items():
        asked = ["--section", section, "--nproc", "2", "--work-dir", str(work)]
        assert main(["run", "--config", str(TINY), *asked, "--cfg-options", *words]) == 0
    found = json.loads((work / "eval" / "results.json").read_text())["groups"]
    assert found["policy"]["all"]["low"] > max(0.3, found["untrained"]["all"]["high"]), found
