"""Whole policies of LeRobot, from images, words and joints to commands, and the files they save.

    HF_HUB_OFFLINE=1 OMP_NUM_THREADS=1 PYTHONPATH=. python \\
        plugins/fluxvla-pi/tests/oracles/make_lerobot061_policies.py [FOLDER]

What ``save_pretrained`` writes is stored but for the weights, which follow from their names. The
policy and its processors are loaded from there again before they act. LeRobot names a tokenizer of
the hub; it gets one of single letters instead. ``bf16.`` is what the same policy does with
``dtype="bfloat16"``, which LeRobot gives to some of the tensors only: ``bf16.dtypes`` says to which
of their sorted names.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path

import pi_inputs as tiny
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.factory import make_pre_post_processors
from lerobot.processor import tokenizer_processor
from make_lerobot061 import FAMILIES, VERSIONS, policy_of
from safetensors.torch import save_file
from transformers import PreTrainedTokenizerFast

ENVIRONMENT = "lerobot061"
SETTINGS = {
    # Actions that are counted from the state, all but the gripper's.
    "pi0": {
        "use_relative_actions": True,
        "relative_exclude_joints": ["gripper"],
        "action_feature_names": [*(f"joint{i}" for i in range(6)), "gripper"],
        "tokenizer_max_length": 48,
    },
    "pi05": {"empty_cameras": 1, "tokenizer_max_length": 120},
}


class LocalTokenizer:
    """Stands for transformers' ``AutoTokenizer``."""

    @staticmethod
    def from_pretrained(name: str, **settings):
        return PreTrainedTokenizerFast(
            tokenizer_object=tiny.tokenizer(), pad_token="<pad>", bos_token="<bos>"
        )


def build(family: str, **more):
    cameras = {
        f"observation.images.{name}": PolicyFeature(FeatureType.VISUAL, (3, *size))
        for name, size in tiny.SIZES_OF_CAMERAS.items()
    }
    state = PolicyFeature(FeatureType.STATE, (tiny.ROBOT_STATES,))
    return policy_of(
        family,
        input_features={**cameras, "observation.state": state},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (tiny.ROBOT_ACTIONS,))},
        **SETTINGS[family],
        **more,
    )


def numbers(family: str, folder: Path) -> dict[str, torch.Tensor]:
    """Save a policy in ``folder``, load it, and let it act."""
    policy = build(family)
    stats = {
        key: {name: torch.from_numpy(row) for name, row in rows.items()}
        for key, rows in tiny.statistics().items()
    }
    policy.save_pretrained(folder)
    for processor in make_pre_post_processors(policy.config, dataset_stats=stats):
        processor.save_pretrained(folder)

    policy = FAMILIES[family][2].from_pretrained(folder).eval()
    before, after = make_pre_post_processors(policy.config, pretrained_path=str(folder))
    images, state = tiny.observation()
    seen = {
        f"observation.images.{name}": torch.from_numpy(image).permute(2, 0, 1) / 255.0
        for name, image in images.items()
    }
    raw = {**seen, "observation.state": torch.from_numpy(state), "task": tiny.TASKS[family]}
    batch = before({**raw, "action": torch.from_numpy(tiny.chunk())})
    found = {
        "normalized_actions": batch["action"],
        "normalized_states": batch["observation.state"],
        "tokens": batch["observation.language.tokens"],
        "token_masks": batch["observation.language.attention_mask"],
    }
    pictures, masks = policy._preprocess_images(before(raw))
    for i, (picture, mask) in enumerate(zip(pictures, masks, strict=True)):
        found[f"picture.{i}"], found[f"picture_mask.{i}"] = picture, mask
    batch = before(raw)
    noise = torch.from_numpy(tiny.first_noise())
    found["commands"] = after(policy.predict_action_chunk(batch, noise=noise))
    narrow = build(family, dtype="bfloat16")
    state = narrow.state_dict()
    found["bf16.dtypes"] = torch.tensor([state[n].dtype == torch.bfloat16 for n in sorted(state)])
    found["bf16.commands"] = after(narrow.predict_action_chunk(before(raw), noise=noise)).float()
    return found


def main() -> None:
    torch.set_num_threads(1)
    tokenizer_processor.AutoTokenizer = LocalTokenizer
    default = Path(__file__).parents[1] / "golden"
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else default
    target.mkdir(parents=True, exist_ok=True)
    for family in FAMILIES:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            found = numbers(family, folder)
            for file in folder.iterdir():
                if file.name not in ("model.safetensors", "README.md"):
                    shutil.copyfile(file, target / f"lerobot061_{family}-{file.name}")
        found = {name: tensor.contiguous() for name, tensor in found.items()}
        save_file(found, target / f"lerobot061_{family}_policy.safetensors", VERSIONS)


if __name__ == "__main__":
    main()
