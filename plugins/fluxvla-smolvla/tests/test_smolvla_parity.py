"""SmolVLA against what LeRobot 0.6.1 computed (``oracles/make_lerobot061.py``), and against the
SmolVLM that is installed."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from fluxvla_smolvla.lerobot_files import published
from safetensors.torch import load_file

from .tiny import GOLDEN, HORIZON, VISION, WIDTH, model_batch, relative, tiny_model

NARROW = 5e-2
"""Of the largest: the gate of bfloat16."""
CASES = {
    "expert": {},
    "whole": {"train_expert_only": False, "freeze_vision_encoder": False},
    "sparse": {"self_attn_every_n_layers": 1, "num_expert_layers": 2},
}


@pytest.fixture(scope="module")
def golden() -> dict[str, torch.Tensor]:
    return load_file(GOLDEN / "smolvla.safetensors")


@pytest.mark.parametrize("case", CASES)
def test_losses_and_gradients(golden, case):
    model = tiny_model(**CASES[case])
    found = model(**model_batch())
    found["loss"].backward()

    assert relative(found["loss"].detach(), golden[f"{case}.loss"]) < 1e-5
    assert relative(found["sample_losses"], golden[f"{case}.sample_losses"]) < 1e-5
    parameters = model.named_parameters()
    gradients = {published(n): p.grad for n, p in parameters if p.grad is not None}
    norms = torch.stack([gradients[n].norm() for n in sorted(gradients)])
    assert norms.shape == golden[f"{case}.norms"].shape
    # A bias of keys changes no softmax: its gradient is 0 but for rounding.
    expected = golden[f"{case}.norms"]
    assert ((norms - expected).abs() <= 1e-5 * expected + 1e-8 * expected.max()).all()
    prefix = f"{case}.gradient."
    stored = [name.removeprefix(prefix) for name in golden if name.startswith(prefix)]
    assert len(stored) >= 6
    for name in stored:
        assert relative(gradients[name], golden[prefix + name]) < 1e-5, name


def test_in_bf16_losses_and_gradients_differ_no_more_than_there(golden):
    model = tiny_model(**CASES["whole"])
    with torch.autocast("cpu", torch.bfloat16):
        found = model(**model_batch())
    found["loss"].backward()
    assert 0 < relative(golden["bf16.whole.loss"], golden["whole.loss"]) < NARROW
    for name in ("bf16.whole.loss", "whole.loss"):
        assert relative(found["loss"].detach(), golden[name]) < NARROW
    gradients = {published(n): p.grad for n, p in model.named_parameters() if p.grad is not None}
    norms = torch.stack([gradients[n].norm() for n in sorted(gradients)])
    for name in ("bf16.whole.norms", "whole.norms"):
        assert relative(norms, golden[name]) < NARROW


def test_what_is_trained_is_what_gets_a_gradient():
    for settings in CASES.values():
        model = tiny_model(**settings)
        model(**model_batch())["loss"].backward()
        for name, parameter in model.named_parameters():
            assert parameter.requires_grad == (parameter.grad is not None), name


def test_the_vision_tower_is_the_installed_one():
    from fluxvla_smolvla.sizes import VisionSize
    from fluxvla_smolvla.vision import Connector, VisionTower
    from transformers import SmolVLMConfig
    from transformers.models.smolvlm.modeling_smolvlm import (
        SmolVLMConnector,
        SmolVLMVisionTransformer,
    )

    names = {"layers": "num_hidden_layers", "heads": "num_attention_heads"}
    table = {names.get(k, k): v for k, v in VISION.items() if k != "scale_factor"}
    config = SmolVLMConfig(vision_config=table, text_config={"model_type": "llama"}, scale_factor=2)
    config.text_config.hidden_size = 128
    torch.manual_seed(0)
    tower, connector = SmolVLMVisionTransformer(config.vision_config), SmolVLMConnector(config)
    ours, ours_connector = VisionTower(VisionSize(**VISION)), Connector(VisionSize(**VISION), 128)
    for parameter in (*tower.parameters(), *connector.parameters()):
        torch.nn.init.normal_(parameter, std=0.1)
    theirs = {
        name.removeprefix("encoder.").removeprefix("embeddings."): tensor
        for name, tensor in tower.state_dict().items()
    }
    ours.load_state_dict(theirs)
    ours_connector.proj.load_state_dict(connector.modality_projection.proj.state_dict())
    for height, width in ((64, 64), (32, 32), (128, 128)):
        pixels = torch.randn(2, 3, height, width)
        with torch.no_grad():
            expected = connector(tower(pixel_values=pixels).last_hidden_state)
            found = ours_connector(ours(pixels))
        assert relative(found, expected) < 1e-5


def test_the_language_model_is_the_installed_one():
    """Without a state token's influence, one layer is a Llama's, but for the rotary wavelengths."""
    from fluxvla_smolvla.sizes import TextSize
    from fluxvla_smolvla.transformer import ContextLayer, Prefix, Rotation
    from transformers import LlamaConfig
    from transformers.models.llama.modeling_llama import LlamaDecoderLayer, LlamaRotaryEmbedding

    config = LlamaConfig(
        hidden_size=128,
        intermediate_size=160,
        num_attention_heads=2,
        num_key_value_heads=1,
        head_dim=64,
        rms_norm_eps=1e-5,
    )
    config._attn_implementation = "eager"
    torch.manual_seed(0)
    theirs = LlamaDecoderLayer(config, 0)
    ours = ContextLayer(
        TextSize(hidden_size=128, intermediate_size=160, heads=2, kv_heads=1, layers=1)
    )
    ours.load_state_dict(theirs.state_dict())
    tokens, positions = torch.randn(2, 6, 128), torch.arange(6)[None].expand(2, -1)
    prefix = Prefix(
        torch.ones(2, 1, 1, 6, dtype=torch.bool),
        Rotation.at(positions, 64),
        Rotation.at(torch.full((2, 1), 6), 64),
    )
    with torch.no_grad():
        found = ours(tokens, torch.randn(2, 1, 128), prefix)[0]
        rotary = LlamaRotaryEmbedding(config)(tokens, positions)
        expected = theirs(tokens, attention_mask=None, position_embeddings=rotary)
        expected = expected[0] if isinstance(expected, tuple) else expected
    assert relative(found, expected) < 1e-5


def test_draws_share_the_language_models_part():
    """K draws are K samples of the same observation."""
    model, batch = tiny_model(loss_mean="all"), model_batch()
    noise = torch.randn(3, 2, HORIZON, WIDTH, generator=torch.Generator().manual_seed(0))
    time = torch.tensor([[0.1, 0.9], [0.5, 0.3], [0.0, 0.999]])
    both = model(**{**batch, "noise": noise, "time": time})["loss"]
    drawn = [{"noise": noise[:, k : k + 1], "time": time[:, k : k + 1]} for k in (0, 1)]
    each = [model(**{**batch, **draw})["loss"].item() for draw in drawn]
    assert both.item() == pytest.approx(sum(each) / 2, rel=1e-5)


@pytest.mark.parametrize("mean", ["valid", "all"])
def test_the_loss_is_its_definition_written_out(mean):
    model, batch = tiny_model(loss_mean=mean), model_batch()
    masks = batch["action_masks"].numpy()
    each = [model(**{k: v[i : i + 1] for k, v in batch.items()}) for i in range(3)]
    losses = np.array([e["loss"].item() for e in each])
    weights = masks.sum(1) if mean == "valid" else np.ones(3)
    found = model(**batch)
    assert found["loss"].item() == pytest.approx((losses * weights).sum() / weights.sum(), rel=1e-5)
    np.testing.assert_allclose(found["sample_losses"].numpy(), losses, rtol=1e-4)


def test_an_empty_instruction_and_no_camera_give_numbers():
    model, batch = tiny_model(), model_batch()
    batch["img_masks"] = torch.zeros_like(batch["img_masks"])
    batch["lang_masks"] = torch.zeros_like(batch["lang_masks"])
    loss = model(**batch)["loss"]
    loss.backward()
    assert torch.isfinite(loss)
    assert all(torch.isfinite(p.grad).all() for p in model.parameters() if p.grad is not None)
