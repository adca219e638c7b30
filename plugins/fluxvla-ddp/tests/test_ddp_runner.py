"""DDPTrainRunner: what every train runner must do, and what is its own."""

from __future__ import annotations

import signal

from fluxvla_core.testing.train_runner import TrainRunnerConformance
from fluxvla_core.testing.training import differences, run_ranks, tiny_config, train, train_all


class TestDDPTrainRunner(TrainRunnerConformance):
    """T1 of the field notes: resuming never restored the weights."""

    entry_point = "DDPTrainRunner"


def test_three_ranks_go_on_bit_for_bit_too(tmp_path):
    """With more than two summands the order in which buckets are added up shows."""
    config = tiny_config(
        {"type": "DDPTrainRunner", "max_steps": 8, "save_iter_interval": 4, "max_keep_ckpts": 0},
        batch=2,
        width=64,
    )
    whole, cut = ({"config": config, "work_dir": str(tmp_path / name)} for name in "ab")
    assert run_ranks(3, train_all, whole, {**cut, "signal": (2, 6, signal.SIGKILL)})[2] == -9
    assert run_ranks(3, train, {**cut, "resume": "auto"}) == [0, 0, 0]
    assert differences(tmp_path / "a", tmp_path / "b") == []


def test_one_process_needs_no_group(tmp_path):
    config = tiny_config({"type": "DDPTrainRunner", "max_steps": 2})
    runner = train({"config": config, "work_dir": str(tmp_path)})
    assert type(runner.vla).__name__ == "TinyVLA"


def unused(work_dir, find):
    config = tiny_config(
        {"type": "DDPTrainRunner", "max_steps": 3, "find_unused_parameters": find}, spare=True
    )
    train({"config": config, "work_dir": str(work_dir)})


def test_parameters_that_a_step_leaves_out_need_to_be_looked_for(tmp_path):
    assert run_ranks(2, unused, tmp_path / "find", True) == [0, 0]
    assert run_ranks(2, unused, tmp_path / "not", False) == [1, 1]
