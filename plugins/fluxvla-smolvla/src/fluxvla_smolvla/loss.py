"""The loss of a batch whose samples may end before their chunk does."""

from __future__ import annotations

from torch import Tensor


def masked_mean(errors: Tensor, masks: Tensor, over: str) -> tuple[Tensor, Tensor]:
    """The loss of a batch, and that of each sample, ``(B,)``.

    Args:
        errors: ``(B, K, T, D)``.
        masks: ``(B, T)``, 0 beyond the end of an episode.
        over: ``valid``: the mean over steps inside episodes; ``all``: the others count as 0, so
            that the gradient does not depend on which samples share a batch.
    """
    kept = errors * masks[:, None, :, None]
    if over == "all":
        return kept.mean(), kept.flatten(1).mean(1)
    each = masks.sum(1).to(errors.dtype) * errors.shape[1] * errors.shape[3]
    return kept.sum() / each.sum().clamp_min(1), kept.flatten(1).sum(1) / each.clamp_min(1)
