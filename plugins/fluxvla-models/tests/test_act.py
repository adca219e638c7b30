"""ACT: its loss written out, what it learns, and what it refuses."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from fluxvla_models.act import ACT
from fluxvla_models.draws import SampleLatentNoise
from fluxvla_models.resnet import FixedBatchNorm2d, ResNet

from fluxvla_core.errors import ConfigError

SMALL = {
    "state_dim": 5,
    "action_dim": 3,
    "horizon": 4,
    "num_cameras": 2,
    "backbone_norm": "group",
    "backbone_width": 16,
    "dim_model": 32,
    "n_heads": 4,
    "dim_feedforward": 48,
    "n_encoder_layers": 1,
    "n_vae_encoder_layers": 1,
    "latent_dim": 6,
    "dropout": 0.0,
}


def make(**more: object) -> ACT:
    torch.manual_seed(0)
    return ACT(**{**SMALL, **more}).train()


def batch_of(size: int = 4) -> dict[str, torch.Tensor]:
    torch.manual_seed(1)
    masks = torch.ones(size, 4)
    masks[0, 2:] = 0
    return {
        "images": torch.randn(size, 6, 34, 40),
        "states": torch.randn(size, 5),
        "actions": torch.randn(size, 4, 3),
        "action_masks": masks,
        "latent_noise": torch.randn(size, 6),
    }


def asked(batch: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    return {key: batch[key] for key in ("images", "states")}


@pytest.mark.parametrize("masked_mean", [False, True])
def test_the_loss_is_an_absolute_error_and_a_divergence(masked_mean: bool) -> None:
    batch = batch_of()
    model = make(use_vae=False, masked_mean=masked_mean)
    batch.pop("latent_noise")
    found = model.predict_action(**asked(batch))
    error = (found - batch["actions"]).abs() * batch["action_masks"][..., None]
    count = 3 * batch["action_masks"].sum() if masked_mean else error.numel()
    assert model(**batch)["loss"].item() == pytest.approx((error.sum() / count).item(), rel=1e-5)


def test_the_divergence_is_zero_at_the_prior_and_weighs() -> None:
    batch = batch_of()
    for weight, expected in ((0.0, 0.0), (10.0, 10 * 6 * 0.5 * (0.25 + np.e - 1 - 1))):
        model = make(kl_weight=weight)
        layer = model.vae_encoder_latent_output_proj
        torch.nn.init.zeros_(layer.weight)
        prior = torch.zeros(12)
        with torch.no_grad():
            layer.bias.copy_(prior)
        base = model(**batch)["loss"].item()
        with torch.no_grad():
            layer.bias.copy_(torch.cat([prior[:6] + 0.5, prior[6:] + 1.0]))
            # What the latent does to the actions must not count here.
            model.encoder_latent_input_proj.weight.zero_()
        still = make(kl_weight=0.0)
        still.load_state_dict(model.state_dict())
        difference = model(**batch)["loss"].item() - still(**batch)["loss"].item()
        assert difference == pytest.approx(expected, rel=1e-4, abs=1e-5)
        assert np.isfinite(base)


def test_the_latent_is_drawn_by_the_batch_in_training_and_zero_else() -> None:
    model, batch = make(), batch_of()
    loss = model(**batch)["loss"]
    assert torch.equal(model(**batch)["loss"], loss)
    other = {**batch, "latent_noise": -batch["latent_noise"]}
    assert not torch.equal(model(**other)["loss"], loss)
    model.eval()
    assert torch.equal(model(**other)["loss"], model(**batch)["loss"])


def test_the_mean_of_two_halves_is_the_loss_of_the_whole() -> None:
    model, batch = make(), batch_of()
    halves = [model(**{k: v[i : i + 2] for k, v in batch.items()})["loss"] for i in (0, 2)]
    found = model(**batch)
    assert found["loss"].item() == pytest.approx(sum(h.item() for h in halves) / 2, rel=1e-5)
    assert found["sample_losses"].mean().item() == pytest.approx(found["loss"].item(), rel=1e-5)


def test_actions_beyond_the_end_do_not_matter() -> None:
    model, batch = make(), batch_of()
    other = {**batch, "actions": batch["actions"].clone()}
    other["actions"][0, 2:] = 100.0
    torch.testing.assert_close(model(**other)["loss"], model(**batch)["loss"])


def test_it_learns_a_batch() -> None:
    model, batch = make(backbone_width=8), batch_of()
    batch |= {"action_masks": torch.ones(4, 4), "images": batch["images"][..., :32, :32]}
    optimizer = torch.optim.AdamW(model.parameters(), 3e-3)
    for _ in range(100):
        optimizer.zero_grad()
        model(**batch)["loss"].backward()
        optimizer.step()
    found = model.eval().predict_action(**asked(batch))
    assert (found - batch["actions"]).abs().mean() < 0.25
    assert found.shape == (4, *model.action_shape)


def test_a_prediction_does_not_depend_on_its_company() -> None:
    model, batch = make().eval(), asked(batch_of())
    together = model.predict_action(**batch)
    alone = model.predict_action(**{k: v[2:3] for k, v in batch.items()})
    torch.testing.assert_close(alone, together[2:3])


def test_every_parameter_is_trained_and_units_are_disjoint() -> None:
    model = make()
    model(**batch_of())["loss"].backward()
    assert [name for name, p in model.named_parameters() if p.grad is None] == []
    seen = [id(p) for unit in model.fsdp_units() for p in unit.parameters()]
    assert len(seen) == len(set(seen))


def test_batches_that_do_not_fit() -> None:
    model, batch = make(), batch_of()
    with pytest.raises(ConfigError, match=r"actions are \(3, 3\), the model's are \(4, 3\)"):
        model(**{**batch, "actions": batch["actions"][:, :3]})
    with pytest.raises(ConfigError, match=r"num_cameras is 2, .* 3 image channels \(1 cameras\)"):
        model(**{**batch, "images": batch["images"][:, :3]})
    with pytest.raises(ConfigError, match=r"latent_noise of shape \(4, 6\), got none") as message:
        model(**{**batch, "latent_noise": None})
    assert "SampleLatentNoise" in str(message.value.next)
    with pytest.raises(ConfigError, match=r"got one of shape \(4, 5\)"):
        model(**{**batch, "latent_noise": batch["latent_noise"][:, :5]})


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"dim_model": 30}, "dim_model 30 must be a multiple of n_heads 4 and of 4"),
        ({"backbone": "resnet50"}, "'resnet50' of a residual network is not one of resnet18, re"),
        ({"backbone_norm": "layer"}, "norm 'layer' of a residual network is not one of frozen_ba"),
        ({"feedforward_activation": "glu"}, "activation 'glu' is not one of relu, gelu"),
    ],
)
def test_settings_that_do_not_work(settings: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make(**settings)


def test_the_batch_says_what_it_needs() -> None:
    assert make().batch_keys()["latent_noise"]
    assert not make(use_vae=False).batch_keys()["latent_noise"]


def test_running_statistics_are_used_and_kept() -> None:
    """A batch's own would make a loss depend on which samples share a process."""
    torch.manual_seed(0)
    network = ResNet(norm="batch", width=16).train()
    images = torch.randn(4, 3, 64, 64)
    before = {k: v.clone() for k, v in network.state_dict().items()}
    together = network(images)
    torch.testing.assert_close(network(images[1:2]), together[1:2])
    assert all(torch.equal(v, before[k]) for k, v in network.state_dict().items())
    assert not any(m.training for m in network.modules() if isinstance(m, FixedBatchNorm2d))


def test_the_noise_of_the_latent_follows_from_the_generator() -> None:
    draw = SampleLatentNoise(6)
    first, same, other = (
        draw({"states": 1}, np.random.default_rng(seed))["latent_noise"] for seed in (1, 1, 2)
    )
    assert first.shape == (6,)
    assert first.dtype == np.float32
    assert np.array_equal(first, same)
    assert not np.array_equal(first, other)
    with pytest.raises(ConfigError, match="dim must be at least 1, got 0"):
        SampleLatentNoise(0)


def test_in_mixed_precision() -> None:
    model, batch = make(), batch_of()
    expected = model(**batch)["loss"].item()
    with torch.autocast("cpu", torch.bfloat16):
        loss = model(**batch)["loss"]
    loss.backward()
    assert loss.item() == pytest.approx(expected, rel=0.05)
    assert all(p.grad.dtype == torch.float32 for p in model.parameters())
