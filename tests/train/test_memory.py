"""Memory that runs out: told with what to do about it, and no checkpoint is lost."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch

from fluxvla_core.build import RunContext, build_runner_from_cfg
from fluxvla_core.checkpoints.checkpoint import folders, latest
from fluxvla_core.errors import RunFailed
from fluxvla_core.testing.training import TinyDataset, TinyVLA, tiny_config, unflushed
from fluxvla_core.train.memory import explain, peak_bytes

CUDA = (
    "CUDA out of memory. Tried to allocate 2.00 GiB. GPU 0 has a total capacity of 79.15 GiB of "
    "which 1.31 GiB is free.\nSee documentation for Memory Management"
)


class OutOfMemoryError(RuntimeError):
    """Has the name of torch's."""


def make(work_dir, resume=None):
    config = tiny_config({"type": "OneProcessRunner", "max_steps": 6, "save_iter_interval": 2})
    context = RunContext(config=config, section="runner", work_dir=Path(work_dir), resume=resume)
    return build_runner_from_cfg(config["runner"], context)


@pytest.mark.parametrize(
    "error",
    [
        OutOfMemoryError(CUDA),
        torch.OutOfMemoryError(CUDA),
        RuntimeError("CUDA error: out of memory\nCUDA kernel errors might be …"),
        RuntimeError("CUDA error: CUBLAS_STATUS_ALLOC_FAILED when calling `cublasCreate`"),
    ],
)
def test_a_gpu(error):
    told = explain(error, 7)
    assert told.what == "the GPU ran out of memory at step 7"
    assert told.cause == str(error).splitlines()[0]
    assert "lower train_dataloader.per_device_batch_size and raise runner.grad_acc" in told.next
    assert "--resume auto" in told.next
    assert told.exit_code == 1


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        RuntimeError("[enforce fail at alloc_cpu.cpp:125] DefaultCPUAllocator: can't allocate mem"
                     "ory: you tried to allocate 4 bytes."),
    ],
)  # fmt: skip
def test_the_machine(error):
    told = explain(error)
    assert told.what == "this machine ran out of memory"
    assert "lower train_dataloader.per_device_num_workers" in told.next


def test_torch_itself_runs_out_of_memory():
    with pytest.raises(RuntimeError) as caught:
        torch.empty(1 << 60, dtype=torch.uint8)
    assert explain(caught.value).what == "this machine ran out of memory"


def test_other_errors_are_left_alone():
    assert explain(RuntimeError("shape mismatch")) is None


def test_a_run_keeps_what_it_saved_and_goes_on(tmp_path, monkeypatch):
    forward = TinyVLA.forward

    def growing(self, **batch):
        if self.batches == 4:
            raise OutOfMemoryError(CUDA)
        return forward(self, **batch)

    runner = make(tmp_path)
    runner._arguments = None
    with unflushed():
        runner.run_setup(37)
        monkeypatch.setattr(runner, "_training_step", lambda batch: growing(runner.vla, **batch)
                            ["loss"])  # fmt: skip
        with pytest.raises(RunFailed, match="the GPU ran out of memory at step 5"):
            runner.run(TinyDataset())
        assert [p.name for p in folders(tmp_path)] == ["step-000000002", "step-000000004"]
        latest(tmp_path).verify()
        again = make(tmp_path, "auto")
        again.run_setup(37)
        again.run(TinyDataset())
    assert latest(tmp_path).step == 6


def test_the_peak_is_of_this_process():
    found = peak_bytes(cuda=False)
    assert 1e7 < found < 1e12
    assert sys.platform != "linux" or found % 1024 == 0
