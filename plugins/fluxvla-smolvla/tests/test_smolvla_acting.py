"""Acting fast: the same numbers however it is executed, and steps that could be captured."""

from __future__ import annotations

from fluxvla_core.testing import ExecutionConformance

from .tiny import model_batch, tiny_model


class TestSmolVLA(ExecutionConformance):
    def model(self):
        return tiny_model()

    def batches(self):
        batch = model_batch()
        asked = ("images", "img_masks", "lang_tokens", "lang_masks", "states")
        given = {**{key: batch[key] for key in asked}, "noise": batch["noise"][:, 0]}
        return [{key: value[row : row + 1] for key, value in given.items()} for row in range(3)]


class TestSparse(TestSmolVLA):
    """An expert of half the layers, none of which crosses."""

    def model(self):
        return tiny_model(self_attn_every_n_layers=1, num_expert_layers=2)
