"""Diffusion Policy: its loss written out, what it learns, its crops, and what it refuses."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from fluxvla_models.diffusion_policy import DiffusionPolicy, following
from fluxvla_models.diffusion_schedule import DiffusionSchedule
from fluxvla_models.draws import SampleDiffusionNoise
from fluxvla_models.keypoint_encoder import Keypoints, cropped, position_grid

from fluxvla_core.errors import ConfigError

SMALL = {
    "state_dim": 5,
    "action_dim": 3,
    "horizon": 8,
    "num_cameras": 2,
    "backbone_width": 16,
    "keypoints": 8,
    "down_dims": (16, 32),
    "diffusion_step_embed_dim": 16,
    "num_train_timesteps": 20,
}


def make(**more: object) -> DiffusionPolicy:
    torch.manual_seed(0)
    return DiffusionPolicy(**{**SMALL, **more}).train()


def batch_of(size: int = 4, draws: int = 2) -> dict[str, torch.Tensor]:
    torch.manual_seed(1)
    masks = torch.ones(size, 8)
    masks[0, 5:] = 0
    return {
        "images": torch.randn(size, 6, 72, 64),
        "states": torch.randn(size, 5),
        "actions": torch.rand(size, 8, 3) * 2 - 1,
        "action_masks": masks,
        "noise": torch.randn(size, draws, 8, 3),
        "timesteps": torch.randint(0, 20, (size, draws)),
    }


@pytest.mark.parametrize("prediction", ["epsilon", "sample"])
@pytest.mark.parametrize("masked_mean", [False, True])
def test_the_loss_written_out(prediction: str, masked_mean: bool) -> None:
    model, batch = make(prediction_type=prediction, masked_mean=masked_mean), batch_of()
    shares = model.schedule.shares()
    condition = model._condition(batch["images"], batch["states"], None)
    total, count = 0.0, 0.0
    for b in range(4):
        for k in range(2):
            step, eps = batch["timesteps"][b, k], batch["noise"][b, k]
            share, clean = shares[step], batch["actions"][b]
            noisy = share.sqrt() * clean + (1 - share).sqrt() * eps
            found = model.unet(noisy[None], step[None], condition[b : b + 1])[0]
            error = (found - (eps if prediction == "epsilon" else clean)).square()
            mask = batch["action_masks"][b] if masked_mean else torch.ones(8)
            total += (error * mask[:, None]).sum().item()
            count += 3 * mask.sum().item()
    found = model(**batch)
    assert found["loss"].item() == pytest.approx(total / count, rel=1e-4)
    assert found["sample_losses"].mean().item() == pytest.approx(total / count, rel=1e-4)


def test_the_mean_of_two_halves_is_the_loss_of_the_whole() -> None:
    model, batch = make(), batch_of()
    halves = [model(**{k: v[i : i + 2] for k, v in batch.items()})["loss"] for i in (0, 2)]
    whole = model(**batch)["loss"].item()
    assert whole == pytest.approx(sum(h.item() for h in halves) / 2, rel=1e-5)


def test_it_learns_a_batch() -> None:
    model, batch = make(num_inference_steps=10, backbone_width=8), batch_of(size=2)
    batch["images"] = batch["images"][..., :32, :32]
    optimizer = torch.optim.AdamW(model.parameters(), 3e-3)
    for _ in range(200):
        batch["noise"] = torch.randn(2, 16, 8, 3)
        batch["timesteps"] = torch.randint(0, 20, (2, 16))
        optimizer.zero_grad()
        model(**batch)["loss"].backward()
        optimizer.step()
    with torch.inference_mode():
        found = model.eval().predict_action(batch["images"], batch["states"], torch.randn(2, 8, 3))
    own = (found - batch["actions"]).abs().mean((1, 2))
    other = (found - batch["actions"].flip(0)).abs().mean((1, 2))
    assert (own < 0.3).all()
    assert (other > 2 * own).all()


@pytest.mark.parametrize("kind", ["DDPM", "DDIM"])
def test_an_answer_follows_from_its_own_noise(kind: str) -> None:
    model = make(noise_scheduler_type=kind, num_inference_steps=4).eval()
    batch = batch_of()
    with torch.inference_mode():
        ask = {k: batch[k] for k in ("images", "states")} | {"noise": batch["noise"][:, 0]}
        together = model.predict_action(**ask)
        assert torch.equal(model.predict_action(**ask), together)
        alone = model.predict_action(**{k: v[1:2] for k, v in ask.items()})
        torch.testing.assert_close(alone, together[1:2], rtol=1e-4, atol=1e-5)
        other = model.predict_action(**{**ask, "noise": -ask["noise"]})
    assert not torch.allclose(other, together)
    assert together.shape == (4, *model.action_shape)


def test_noise_that_follows_from_noise_is_standard_normal_and_its_own() -> None:
    torch.manual_seed(0)
    first = torch.randn(2, 16, 14)
    found = following(first, 99)
    assert found.shape == (2, 99, 16, 14)
    assert abs(found.mean().item()) < 0.02
    assert found.std().item() == pytest.approx(1.0, abs=0.02)
    assert torch.equal(following(first[1:], 99)[0], found[1])
    correlation = torch.corrcoef(torch.stack([found[0].flatten(), found[1].flatten()]))[0, 1]
    assert abs(correlation.item()) < 0.05


def test_separate_encoders_see_one_camera_each_and_shared_ones_all() -> None:
    batch = batch_of()
    for separate in (True, False):
        model = make(separate_encoders=separate)
        assert len(model.rgb_encoders) == (2 if separate else 1)
        base = model._condition(batch["images"], batch["states"], None)
        changed = batch["images"].clone()
        changed[:, 3:] += 1.0
        other = model._condition(changed, batch["states"], None)
        assert torch.equal(base[:, :21], other[:, :21])  # states and the first camera
        assert not torch.allclose(base[:, 21:], other[:, 21:])


def test_every_parameter_is_trained_and_units_are_disjoint() -> None:
    model = make(separate_encoders=True)
    model(**batch_of())["loss"].backward()
    assert [name for name, p in model.named_parameters() if p.grad is None] == []
    seen = [id(p) for unit in model.fsdp_units() for p in unit.parameters()]
    assert len(seen) == len(set(seen))


def test_crops_are_drawn_in_training_and_the_middle_else() -> None:
    images = torch.arange(7 * 9, dtype=torch.float32).reshape(1, 1, 7, 9).expand(3, 1, 7, 9)
    places = torch.tensor([[0.0, 0.0], [0.999, 0.999], [0.5, 0.5]])
    found = cropped(images, (4, 6), places)
    assert found.shape == (3, 1, 4, 6)
    assert found[:, 0, 0, 0].tolist() == [0.0, 3 * 9 + 3.0, 2 * 9 + 2.0]
    assert torch.equal(found[1, 0], images[0, 0, 3:, 3:])
    assert torch.equal(cropped(images, (4, 6), None)[0, 0], images[0, 0, 2:6, 2:8])
    model, batch = make(crop_shape=(64, 56)), batch_of()
    still = model(**batch)["loss"]
    drawn = model(**batch, crops=torch.zeros(4, 2))["loss"]
    assert not torch.equal(drawn, still)
    model.eval()
    assert torch.equal(model(**batch, crops=torch.zeros(4, 2))["loss"], still)
    with pytest.raises(ConfigError, match=r"images of 72 x 64 pixels are smaller than crop_sha"):
        make(crop_shape=(64, 65))(**batch)


def test_keypoints_find_a_peak() -> None:
    module = Keypoints(1, 1)
    torch.nn.init.constant_(module.nets.weight, 50.0)
    torch.nn.init.zeros_(module.nets.bias)
    image = torch.zeros(1, 1, 5, 9)
    image[0, 0, 1, 6] = 1.0
    torch.testing.assert_close(module(image)[0], torch.tensor([0.5, -0.5]), atol=1e-4, rtol=0)
    assert position_grid(1, 3).tolist() == [[-1.0, -1.0], [0.0, -1.0], [1.0, -1.0]]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"horizon": 10}, r"horizon 10 is not a multiple of 4"),
        ({"down_dims": (12, 24), "horizon": 8}, r"down_dims \(12, 24\) must be multiples of n_gr"),
        ({"noise_scheduler_type": "Euler"}, "noise_scheduler_type 'Euler' is not one of DDPM, DD"),
        ({"beta_schedule": "cosine"}, "beta_schedule 'cosine' is not one of linear"),
        ({"prediction_type": "v"}, "prediction_type 'v' is not one of epsilon, sample"),
        ({"n_obs_steps": 0}, "n_obs_steps 0 is not between 1 and horizon 8"),
        ({"n_obs_steps": 9}, "n_obs_steps 9 is not between 1 and horizon 8"),
        ({"num_inference_steps": 21}, "num_inference_steps 21 is not between 1 and num_train_time"),
    ],
)
def test_settings_that_do_not_work(settings: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make(**settings)


def test_batches_that_do_not_fit() -> None:
    model, batch = make(), batch_of()
    with pytest.raises(
        ConfigError, match=r"actions are \(7, 3\), .* the model's chunk is \(8, 3\)"
    ):
        model(**{**batch, "actions": batch["actions"][:, :7]})
    with pytest.raises(ConfigError, match=r"num_cameras is 2, .* 3 image channels \(1 cameras\)"):
        model(**{**batch, "images": batch["images"][:, :3]})
    with pytest.raises(ConfigError, match=r"n_obs_steps is 2, states are \(4, 5\)"):
        make(n_obs_steps=2)(**batch)


def test_what_a_sample_is_trained_with_follows_from_the_generator() -> None:
    draw = SampleDiffusionNoise(num_train_timesteps=20, repeats=3)
    sample = {"actions": np.zeros((8, 3), np.float32)}
    first, same = (draw(sample, np.random.default_rng(1)) for _ in range(2))
    assert first["noise"].shape == (3, 8, 3)
    assert first["timesteps"].shape == (3,)
    assert first["timesteps"].dtype == np.int64
    assert first["crops"].shape == (2,)
    assert all(np.array_equal(first[key], same[key]) for key in ("noise", "timesteps", "crops"))
    many = SampleDiffusionNoise(20, 4000)(sample, np.random.default_rng(2))["timesteps"]
    assert set(many.tolist()) == set(range(20))
    with pytest.raises(ConfigError, match="must be at least 1"):
        SampleDiffusionNoise(0)


def test_a_schedule_begins_with_little_noise_and_ends_with_nearly_nothing_else() -> None:
    shares = DiffusionSchedule().shares()
    assert shares[0] > 0.999
    assert shares[-1] < 1e-3
    assert (shares.diff() < 0).all()


def test_in_mixed_precision() -> None:
    model, batch = make(), batch_of()
    expected = model(**batch)["loss"].item()
    with torch.autocast("cpu", torch.bfloat16):
        loss = model(**batch)["loss"]
    loss.backward()
    assert loss.item() == pytest.approx(expected, rel=0.05)
    assert all(p.grad.dtype == torch.float32 for p in model.parameters())
