"""Guided inpainting against the paper's formulas written out in numpy, Jacobian and all."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from fluxvla_models.flow_matching_head import FlowMatchingHead
from fluxvla_models.guidance import Guide

from fluxvla_core.control.joiners import soft_mask

T, D, STEPS = 5, 2, 4


@pytest.fixture
def head() -> FlowMatchingHead:
    torch.manual_seed(0)
    made = FlowMatchingHead(
        horizon=T, action_dim=D, context_dim=8, width=16, blocks=2, num_steps=STEPS
    )
    return made.double().eval()


@pytest.fixture
def inputs():
    rng = np.random.default_rng(1)
    return rng.normal(size=8), rng.normal(size=(T, D)), rng.normal(size=(T, D))


def by_the_paper(estimate, noise, old, weights, frozen, beta):
    """Algorithm 1's GuidedInference, for one chunk, with the Jacobian by central differences.

    ``v`` is the velocity field; the paper's equation 2 adds its term to it, and equation 3's
    estimate of the clean chunk is ``A + (1 - t) v``.
    """
    a, n = noise.flatten(), STEPS
    for step in range(n):
        t = step / n

        def velocity(x, t=t):
            return (estimate(x.reshape(T, D), t).flatten() - x) / (1 - t)

        def clean(x, t=t, velocity=velocity):
            return x + (1 - t) * velocity(x)

        jacobian = np.empty((T * D, T * D))
        for column in range(T * D):
            h = np.zeros(T * D)
            h[column] = 1e-6
            jacobian[:, column] = (clean(a + h) - clean(a - h)) / 2e-6
        r2 = (1 - t) ** 2 / (t**2 + (1 - t) ** 2)
        weight = beta if t == 0 else min(beta, (1 - t) / (t * r2))
        error = (old.flatten() - clean(a)) @ np.diag(np.repeat(weights, D))
        a = a + (velocity(a) + weight * (error @ jacobian)) / n
    chunk = a.reshape(T, D)
    chunk[:frozen] = old[:frozen]
    return chunk


def guided(head, context, noise, old, weights, frozen, beta):
    guide = Guide(
        torch.tensor(old)[None],
        torch.tensor(weights)[None],
        torch.tensor([frozen]),
        torch.tensor([beta], dtype=torch.float64),
    )
    with torch.no_grad():
        return head.sample(torch.tensor(context)[None], torch.tensor(noise)[None], guide)[0]


@pytest.mark.parametrize(("frozen", "known", "beta"), [(2, 4, 5.0), (0, 5, 5.0), (1, 3, 1.5)])
def test_it_is_the_papers_algorithm(head, inputs, frozen, known, beta):
    context, noise, old = inputs
    weights = soft_mask(T, frozen, known)

    def estimate(x, t):
        with torch.no_grad():
            found = head.estimate(
                torch.tensor(x)[None],
                torch.tensor([t], dtype=torch.float64),
                torch.tensor(context)[None],
            )
        return found[0].numpy()

    expected = by_the_paper(estimate, noise, old, weights, frozen, beta)
    found = guided(head, context, noise, old, weights, frozen, beta)

    np.testing.assert_allclose(found.numpy(), expected, atol=1e-6)
    assert np.abs(found.numpy() - plain(head, context, noise)).max() > 0.05


def plain(head, context, noise):
    with torch.no_grad():
        return head.sample(torch.tensor(context)[None], torch.tensor(noise)[None])[0].numpy()


def test_without_weights_it_is_the_plain_sampler(head, inputs):
    context, noise, old = inputs

    found = guided(head, context, noise, old, np.zeros(T), 0, 5.0)

    np.testing.assert_allclose(found.numpy(), plain(head, context, noise), atol=1e-12)


def test_frozen_rows_are_the_old_chunks_exactly(head, inputs):
    context, noise, old = inputs

    found = guided(head, context, noise, old, soft_mask(T, 3, 5), 3, 5.0).numpy()

    np.testing.assert_array_equal(found[:3], old[:3])
    assert not np.allclose(found[3:], old[3:])


def test_rows_of_a_batch_are_guided_each_by_its_own(head, inputs):
    context, noise, old = inputs
    other = old[::-1].copy()
    guide = Guide(
        torch.tensor(np.stack([old, other])),
        torch.tensor(np.stack([soft_mask(T, 2, 4), soft_mask(T, 1, 5)])),
        torch.tensor([2, 1]),
        torch.tensor([5.0, 1.5], dtype=torch.float64),
    )
    both = [torch.tensor(np.stack([value, value])) for value in (context, noise)]

    with torch.no_grad():
        found = head.sample(*both, guide)

    first = guided(head, context, noise, old, soft_mask(T, 2, 4), 2, 5.0)
    second = guided(head, context, noise, other, soft_mask(T, 1, 5), 1, 1.5)
    torch.testing.assert_close(found, torch.stack([first, second]))


def test_nothing_is_left_behind_in_the_parameters(head, inputs):
    context, noise, old = inputs

    found = guided(head, context, noise, old, soft_mask(T, 2, 4), 2, 5.0)

    assert not found.requires_grad
    assert all(parameter.grad is None for parameter in head.parameters())


def test_a_learned_chunk_is_drawn_to_the_old_one():
    """A head that learned two motions goes on with the one that is under way.

    Which of the two it would have chosen by itself is up to the noise.
    """
    torch.manual_seed(0)
    head = FlowMatchingHead(horizon=8, action_dim=1, context_dim=4, width=32, blocks=2)
    motions = torch.stack([torch.linspace(0.6, 1, 8), torch.linspace(-0.6, -1, 8)])[..., None]
    optimizer = torch.optim.Adam(head.parameters(), lr=3e-3)
    generator = torch.Generator().manual_seed(0)
    for _ in range(300):
        actions = motions[torch.randint(2, (64,), generator=generator)]
        noise = torch.randn(64, 1, 8, 1, generator=generator)
        time = torch.rand(64, 1, generator=generator)
        loss = head.loss(torch.zeros(64, 4), actions, torch.ones(64, 8), noise, time)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    noise = torch.randn(40, 8, 1, generator=generator)
    old = motions[:1].expand(40, -1, -1)
    weights = torch.tensor(soft_mask(8, 2, 6), dtype=torch.float32).expand(40, -1)
    guide = Guide(old, weights, torch.full((40,), 2), torch.full((40,), 5.0))
    with torch.no_grad():
        free = head.sample(torch.zeros(40, 4), noise)[:, -1, 0]
        kept = head.sample(torch.zeros(40, 4), noise, guide)[:, -1, 0]

    assert 8 <= int((free > 0.5).sum()) <= 32, "both motions were learned"
    assert int((kept > 0.5).sum()) >= 38
