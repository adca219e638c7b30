"""A tiny SmolVLA, with the weights and inputs of ``oracles/make_lerobot061.py``."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import torch
from fluxvla_smolvla.lerobot_files import published
from fluxvla_smolvla.model import SmolVLA
from safetensors.torch import save_file

from tests.oracles import fill

GOLDEN = Path(__file__).parent / "golden"
CAMERAS = {"front": (48, 80), "wrist": (60, 40)}
STATE, ACTION, HORIZON, WIDTH, SIDE = 6, 5, 7, 32, 64
TASKS = ["pick up the cube", "put it down, gently", "wave\n"]
VISION = {
    "hidden_size": 64,
    "intermediate_size": 96,
    "layers": 2,
    "heads": 1,
    "image_size": SIDE,
    "patch_size": 8,
    "scale_factor": 2,
}
TEXT = {
    "hidden_size": 128,
    "intermediate_size": 160,
    "layers": 4,
    "heads": 2,
    "kv_heads": 1,
    "vocabulary": 300,
}
SIZES = {
    "vision": VISION,
    "text": TEXT,
    "n_action_steps": HORIZON,
    "ori_action_dim": ACTION,
    "num_steps": 4,
}


def tiny_model(**settings) -> SmolVLA:
    """The oracle's model, its weights by their published names."""
    model = SmolVLA(**{**SIZES, **settings})
    with torch.no_grad():
        for name, tensor in model.state_dict().items():
            tensor.copy_(torch.from_numpy(fill.weight(published(name), tensor.shape)))
    return model.eval()


def model_batch() -> dict[str, torch.Tensor]:
    """The oracle's inputs of the model, as this project has them."""
    size, lengths = 3, np.array([9, 4, 12])
    images = [fill.uniform(f"batch {name}", (size, 3, SIDE, SIDE)) * 2 - 1 for name in CAMERAS]
    batch = {
        "images": np.concatenate(images, axis=1),
        "img_masks": np.array([[True, True], [True, False], [True, True]]),
        "lang_tokens": fill.integers("batch tokens", (size, 12), 300),
        "lang_masks": np.arange(12) < lengths[:, None],
        "states": _padded(fill.normal("batch state", (size, STATE))),
        "actions": _padded(fill.normal("batch action", (size, HORIZON, ACTION))),
        "action_masks": (np.arange(HORIZON) < np.array([[7], [5], [2]])).astype(np.float32),
        "noise": fill.normal("noise", (size, HORIZON, WIDTH))[:, None],
        # LeRobot's t is 3/4096, 2500/4096, 4000/4096.
        "time": (1 - np.array([[3.0], [2500.0], [4000.0]]) / 4096).astype(np.float32),
    }
    return {key: torch.from_numpy(value) for key, value in batch.items()}


def raw_observation(number: int) -> dict:
    """The oracle's observation ``number``; the third has no wrist camera."""
    return {
        "images": {
            name: fill.integers(f"picture {name} {number}", (*shape, 3), 256).astype(np.uint8)
            for name, shape in CAMERAS.items()
            if number != 2 or name == "front"
        },
        "qpos": fill.normal(f"state {number}", (STATE,)),
        "task_description": TASKS[number],
    }


def byte_tokenizer(folder: Path) -> Path:
    """The oracle's tokenizer, one token a byte."""
    import tokenizers

    letters = sorted(tokenizers.pre_tokenizers.ByteLevel.alphabet())
    vocabulary = {"<pad>": 0, **{letter: 10 + i for i, letter in enumerate(letters)}}
    made = tokenizers.Tokenizer(tokenizers.models.BPE(vocabulary, []))
    made.pre_tokenizer = tokenizers.pre_tokenizers.ByteLevel(add_prefix_space=False)
    folder.mkdir(parents=True, exist_ok=True)
    made.save(str(folder / "tokenizer.json"))
    (folder / "tokenizer_config.json").write_text('{"pad_token": "<pad>"}')
    return folder


def published_weights() -> dict[str, torch.Tensor]:
    """The oracle's weights, by their published names."""
    return {published(name): tensor for name, tensor in tiny_model().state_dict().items()}


def lerobot_folder(folder: Path, **changes: torch.Tensor | None) -> Path:
    """What LeRobot saved of the oracle's policy, its weights made again."""
    folder.mkdir()
    for file in GOLDEN.iterdir():
        if file.name != "smolvla.safetensors":
            shutil.copyfile(file, folder / file.name)
    tensors = {**published_weights(), **changes}
    kept = {name: tensor for name, tensor in tensors.items() if tensor is not None}
    save_file(kept, folder / "model.safetensors", metadata={"format": "pt"})
    return folder


def relative(found: torch.Tensor, expected: torch.Tensor) -> float:
    """The largest difference, of the largest magnitude that is expected."""
    return float((found - expected).abs().max() / expected.abs().max())


def _padded(values: np.ndarray) -> np.ndarray:
    return np.pad(values, [(0, 0)] * (values.ndim - 1) + [(0, WIDTH - values.shape[-1])])
