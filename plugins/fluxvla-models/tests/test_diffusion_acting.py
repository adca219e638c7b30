"""Acting fast: Diffusion Policy's steps, with noise on the way (DDPM) and without (DDIM)."""

from __future__ import annotations

from fluxvla_core.testing import ExecutionConformance

from .test_diffusion_policy import batch_of, make


class TestDDIM(ExecutionConformance):
    kinds = 10
    """Four stages of the network that sees, six kinds of blocks of the network over time."""

    kind = "DDIM"

    def model(self):
        return make(noise_scheduler_type=self.kind, num_inference_steps=3).eval()

    def batches(self):
        batch = batch_of()
        given = {"states": batch["states"], "noise": batch["noise"][:, 0]}
        given["images"] = batch["images"][..., :32, :32]
        return [{key: value[row : row + 1] for key, value in given.items()} for row in range(2)]

    def test_what_precedes_the_steps_may_be_captured_unless_noise_is_drawn(self):
        assert self.model().observe_is_capturable == (self.kind == "DDIM")


class TestDDPM(TestDDIM):
    kind = "DDPM"
