"""A run that is killed at any moment and resumed is the run that was not."""

from __future__ import annotations

import pytest

from fluxvla_core.testing.train_runner import TrainRunnerConformance
from fluxvla_core.testing.training import differences, run_ranks, tiny_config, train


class TestOneProcess(TrainRunnerConformance):
    entry_point = "OneProcessRunner"
    ranks = 1


@pytest.mark.parametrize("operation", [1, 9, 31, 47, 48, 49, 50, 51, 52, 95, 100])
def test_killed_at_file_operations_of_its_saves(tmp_path, operation):
    config = tiny_config(
        {"type": "OneProcessRunner", "max_steps": 6, "save_iter_interval": 2, "max_keep_ckpts": 2}
    )
    whole, cut = ({"config": config, "work_dir": str(tmp_path / name)} for name in "ab")
    train(whole)
    assert run_ranks(1, train, {**cut, "kill_write": operation}) == [-9]
    assert run_ranks(1, train, {**cut, "resume": "auto"}) == [0]
    assert differences(tmp_path / "a", tmp_path / "b") == []
