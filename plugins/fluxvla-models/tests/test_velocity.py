"""Sampling by a velocity from noise at t = 1, guided and not."""

from __future__ import annotations

import math

import numpy as np
import torch
from fluxvla_models.guidance import Guide
from fluxvla_models.velocity import sample, sinusoids


def test_a_velocity_that_leads_straight_to_the_actions_arrives():
    actions = torch.randn(2, 3, 4, generator=torch.Generator().manual_seed(0))
    noise = torch.randn(2, 3, 4, generator=torch.Generator().manual_seed(1))
    times = []

    def velocity(x, t):
        times.append(t.tolist())
        return noise - actions

    torch.testing.assert_close(sample(velocity, noise, 10), actions)
    np.testing.assert_allclose(times, [[1 - n / 10] * 2 for n in range(10)], rtol=1e-6)


def test_guided_sampling_is_the_papers_algorithm():
    """Against Black, Galliker and Levine 2025 (arXiv 2506.07339), with a Jacobian of its own."""
    rows, width, steps, beta = 3, 2, 4, 5.0
    rng = np.random.default_rng(0)
    mix = torch.tensor(rng.normal(size=(rows * width, rows * width)) / 3)
    noise, old = (torch.tensor(rng.normal(size=(1, rows, width))) for _ in range(2))
    weights = torch.tensor([[1.0, 0.6, 0.0]], dtype=torch.float64)

    def velocity(x, t):
        return (torch.tanh(x.flatten(1) @ mix) * (1 + t.double()[:, None])).view_as(x)

    guide = Guide(old, weights, torch.tensor([1]), torch.tensor([beta], dtype=torch.float64))
    found = sample(velocity, noise, steps, guide)

    a = noise
    for step in range(steps):
        tau = step / steps
        t = torch.tensor([1 - tau])

        def clean(x, t=t):
            return x - t.double() * velocity(x, t)

        jacobian = torch.autograd.functional.jacobian(clean, a).reshape(rows * width, -1)
        error = ((old - clean(a)) * weights[..., None]).flatten()
        r2 = (1 - tau) ** 2 / (tau**2 + (1 - tau) ** 2)
        weight = beta if tau == 0 else min(beta, (1 - tau) / (tau * r2))
        a = a + (-velocity(a, t) + weight * (error @ jacobian).view_as(a)) / steps
    a[:, :1] = old[:, :1]
    torch.testing.assert_close(found, a, rtol=1e-6, atol=1e-6)
    plain = sample(velocity, noise, steps)
    nothing = Guide(old, torch.zeros_like(weights), torch.tensor([0]), guide.most)
    torch.testing.assert_close(sample(velocity, noise, steps, nothing), plain, rtol=1e-9, atol=1e-9)
    assert (found - plain).abs().max() > 0.05


def test_dimensions_that_the_old_chunk_does_not_have_are_not_pulled():
    generator = torch.Generator().manual_seed(0)
    noise, old = torch.randn(1, 4, 3, generator=generator), torch.ones(1, 4, 2)

    def velocity(x, t):  # each dimension by itself
        return x * (1 + t[:, None, None])

    guide = Guide(old, torch.ones(1, 4), torch.tensor([1]), torch.tensor([5.0]))
    guided, plain = sample(velocity, noise, 4, guide), sample(velocity, noise, 4)
    assert torch.equal(guided[..., 2], plain[..., 2])
    assert torch.equal(guided[:, :1, :2], old[:, :1])
    assert (guided[..., :2] - old).abs().max() < (plain[..., :2] - old).abs().max()


def test_sinusoids_have_the_periods_that_they_are_given():
    found = sinusoids(torch.tensor([0.25, 1.0]), 6, 0.5, 2.0)
    assert found.shape == (2, 6)
    for row, t in zip(found, (0.25, 1.0), strict=True):
        angles = [2 * math.pi * t / period for period in (0.5, 1.0, 2.0)]
        expected = [*map(math.sin, angles), *map(math.cos, angles)]
        np.testing.assert_allclose(row.numpy(), expected, atol=1e-12)
