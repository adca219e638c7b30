"""The network of the end-to-end benchmark: what it leaves out changes nothing."""

from __future__ import annotations

from unittest import mock

import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from benchmarks._act_agreement import ours
from benchmarks._act_model import BenchACT, FrozenConv, Tokens

CHUNK, DIM = 6, 3
SMALL = {"width": 32, "heads": 2, "inner": 40, "layers": 2, "latent": 4, "dropout": 0.0}


def model(**settings: object) -> BenchACT:
    torch.manual_seed(0)
    return BenchACT(state_dim=DIM, action_dim=DIM, chunk=CHUNK, **SMALL, **settings)


@pytest.fixture
def batch() -> dict[str, Tensor]:
    rng = torch.Generator().manual_seed(1)
    masks = torch.ones(3, CHUNK)
    masks[0, 2:] = masks[2, 5:] = 0.0
    return {
        "images": torch.randn(3, 6, 32, 64, generator=rng),
        "states": torch.randn(3, DIM, generator=rng),
        "actions": torch.randn(3, CHUNK, DIM, generator=rng),
        "action_masks": masks,
    }


def computed(found: BenchACT, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
    with mock.patch("torch.randn_like", torch.zeros_like):
        loss = found(**batch)["loss"]
    loss.backward()
    gradients = {n: p.grad for n, p in found.named_parameters() if p.grad is not None}
    return loss.detach(), gradients


def test_padding_can_be_skipped(batch: dict[str, Tensor]) -> None:
    loss, gradients = computed(model(skip_padding=True), batch)
    expected, every = computed(model(skip_padding=False), batch)
    assert float(loss) == pytest.approx(float(expected), rel=1e-5)
    assert gradients.keys() == every.keys()
    for name, gradient in gradients.items():
        torch.testing.assert_close(gradient, every[name], rtol=1e-3, atol=1e-5, msg=name)


def test_padding_does_not_count(batch: dict[str, Tensor]) -> None:
    loss, _ = computed(model(), batch)
    batch["actions"][batch["action_masks"] == 0] = 100.0
    for skip in (True, False):
        again, _ = computed(model(skip_padding=skip), batch)
        assert float(again) == pytest.approx(float(loss), rel=1e-5)


def test_a_chunk_of_every_sample(batch: dict[str, Tensor]) -> None:
    found = model().eval()
    chunks = found.predict_action(**batch)
    assert chunks.shape == (3, CHUNK, DIM)
    alone = found.predict_action(batch["images"][1:2], batch["states"][1:2])
    torch.testing.assert_close(alone[0], chunks[1], rtol=1e-4, atol=1e-5)


def test_rows_go_where_they_belong() -> None:
    kept = torch.tensor([[True, False, True], [False, True, False]])
    tokens = Tokens(2, 3, kept)
    rows = torch.arange(1.0, 13.0).view(3, 4)
    spread = tokens.spread(rows, heads=2)
    assert spread.shape == (2, 2, 3, 2)
    assert spread[0, :, 2].flatten().tolist() == rows[1].tolist()
    assert spread[1, :, 1].flatten().tolist() == rows[2].tolist()
    assert not spread[0, :, 1].any()
    assert torch.equal(tokens.rows(spread), rows)


def test_a_frozen_norm_is_part_of_its_convolution() -> None:
    torch.manual_seed(0)
    weight, x = torch.randn(4, 3, 3, 3), torch.randn(2, 3, 8, 8)
    norm = {"weight": torch.rand(4), "bias": torch.randn(4)}
    norm |= {"running_mean": torch.randn(4), "running_var": torch.rand(4)}
    state = {"model.backbone.layer2.1.conv1.weight": weight}
    state |= {f"model.backbone.layer2.1.bn1.{name}": value for name, value in norm.items()}
    prefix = "backbone.blocks.3.conv1."
    conv = FrozenConv(3, 4, 3)
    conv.load_state_dict({n.removeprefix(prefix): v for n, v in ours(state).items()})
    expected = F.batch_norm(
        F.conv2d(x, weight, padding=1),
        norm["running_mean"],
        norm["running_var"],
        norm["weight"],
        norm["bias"],
    )
    torch.testing.assert_close(conv(x), expected)


def test_lerobots_names_are_ours() -> None:
    state = {
        "model.vae_encoder.layers.3.self_attn.in_proj_weight": torch.arange(18.0).view(6, 3),
        "model.decoder.layers.0.multihead_attn.out_proj.bias": torch.zeros(1),
        "model.decoder.layers.0.norm3.weight": torch.zeros(1),
        "model.decoder.norm.bias": torch.zeros(1),
        "model.encoder.layers.1.linear2.weight": torch.zeros(1),
        "model.encoder_robot_state_input_proj.weight": torch.zeros(1),
        "model.vae_encoder_robot_state_input_proj.bias": torch.zeros(1),
        "model.vae_encoder_pos_enc": torch.zeros(1, 5, 2),
        "model.backbone.layer4.0.downsample.0.weight": torch.zeros(1),
    }
    found = ours(state)
    assert set(found) == {
        "action_encoder.3.own.query.weight",
        "action_encoder.3.own.key.weight",
        "action_encoder.3.own.value.weight",
        "decoder.0.memory.out.bias",
        "decoder.0.norms.2.weight",
        "decoder_norm.bias",
        "encoder.1.feed.down.weight",
        "state.weight",
        "style_state.bias",
        "style_places",
        "backbone.blocks.6.shortcut.weight",
    }
    assert found["action_encoder.3.own.key.weight"].flatten().tolist() == [*range(6, 12)]
    assert found["style_places"].shape == (5, 2)
