"""Acting fast: the same numbers however it is executed, and steps that could be captured."""

from __future__ import annotations

import pytest
import torch

from fluxvla_core.testing import ExecutionConformance

from .gr00t_sizes import tiny
from .test_gr00t_parity import batch, to_act


class TestN15(ExecutionConformance):
    version = "n1.5"

    def model(self):
        return tiny(self.version)

    def batches(self):
        inputs = to_act(batch(self.version, padded=True))
        # Transformers leaves out a mask that hides nothing, which is other code.
        inputs["lang_masks"][0, 0] = False
        return [{key: value[row : row + 1] for key, value in inputs.items()} for row in range(2)]


class TestN17(TestN15):
    version = "n1.7"


@pytest.mark.parametrize("attend_padding", [False, True])
@pytest.mark.parametrize("version", ["n1.5", "n1.7"])
def test_the_steps_with_tables_are_those_of_any_time(version, attend_padding):
    """Against the velocity that training has, at the times of the steps."""
    model = tiny(version, attend_padding=attend_padding)
    inputs, head = to_act(batch(version, padded=True)), model.vla_head
    with torch.no_grad():
        found = model.predict_action(**inputs)
        backbone_output = model.vlm_backbone(
            inputs["images"], inputs["lang_tokens"], inputs["lang_masks"], None
        )
        context, ids = head.encode_context(backbone_output), inputs["embodiment_ids"]
        state, x = head.encode_states(inputs["states"], ids), inputs["noise"]
        for step in range(4):
            x = x + head.velocity(x, torch.full((2,), 250 * step), context, state, ids) / 4
    assert (found - x).abs().max() < 1e-5 * x.abs().max()
