"""Acting fast: OpenVLA-OFT's pass of the language model, or passes, apart from what they see."""

from __future__ import annotations

from typing import ClassVar

import torch
from fluxvla_openvla.openvla_oft import OpenVLAOFT

from fluxvla_core.testing import ExecutionConformance

from .test_models import make, oft_batch


class TestDiffusion(ExecutionConformance):
    settings: ClassVar = {"head": "diffusion", "num_inference_steps": 3}

    def model(self):
        return make(OpenVLAOFT, **self.settings)

    def batches(self):
        batch = oft_batch(make(OpenVLAOFT, head="diffusion"))
        asked = ("images", "lang_tokens", "lang_masks", "states")
        given = {**{key: batch[key] for key in asked}, "noise": batch["noise"][:, 0]}
        return [{key: value[row : row + 1] for key, value in given.items()} for row in range(2)]


class TestL1(TestDiffusion):
    """One pass, which the noise that every policy is given does not change."""

    settings: ClassVar = {"use_film": True}

    def test_noise_changes_nothing(self):
        model, batch = self.model(), self.batches()[0]
        with torch.inference_mode():
            found = model.predict_action(**batch)
            assert torch.equal(found, model.predict_action(**{**batch, "noise": None}))
