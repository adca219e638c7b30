"""Guided inpainting for flow matching: a chunk that agrees with the rest of the one before it.

Black, Galliker and Levine 2025 (arXiv 2506.07339, equations 2 to 4), after Pokle et al. 2023
(pseudoinverse guidance, PiGDM): with ``A1`` the estimate of the clean chunk at time ``t``, ``Y``
the old chunk and ``W`` how much each of its actions counts, the velocity gets besides

    min(beta, (1 - t) / (t r^2)) * (Y - A1)^T diag(W) dA1/dA,    r^2 = (1 - t)^2 / (t^2 + (1 - t)^2)

``(1 - t) / (t r^2)`` is ``(t^2 + (1 - t)^2) / (t (1 - t))``: beyond all bounds at both ends and 2
in the middle, which is why the paper clips it (``beta`` = 5 there).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Guide:
    """Constraints that a chunk has to agree with.

    Args:
        actions: ``(B, T, D)`` normalised: the old chunk at the new one's times.
        weights: ``(B, T)`` in 0..1: ``W``.
        frozen: ``(B,)`` int64: so many rows at the beginning are executed by the time that the
            chunk arrives, and become the old chunk's exactly.
        most: ``(B,)`` beta.
    """

    actions: Tensor
    weights: Tensor
    frozen: Tensor
    most: Tensor

    @classmethod
    def of(
        cls,
        prev_actions: Tensor | None,
        prefix_weights: Tensor | None,
        prefix_len: Tensor | None,
        max_guidance_weight: Tensor | None,
        width: int | None = None,
    ) -> Guide | None:
        """The guide that a model's ``predict_action`` is given; None if there is no chunk to go on
        from.

        Args:
            width: so many dimensions of ``prev_actions`` count, all by default: a loss that leaves
                padding out says nothing of it.
        """
        if prev_actions is None:
            return None
        assert prefix_weights is not None
        assert prefix_len is not None
        assert max_guidance_weight is not None
        return cls(prev_actions[..., :width], prefix_weights, prefix_len, max_guidance_weight)

    def pull(
        self, estimate: Callable[[Tensor], Tensor], x: Tensor, time: float
    ) -> tuple[Tensor, Tensor]:
        """The estimate at ``x`` ``(B, T, D)``, and what the velocity gets besides."""
        with torch.enable_grad():
            leaf = x.detach().requires_grad_()
            found = estimate(leaf)
            error = ((self.actions - found) * self.weights[..., None]).detach()
            (gradient,) = torch.autograd.grad(found, leaf, error.to(found.dtype))
        bound = (time**2 + (1 - time) ** 2) / (time * (1 - time)) if time > 0 else float("inf")
        return found.detach(), self.most.clamp(max=bound)[:, None, None] * gradient

    def freeze(self, x: Tensor) -> Tensor:
        """``x`` with the frozen rows replaced."""
        index = torch.arange(x.shape[1], device=x.device)
        return torch.where(index[None, :, None] < self.frozen[:, None, None], self.actions, x)
