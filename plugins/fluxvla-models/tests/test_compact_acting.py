"""Acting fast: the same numbers however it is executed, and steps that could be captured."""

from __future__ import annotations

import torch
from fluxvla_models.compact_vla import CompactVLA

from fluxvla_core.testing import ExecutionConformance

from .test_compact_vla import SMALL, make_batch


class TestCompactVLA(ExecutionConformance):
    def model(self):
        torch.manual_seed(0)
        return CompactVLA(**SMALL, state_dim=3).eval()

    def batches(self):
        batch = make_batch()
        asked = ("images", "lang_tokens", "lang_masks", "states")
        given = {**{key: batch[key] for key in asked}, "noise": batch["noise"][:, 0]}
        return [{key: value[row : row + 1] for key, value in given.items()} for row in range(2)]
