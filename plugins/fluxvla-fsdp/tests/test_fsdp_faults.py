"""Every file operation of a save by several processes fails once; nothing earlier is lost."""

from __future__ import annotations

import errno
import os

import pytest
import torch

from fluxvla_core import build_runner_from_cfg
from fluxvla_core.checkpoints.checkpoint import Checkpoint, latest
from fluxvla_core.checkpoints.writer import Disk
from fluxvla_core.errors import RunFailed
from fluxvla_core.operators import RunContext
from fluxvla_core.testing.training import TinyDataset, run_ranks, tiny_config
from fluxvla_core.training import distributed
from fluxvla_core.training.state import Progress
from fluxvla_core.training.stop import StopRequest
from fluxvla_core.training.trainer import Trainer


def two_ranks(work_dir):
    """Let every file operation of a save fail once, on one rank, and look at what is left."""
    torch.distributed.init_process_group("gloo")
    rank = torch.distributed.get_rank()
    for beside in (True, False):
        folder = work_dir / str(beside)
        table = {"type": "FSDPTrainRunner", "max_steps": 6, "async_save": beside, "ema_decay": 0.9}
        tree = tiny_config({**table, "max_keep_ckpts": 0})
        context = RunContext(config=tree, section="runner", work_dir=folder)
        runner = build_runner_from_cfg(tree["runner"], context)
        dataset = TinyDataset()
        runner.run_setup(len(dataset))
        runner.progress = Progress()
        Trainer(runner, dataset, StopRequest(runner.world)).close()
        operations = count_operations()
        train_a_step(runner)
        save(runner, folder, 1)
        totals = [int(t) for t in distributed.all_gather_text(runner.world, str(operations[0]))]
        assert totals[0] > 50
        assert totals[1] >= 8
        # All of the second rank's; of the first one's those that are of each kind.
        faults = [(1, n) for n in range(1, totals[1] + 1)]
        faults += [(0, n) for n in (1, 2, 5, 20, totals[0] - 3, totals[0] - 2, totals[0] - 1)]
        for broken, number in faults:
            operations[:] = [0, number if rank == broken else -1]
            with pytest.raises(RunFailed) as caught:
                save(runner, folder, 2)
            assert "the disk is full: the checkpoint of step 2" in str(caught.value)
            assert ("on rank 1" in str(caught.value)) == (broken == 1)
            distributed.all_reduce_max(runner.world, 0)
            Checkpoint.open(folder / "checkpoints/step-000000001").verify()
            assert [p.name for p in (folder / "checkpoints").iterdir()] == ["step-000000001"]
            distributed.all_reduce_max(runner.world, 0)
        operations[:] = [0, -1]
        save(runner, folder, 2)
        assert latest(folder).step == 2


def save(runner, folder, step):
    runner.save_checkpoint(folder, step, 0)
    runner.finish_pending_save()


def train_a_step(runner):
    """Gradients of zero are enough for an optimizer to have a state."""
    for parameter in runner.model.parameters():
        if parameter.requires_grad:
            parameter.grad = torch.zeros_like(parameter)
    runner.optimizer.step()


def count_operations():
    """``[done, the one that fails]`` of this process's file operations."""
    state = [0, -1]

    def counted(operation):
        def run(*args):
            state[0] += 1
            if state[0] == state[1]:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            return operation(*args)

        return run

    for name in [n for n in vars(Disk) if not n.startswith("_")]:
        setattr(Disk, name, counted(getattr(Disk, name)))
    return state


def test_an_error_of_any_rank_is_everybodys_and_keeps_the_checkpoint_before(tmp_path):
    assert run_ranks(2, two_ranks, tmp_path) == [0, 0]
