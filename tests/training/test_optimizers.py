"""Optimizers by name, from the core and from whoever registers one."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch

from fluxvla_core import OPTIMIZERS
from fluxvla_core.build import RunContext, build_runner_from_cfg
from fluxvla_core.checkpoints.checkpoint import folders, latest
from fluxvla_core.errors import CheckpointError, ConfigError, LoadFailed, PluginError
from fluxvla_core.testing.training import (
    TinyDataset,
    checkpoint_differences,
    tiny_config,
    unflushed,
)


@pytest.fixture(autouse=True)
def _fast():
    with unflushed():
        yield


def run(work_dir, resume=None, **settings):
    table = {"type": "OneProcessRunner", "max_steps": 6, "max_keep_ckpts": 0, **settings}
    config = tiny_config(table)
    context = RunContext(config=config, section="runner", work_dir=Path(work_dir), resume=resume)
    runner = build_runner_from_cfg(config["runner"], context)
    runner.run_setup(37)
    runner.run(TinyDataset())
    return runner


def test_adamw_takes_its_settings_and_leaves_vectors_undecayed(tmp_path):
    settings = {"type": "AdamW", "betas": [0.8, 0.95], "eps": 1e-6}
    optimizer = run(tmp_path, optimizer=settings, weight_decay=0.2).optimizer
    assert type(optimizer) is torch.optim.AdamW
    assert [g["weight_decay"] for g in optimizer.param_groups] == [0.2, 0.0]
    assert {g["betas"] for g in optimizer.param_groups} == {(0.8, 0.95)}
    assert {g["eps"] for g in optimizer.param_groups} == {1e-6}
    assert all(g["fused"] for g in optimizer.param_groups)


def test_foreach_is_the_same_to_rounding(tmp_path):
    a = run(tmp_path / "fused").model.state_dict()
    runner = run(tmp_path / "foreach", optimizer={"type": "AdamW", "fused": False})
    assert all(g["foreach"] and not g["fused"] for g in runner.optimizer.param_groups)
    b = runner.model.state_dict()
    assert all(torch.allclose(a[name], b[name], atol=1e-6) for name in a)


def test_sgd_goes_on_bit_for_bit(tmp_path):
    settings = {"optimizer": {"type": "SGD", "momentum": 0.5}, "save_iter_interval": 3}
    run(tmp_path / "whole", **settings)
    run(tmp_path / "cut", max_steps=3, **settings)
    run(tmp_path / "cut", "auto", **settings)
    ends = [folders(tmp_path / d)[-1] for d in ("whole", "cut")]
    assert checkpoint_differences(*ends) == []
    assert any(n.endswith("momentum_buffer") for n in latest(tmp_path / "cut").tensors(
        "optimizer.safetensors"))  # fmt: skip


def test_another_optimizers_state_is_refused(tmp_path):
    run(tmp_path, max_steps=2)
    with pytest.raises(CheckpointError, match=r"\(AdamW, groups of .* is not this run's \(SGD"):
        run(tmp_path, "auto", optimizer={"type": "SGD"})


@pytest.fixture
def registered():
    class Signed:
        """A third party's: steps by the sign of the gradient, with a state of its own."""

        def __init__(self, scale=1.0):
            self.scale = scale

        def build(self, groups, learning_rate):
            scale = self.scale

            class SignedSGD(torch.optim.Optimizer):
                def __init__(self):
                    super().__init__(groups, {"lr": learning_rate})

                def step(self, closure=None):
                    for group in self.param_groups:
                        for p in group["params"]:
                            if p.grad is not None:
                                state = self.state[p]
                                state["seen"] = state.get("seen", 0) + 1
                                with torch.no_grad():
                                    p -= group["lr"] * scale * p.grad.sign()

            return SignedSGD()

    OPTIMIZERS.register_module()(Signed)
    yield
    OPTIMIZERS.unregister("Signed")


def test_a_registered_one_trains_is_saved_and_goes_on(tmp_path, registered):
    settings = {"optimizer": {"type": "Signed", "scale": 0.5}, "save_iter_interval": 3}
    run(tmp_path / "whole", **settings)
    run(tmp_path / "cut", max_steps=3, **settings)
    run(tmp_path / "cut", "auto", **settings)
    ends = [folders(tmp_path / d)[-1] for d in ("whole", "cut")]
    assert checkpoint_differences(*ends) == []
    seen = latest(tmp_path / "cut").json("optimizer.json")["scalars"]
    assert set(seen.values()) == {6}


@pytest.fixture
def two_rates():
    class TwoRates:
        """Matrices learn at the run's rate, vectors at a tenth of it."""

        def build(self, groups, learning_rate):
            matrices, vectors = groups
            return torch.optim.AdamW(
                [matrices, {**vectors, "lr": learning_rate / 10}], lr=learning_rate
            )

    OPTIMIZERS.register_module()(TwoRates)
    yield
    OPTIMIZERS.unregister("TwoRates")


def test_groups_with_rates_of_their_own_keep_them_and_go_on_bit_for_bit(tmp_path, two_rates):
    settings = {
        "optimizer": {"type": "TwoRates"},
        "lr_scheduler_type": "step-based",
        "lr_schedule": {0: 0.01, 0.5: 0.001},
        "save_iter_interval": 2,
    }
    whole = run(tmp_path / "whole", **settings)
    shutil.copytree(tmp_path / "whole", tmp_path / "cut")
    for later in folders(tmp_path / "cut")[1:]:
        shutil.rmtree(later)
    cut = run(tmp_path / "cut", "auto", **settings)
    for runner in (whole, cut):
        rates = [group["lr"] for group in runner.optimizer.param_groups]
        assert rates == [0.001, pytest.approx(0.0001)]
    ends = [folders(tmp_path / d)[-1] for d in ("whole", "cut")]
    assert checkpoint_differences(*ends) == []


def test_a_class_without_build_is_no_optimizer():
    class Lacking:
        pass

    with pytest.raises(LoadFailed, match=r"does not fulfil the contract of fluxvla\.optimizers"):
        OPTIMIZERS.register_module()(Lacking)


def test_names_and_settings_that_are_not_there(tmp_path):
    with pytest.raises(PluginError, match=r"no fluxvla\.optimizers plugin named 'AdamWW'"):
        run(tmp_path, optimizer={"type": "AdamWW"})
    with pytest.raises(ConfigError, match="AdamW: got an unexpected keyword argument 'beta'"):
        run(tmp_path, optimizer={"type": "AdamW", "beta": 1})
