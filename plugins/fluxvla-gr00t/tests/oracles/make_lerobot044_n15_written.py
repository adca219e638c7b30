"""What LeRobot 0.4.4 does with the folder of a tiny GR00T N1.5 that FluxVLA writes.

Run from the repository's root in an environment with LeRobot 0.4.4 and transformers 4.57.6:

    HF_HUB_OFFLINE=1 PYTHONPATH=. \
        python plugins/fluxvla-gr00t/tests/oracles/make_lerobot044_n15_written.py

tests/written/n1.5 is what ``fluxvla export --format lerobot`` makes, with names and shapes in place
of the weights; test_gr00t_write.py compares.
LeRobot loads it strictly into a model that is 0 throughout, of the sizes of
make_lerobot044_n15.py, and packs and unpacks with its processors. The steps between them need
files from the hub: tokens and images are those of make_lerobot044_n15.py instead. LeRobot 0.4.4
unpacks only the last action that it is given, so that it is given them one by one. It writes
tests/golden/written_n15.safetensors.
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
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.groot import modeling_groot
from lerobot.policies.groot import processor_groot as processors
from lerobot.processor import PolicyProcessorPipeline
from lerobot.processor.converters import (
    batch_to_transition,
    policy_action_to_transition,
    transition_to_policy_action,
)
from lerobot.processor.core import TransitionKey
from make_lerobot044_n15 import Tiny, inputs
from safetensors.torch import save_file
from transformers.feature_extraction_utils import BatchFeature

from tests.oracles import fill

ENVIRONMENT = "lerobot044"
WRITTEN = Path(__file__).resolve().parents[1] / "written" / "n1.5"
COLOURS = {"wrist": 20, "front": 10}


def empty(_policy: object) -> torch.nn.Module:
    """The tiny model, all of whose weights have to come from the file."""
    model = Tiny()
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
    policies = modeling_groot.GrootPolicy
    config = PreTrainedConfig.from_pretrained(WRITTEN)
    with mock.patch.object(policies, "_create_groot_model", empty):
        policy = policies.from_pretrained(filled(folder), config=config, strict=True)
    assert processors.GrootPackInputsStep  # which registers LeRobot's steps
    before = PolicyProcessorPipeline.from_pretrained(
        WRITTEN, config_filename="policy_preprocessor.json"
    )
    after = PolicyProcessorPipeline.from_pretrained(
        WRITTEN,
        config_filename="policy_postprocessor.json",
        to_transition=policy_action_to_transition,
        to_output=transition_to_policy_action,
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
            "eagle_input_ids": seen["eagle_input_ids"][:1],
            "eagle_attention_mask": seen["eagle_attention_mask"][:1],
            "eagle_pixel_values": seen["eagle_pixel_values"][:2],
            "eagle_image_sizes": None,
        }
    )
    asked = BatchFeature({"state": packed["state"], "embodiment_id": more["embodiment_id"]})
    noise = torch.from_numpy(fill.normal("noise", (1, 6, 5)))
    model = policy._groot_model
    with torch.no_grad(), mock.patch.object(torch, "randn", return_value=noise):
        actions = model.action_head.get_action(model.backbone(one), asked)["action_pred"]
    return {
        "state": packed["state"][0, 0],
        "views": torch.as_tensor(packed["video"])[0, 0, :, 0, 0, 0].int(),
        "embodiment_id": more["embodiment_id"],
        "tokens": one["eagle_input_ids"],
        "images": torch.from_numpy(fill.normal("pictures", (2, 6, 28, 28)))[:1],
        "actions": actions[0],
        "commands": torch.cat([after(action[None]) for action in actions[0]]),
    }


def main(folder: Path) -> None:
    torch.set_num_threads(1)
    about = {name: version(name) for name in ("lerobot", "transformers", "torch")}
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as temporary:
        found = {name: value.contiguous() for name, value in results(Path(temporary)).items()}
    save_file(found, folder / "written_n15.safetensors", about)


if __name__ == "__main__":
    here = Path(__file__).resolve().parents[1] / "golden"
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else here)
