"""torchvision's weights of a residual network, from a local file, in ACT and Diffusion Policy."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from fluxvla_models.act import ACT
from fluxvla_models.diffusion_policy import DiffusionPolicy

from fluxvla_core.errors import CheckpointError, ConfigError
from fluxvla_core.training.part_weights import load_part_weights
from tests.oracles import fill

KEYS = json.loads((Path(__file__).parent / "keys" / "lerobot_act.json").read_text())
PREFIX = "model.backbone."


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, torch.Tensor]]:
    """torchvision's ``resnet18``: LeRobot has its names, but not the classifier and counters."""
    shapes = {n.removeprefix(PREFIX): s for n, s in KEYS.items() if n.startswith(PREFIX)}
    assert len(shapes) == 100
    shapes |= {"fc.weight": [1000, 512], "fc.bias": [1000]}
    tensors = {name: torch.from_numpy(fill.weight(name, shape)) for name, shape in shapes.items()}
    tensors |= {
        name.replace("running_mean", "num_batches_tracked"): torch.tensor(7)
        for name in shapes
        if name.endswith("running_mean")
    }
    assert len(tensors) == 122  # as torchvision's has
    file = tmp_path_factory.mktemp("torchvision") / "resnet18-f37072fd.pth"
    torch.save(tensors, file)
    return file, tensors


def test_act_starts_from_them(published) -> None:
    file, tensors = published
    model = ACT(dim_model=32, n_heads=4, dim_feedforward=8, backbone_weights=str(file))
    head = model.action_head.weight.detach().clone()
    load_part_weights(model, model.part_weights)
    state = model.backbone.state_dict()
    assert len(state) == 100
    assert all(torch.equal(tensor, tensors[name]) for name, tensor in state.items())
    assert torch.equal(model.action_head.weight, head)


def test_every_encoder_of_a_diffusion_policy_starts_from_them(published) -> None:
    file, tensors = published
    model = DiffusionPolicy(
        num_cameras=2,
        separate_encoders=True,
        down_dims=(8, 16),
        horizon=8,
        backbone_norm="batch",
        backbone_weights=str(file),
    )
    load_part_weights(model, model.part_weights)
    for encoder in model.rgb_encoders:
        state = encoder.backbone.state_dict()
        assert len(state) == 120
        assert all(torch.equal(tensor, tensors[name]) for name, tensor in state.items())


def test_other_networks_are_refused(published, tmp_path: Path) -> None:
    file, tensors = published
    with pytest.raises(ConfigError, match="backbone_norm is 'group'"):
        ACT(backbone_norm="group", backbone_weights=str(file))
    small = {"dim_model": 32, "n_heads": 4, "dim_feedforward": 8}
    deep = ACT(**small, backbone="resnet34", backbone_weights=str(file))
    with pytest.raises(CheckpointError, match=r"80 missing: layer1\.2\.bn1\.bias"):
        load_part_weights(deep, deep.part_weights)
    thin = ACT(**small, backbone_width=16, backbone_weights=str(file))
    with pytest.raises(CheckpointError, match=r"100 of another size: bn1\.bias: \(64,\) there"):
        load_part_weights(thin, thin.part_weights)
    torch.save({**tensors, "aux.weight": torch.zeros(1)}, tmp_path / "more.pth")
    more = ACT(**small, backbone_weights=str(tmp_path / "more.pth"))
    with pytest.raises(CheckpointError, match=r"1 left over: aux\.weight"):
        load_part_weights(more, more.part_weights)
