"""What LeRobot 0.6.1 does with the folder of a tiny GR00T N1.7 that FluxVLA writes.

Run from the repository's root in an environment with LeRobot 0.6.1 and transformers 5.5.4:

    HF_HUB_OFFLINE=1 PYTHONPATH=. \
        python plugins/fluxvla-gr00t/tests/oracles/make_lerobot061_n17_written.py

tests/written/n1.7 is what ``fluxvla export --format lerobot`` makes, with names and shapes in place
of the weights; test_gr00t_write.py compares.
LeRobot loads it strictly into a model that is 0 throughout, of the sizes of
make_lerobot061_n17.py, and packs and unpacks with its processors. The step between them needs a
tokenizer from the hub: tokens and patches are those of make_lerobot061_n17.py instead. It writes
tests/golden/written_n17.safetensors.
"""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
from importlib.metadata import version
from pathlib import Path
from unittest import mock

import torch
from lerobot.configs import PreTrainedConfig
from lerobot.lerobot_types import TransitionKey
from lerobot.policies.groot.groot_n1_7 import _tie_unused_qwen_lm_head
from lerobot.policies.groot.modeling_groot import GrootPolicy
from lerobot.policies.groot.processor_groot import make_groot_pre_post_processors_from_pretrained
from lerobot.processor.converters import batch_to_transition
from make_lerobot061_n17 import inputs, tiny_model
from safetensors.torch import save_file
from transformers.feature_extraction_utils import BatchFeature

from tests.oracles import fill

ENVIRONMENT = "lerobot061"
WRITTEN = Path(__file__).resolve().parents[1] / "written" / "n1.7"
COLOURS = {"wrist": 20, "front": 10}


def empty(_policy: GrootPolicy) -> torch.nn.Module:
    """The tiny model, all of whose weights have to come from the file."""
    model = tiny_model()
    _tie_unused_qwen_lm_head(model.backbone.model)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.zero_()
    return model


def filled(folder: Path) -> Path:
    """``folder`` with weights of the names and shapes that FluxVLA writes."""
    shutil.copytree(WRITTEN, folder, dirs_exist_ok=True)
    shapes = json.loads((WRITTEN / "tensors.json").read_text())
    tensors = {
        name: torch.from_numpy(fill.weight(name.removeprefix("_groot_model."), shape))
        for name, shape in shapes.items()
    }
    save_file(tensors, folder / "model.safetensors", {"format": "pt"})
    return folder


def results(folder: Path) -> dict[str, torch.Tensor]:
    """What the model gets and gives, and the commands that follow."""
    config = PreTrainedConfig.from_pretrained(WRITTEN)
    with mock.patch.object(GrootPolicy, "_create_groot_model", empty):
        policy = GrootPolicy.from_pretrained(filled(folder), config=config, strict=True)
    before, after = make_groot_pre_post_processors_from_pretrained(
        config, str(WRITTEN), preprocessor_overrides={}, postprocessor_overrides={}
    )
    raw = {"observation.state": torch.from_numpy(fill.normal("raw state", (5,))), "task": "Lift"}
    for camera, colour in COLOURS.items():
        picture = torch.full((3, 64, 64), colour, dtype=torch.uint8)
        raw[f"observation.images.{camera}"] = picture
    transition = batch_to_transition(raw)
    for step in before.steps[:3]:
        transition = step(transition)
    packed = transition[TransitionKey.OBSERVATION]
    more = transition[TransitionKey.COMPLEMENTARY_DATA]
    seen = inputs(False)
    one = BatchFeature(
        {
            "input_ids": seen["input_ids"][:1],
            "attention_mask": seen["attention_mask"][:1],
            "pixel_values": seen["pixel_values"][: len(seen["pixel_values"]) // 2],
            "image_grid_thw": seen["image_grid_thw"][:2],
        }
    )
    asked = BatchFeature({"state": packed["state"], "embodiment_id": more["embodiment_id"]})
    noise = torch.from_numpy(fill.normal("noise", (1, 6, 5)))
    model = policy._groot_model
    with torch.no_grad(), mock.patch.object(torch, "randn", return_value=noise):
        actions = model.action_head.get_action(model.backbone(one), asked)["action_pred"]
    views = torch.as_tensor(packed["video"])[0, 0, :, 0, 0, 0]
    return {
        "state": packed["state"][0, 0],
        "views": views.int(),
        "embodiment_id": more["embodiment_id"],
        "tokens": one["input_ids"],
        "images": torch.from_numpy(fill.normal("pictures", (2, 6, 16, 16)))[:1],
        "actions": actions[0],
        "commands": after(actions)[0],
    }


def main(folder: Path) -> None:
    torch.set_num_threads(1)
    about = {name: version(name) for name in ("lerobot", "transformers", "torch")}
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as temporary:
        found = {name: value.contiguous() for name, value in results(Path(temporary)).items()}
    save_file(found, folder / "written_n17.safetensors", about)


if __name__ == "__main__":
    here = Path(__file__).resolve().parents[1] / "golden"
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else here)
