from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from fluxvla_models.compact_vla import CompactVLA
from fluxvla_models.conv_encoder import ConvEncoder, SpatialSoftmax
from fluxvla_models.flow_matching_head import FlowMatchingHead
from fluxvla_models.sentence_encoder import MINILM, SentenceEncoder

from fluxvla_core import build_vla_from_cfg
from fluxvla_core.config.load import load_config
from fluxvla_core.data import resolve_model_path
from fluxvla_core.errors import ConfigError

ROOT = Path(__file__).parents[3]
SMALL = {
    "vision_backbone": {"type": "ConvEncoder", "image_size": (32, 48), "channels": (8, 8, 16)},
    "llm_backbone": {"type": "SentenceEncoder"},
    "projector": {"type": "FiLMProjector", "width": 16},
    "vla_head": {"type": "FlowMatchingHead", "horizon": 4, "action_dim": 3, "width": 16},
}


@pytest.fixture(scope="module")
def sentences() -> SentenceEncoder:
    return SentenceEncoder()


@pytest.fixture
def model(sentences) -> CompactVLA:
    torch.manual_seed(0)
    return CompactVLA(**{**SMALL, "llm_backbone": sentences}, state_dim=3)


def make_batch(size: int = 5, draws: int = 2) -> dict[str, torch.Tensor]:
    torch.manual_seed(1)
    tokens = torch.tensor([[101, 4060, 1996, 14291, 102, 0], [101, 2192, 2009, 102, 0, 0]])
    rows = torch.arange(size) % 2
    masks = torch.ones(size, 4)
    masks[0, 2:] = 0
    return {
        "images": torch.randn(size, 3, 32, 48),
        "lang_tokens": tokens[rows],
        "lang_masks": tokens[rows] != 0,
        "states": torch.randn(size, 3),
        "actions": torch.randn(size, 4, 3),
        "action_masks": masks,
        "noise": torch.randn(size, draws, 4, 3),
        "time": torch.rand(size, draws),
    }


def test_the_loss_equals_its_definition_written_out(model):
    batch = make_batch()
    text = model.llm_backbone(batch["lang_tokens"], batch["lang_masks"])
    context = model.projector(model.vision_backbone(batch["images"]), text, batch["states"])
    total, count = 0.0, 0
    for b in range(5):
        for k in range(2):
            t = batch["time"][b, k]
            mixed = (1 - t) * batch["noise"][b, k] + t * batch["actions"][b]
            found = model.vla_head.estimate(mixed[None], t[None], context[b : b + 1])[0]
            error = (found - batch["actions"][b]) ** 2 * batch["action_masks"][b][:, None]
            total, count = total + error.sum().item(), count + error.numel()
    assert model(**batch)["loss"].item() == pytest.approx(total / count, rel=1e-5)


def test_masked_actions_do_not_matter(model):
    batch = make_batch()
    other = {**batch, "actions": batch["actions"].clone()}
    other["actions"][0, 2:] = 100.0
    # The noised chunk is an input, so only its masked targets are free: keep t at 0 there.
    batch["time"][0], other["time"][0] = 0.0, 0.0
    assert torch.equal(model(**batch)["loss"], model(**other)["loss"])


def test_each_samples_loss_is_told_and_their_mean_is_the_loss(model):
    batch = make_batch()
    found = model(**batch)
    assert found["sample_losses"].shape == (5,)
    assert not found["sample_losses"].requires_grad
    assert found["sample_losses"].mean().item() == pytest.approx(found["loss"].item(), rel=1e-6)
    alone = model(**{k: v[2:3] for k, v in batch.items()})["loss"]
    assert found["sample_losses"][2].item() == pytest.approx(alone.item(), rel=1e-5)


def test_a_head_that_only_knows_its_loss_is_enough(model, monkeypatch):
    batch = make_batch()
    expected = model(**batch)["loss"]
    head = model.vla_head
    monkeypatch.delattr(type(head), "errors")
    monkeypatch.setattr(type(head), "loss", lambda self, *inputs: expected)
    assert model(**batch) == {"loss": expected}


def test_the_mean_of_two_halves_is_the_loss_of_the_whole(model):
    batch = make_batch(size=4)
    halves = [model(**{k: v[i : i + 2] for k, v in batch.items()})["loss"] for i in (0, 2)]
    assert model(**batch)["loss"].item() == pytest.approx(
        sum(h.item() for h in halves) / 2, rel=1e-5
    )


def test_sampling_follows_the_velocity_field():
    torch.manual_seed(0)
    head = FlowMatchingHead(horizon=2, action_dim=3, context_dim=8, width=16, num_steps=4)
    context, x = torch.randn(1, 8), torch.randn(1, 2, 3)
    found = head.sample(context, x)
    for step in range(4):
        t = step / 4
        velocity = (head.estimate(x, torch.tensor([t]), context) - x) / (1 - t)
        x = x + velocity / 4
    torch.testing.assert_close(found, x)


def test_a_prediction_does_not_depend_on_its_company(model):
    batch = {k: v for k, v in make_batch().items() if k not in ("actions", "action_masks", "time")}
    batch["noise"] = batch["noise"][:, 0]
    together = model.predict_action(**batch)
    alone = model.predict_action(**{k: v[3:4] for k, v in batch.items()})
    torch.testing.assert_close(together[3:4], alone)
    assert model.action_shape == (4, 3)


def test_an_instructions_vector_is_the_same_bit_for_bit_in_any_batch(sentences):
    batch = make_batch()
    tokens, masks = batch["lang_tokens"], batch["lang_masks"]
    first = sentences(tokens, masks)
    sentences._known.clear()
    assert torch.equal(sentences(tokens[1:2], masks[1:2])[0], first[1])


