"""A model whose checkpoints another project saves under other names, and their format."""

from __future__ import annotations

import json

import pytest
import torch
from safetensors.torch import save_file

from fluxvla_core.models import CheckpointFormat, ForeignCheckpoint, renamed, safetensors_in
from fluxvla_core.plugins.registry import CHECKPOINT_FORMATS, VLAS
from fluxvla_core.spec import Camera, EmbodimentSpec, Joint

ARM = EmbodimentSpec(
    "arm",
    tuple(Joint(n, "rad", -1.0, 1.0, 1.0, 1.0) for n in "ab"),
    (Camera("front", 8, 8),),
    50.0,
)
ROW = {"mean": [0.1, 0.2], "std": [0.5, 2.0]}
NAMES = {"gain.weight": "net.w", "gain.bias": "net.b", "head.weight": "net.w", "scale": "s"}


class ReachVLA(torch.nn.Module):
    """A weight under two names, and one number."""

    action_shape = (4, 2)

    def __init__(self, pretrained_name_or_path: str | None = None):
        super().__init__()
        self.gain = torch.nn.Linear(2, 2)
        self.head = torch.nn.Linear(2, 2, bias=False)
        self.head.weight = self.gain.weight
        self.scale = torch.nn.Parameter(torch.ones(()))
        self.pretrained_name_or_path = pretrained_name_or_path

    def forward(self, x, y):
        return {"loss": (self.scale * self.head(self.gain(x)) - y).square().mean()}

    def predict_action(self, states, noise):
        return self.scale * self.head(self.gain(noise)) + states[:, None]


class ReachFormat(CheckpointFormat):
    name = "reach"
    model_types = ("ReachVLA",)

    def recognizes(self, folder):
        return (folder / "reach.json").is_file()

    def read(self, folder, tokenizer=None):
        facts = json.loads((folder / "reach.json").read_text())
        return ForeignCheckpoint(
            model={"type": "ReachVLA"},
            tensors=renamed(safetensors_in(folder), NAMES, str(folder)),
            img_keys=("base",),
            transforms=({"type": "NormalizeStatesAndActions", "norm_type": "mean_std"},),
            statistics={"private": {"proprio": ROW, "action": ROW}},
            horizon=4,
            action_rate_hz=facts.get("hz"),
            notes=("the wrist camera is not used",),
        )

    def write(self, checkpoint, folder):
        tensors = {theirs: checkpoint.tensors[ours] for ours, theirs in NAMES.items()}
        save_file(tensors, folder / "model.safetensors")
        (folder / "reach.json").write_text(json.dumps({"hz": checkpoint.action_rate_hz}))


@pytest.fixture(autouse=True)
def plugin():
    VLAS.register_module()(ReachVLA)
    CHECKPOINT_FORMATS.register_module()(ReachFormat)
    yield
    VLAS.unregister("ReachVLA")
    CHECKPOINT_FORMATS.unregister("ReachFormat")


def weights():
    torch.manual_seed(0)
    made = {"net.w": torch.randn(2, 2), "net.b": torch.randn(2), "s": torch.tensor(1.5)}
    return {name: tensor.bfloat16() for name, tensor in made.items()}


def published(folder, tensors=None, hz=10.0):
    folder.mkdir()
    save_file(weights() if tensors is None else tensors, folder / "model.safetensors")
    (folder / "reach.json").write_text(json.dumps({"hz": hz}))
    return folder