def test_the_sentence_encoder_equals_pooling_done_by_hand(sentences):
    from transformers import AutoModel

    reference = AutoModel.from_pretrained(
        str(resolve_model_path(MINILM)), local_files_only=True, trust_remote_code=False
    )
    batch = make_batch(size=2)
    ids, mask = batch["lang_tokens"][1:2], batch["lang_masks"][1:2]
    states = reference(input_ids=ids[:, :4], attention_mask=mask[:, :4].long()).last_hidden_state
    pooled = states[0].mean(0)
    expected = pooled / pooled.norm() * 384**0.5
    torch.testing.assert_close(sentences(ids, mask)[0], expected, rtol=1e-4, atol=1e-4)


def test_padding_tokens_under_the_mask_do_not_matter(sentences):
    batch = make_batch(size=2)
    tokens = batch["lang_tokens"].clone()
    tokens[1, 4:] = 2003
    assert torch.equal(sentences(tokens, batch["lang_masks"])[1], sentences(**_lang(batch))[1])


def _lang(batch):
    return {"tokens": batch["lang_tokens"], "masks": batch["lang_masks"]}


def test_vectors_made_at_inference_serve_a_later_training_step(sentences, model):
    batch = make_batch()
    sentences._known.clear()
    with torch.inference_mode():
        model(**batch)
    model(**batch)["loss"].backward()
    assert all(p.grad is not None for p in model.parameters() if p.requires_grad)


def test_the_text_encoder_is_frozen_and_stays_in_evaluation_mode(model):
    model.train()
    assert not any(p.requires_grad for p in model.llm_backbone.parameters())
    assert not model.llm_backbone.encoder.training
    assert model.vla_head.training


def test_it_has_as_many_parameters_as_its_pages_say():
    table = load_config(ROOT / "configs" / "aloha_sim_transfer.py").tree["model"]
    with torch.device("meta"):
        built = build_vla_from_cfg(table)
    count = {True: 0, False: 0}
    for parameter in built.parameters():
        count[parameter.requires_grad] += parameter.numel()
    trained, frozen = count[True], count[False]
    assert frozen == sum(p.numel() for p in built.llm_backbone.parameters())
    models = " ".join((ROOT / "docs" / "models.md").read_text().split())
    assert f"| CompactVLA | {trained + frozen:,} |" in models
    assert f"{frozen:,} are those of its frozen sentence encoder; {trained:,} are trained" in models
    short, rest = f"{trained / 1e6:.1f} million", f"{frozen / 1e6:.1f} million"
    for text in ((Path(__file__).parents[1] / "README.md").read_text(), str(CompactVLA.__doc__)):
        said = " ".join(text.split())
        assert short in said
        assert f"frozen sentence encoder of {rest}" in said


def test_units_to_shard_are_disjoint_and_trainable(model):
    units = model.fsdp_units()
    seen = [id(p) for unit in units for p in unit.parameters()]
    assert len(seen) == len(set(seen))
    assert all(p.requires_grad for unit in units for p in unit.parameters())


def test_spatial_softmax_finds_a_peak():
    module = SpatialSoftmax(1, 1)
    torch.nn.init.constant_(module.to_maps.weight, 50.0)
    torch.nn.init.zeros_(module.to_maps.bias)
    image = torch.zeros(1, 1, 5, 9)
    image[0, 0, 1, 6] = 1.0
    torch.testing.assert_close(module(image)[0], torch.tensor([0.5, -0.5]), atol=1e-4, rtol=0)


def test_one_encoder_serves_several_cameras():
    torch.manual_seed(0)
    encoder = ConvEncoder((32, 48), (8, 8, 16), keypoints=4, map_channels=2, num_cameras=2)
    images = torch.randn(3, 6, 32, 48)
    found = encoder(images)
    assert found.shape == (3, encoder.out_dim)
    swapped = encoder(torch.cat([images[:, 3:], images[:, :3]], 1))
    half = encoder.out_dim // 2
    torch.testing.assert_close(found[:, :half], swapped[:, half:])
    with pytest.raises(ConfigError, match="set num_cameras to the number of"):
        encoder(images[:, :3])


def test_an_image_size_that_does_not_divide_is_refused():
    with pytest.raises(ValueError, match="multiples of 16, got 30x48"):
        ConvEncoder((30, 48))


def test_the_model_learns_one_batch_and_tells_instructions_apart(model):
    """Same images and states, two instructions, two behaviours: after training both are right."""
    torch.manual_seed(2)
    batch = make_batch(size=2, draws=4)
    for key in ("images", "states"):
        batch[key] = batch[key][:1].repeat(2, *[1] * (batch[key].ndim - 1))
    batch["action_masks"] = torch.ones(2, 4)
    optimizer = torch.optim.AdamW(model.parameters(), 3e-3)
    for _ in range(200):
        batch["noise"], batch["time"] = torch.randn(2, 4, 4, 3), torch.rand(2, 4)
        optimizer.zero_grad()
        model(**batch)["loss"].backward()
        optimizer.step()
    asked = {k: batch[k] for k in ("images", "lang_tokens", "lang_masks", "states")}
    found = model.predict_action(**asked, noise=torch.randn(2, 4, 3))
    own = (found - batch["actions"]).square().mean((1, 2)).sqrt()
    other = (found - batch["actions"].flip(0)).square().mean((1, 2)).sqrt()
    assert (own < 0.3).all()
    assert (other > 3 * own).all()
    assert math.isfinite(own.sum().item())
