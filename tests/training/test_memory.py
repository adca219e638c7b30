"""Memory that runs out: told with what to do about it, and no checkpoint is lost."""

from __future__ import annotations

import errno
import os
import re
import signal
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from fluxvla_core import build
from fluxvla_core.build import RunContext, build_runner_from_cfg
from fluxvla_core.checkpoints.checkpoint import folders, latest
from fluxvla_core.cli.execute import _run_section
from fluxvla_core.errors import RunFailed
from fluxvla_core.testing.training import (
    TinyDataset,
    TinyVLA,
    run_ranks,
    tiny_config,
    unflushed,
)
from fluxvla_core.training.cost import peak_bytes
from fluxvla_core.training.failures import explain

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
        RuntimeError("cuDNN error: CUDNN_STATUS_ALLOC_FAILED"),
        RuntimeError("cuDNN error: CUDNN_STATUS_INTERNAL_ERROR_DEVICE_ALLOCATION_FAILED"),
    ],
)
def test_a_gpu(error):
    told = explain(error, 7)
    assert told.what == "the GPU ran out of memory at step 7"
    assert told.cause == str(error).splitlines()[0]
    assert "lower --set train_dataloader.per_device_batch_size=… and raise --set" in told.next
    assert "--resume auto" in told.next
    assert told.exit_code == 1


@pytest.mark.parametrize("failure", ["Cuda failure 2 'out of memory'",
                                     "Cuda failure 'out of memory'"])  # fmt: skip
def test_nccl_on_a_gpu(failure):
    error = RuntimeError(
        "NCCL error in: /pytorch/torch/csrc/distributed/c10d/ProcessGroupNCCL.cpp:3356, unhandled "
        "cuda error (run with NCCL_DEBUG=INFO for details), NCCL version 2.27.3\n"
        f"ncclUnhandledCudaError: Call to CUDA function failed.\nLast error:\n{failure}"
    )
    told = explain(error, 7)
    assert told.what == "the GPU ran out of memory at step 7"
    assert told.cause == failure


@pytest.mark.parametrize(
    ("error", "cause"),
    [
        (
            RuntimeError(
                "Caught _ArrayMemoryError in DataLoader worker process 0.\nOriginal Traceback …\n"
                "numpy._core._exceptions._ArrayMemoryError: Unable to "
                "allocate 1.00 TiB for an array with shape (1,) and data type uint8"
            ),
            "numpy._core._exceptions._ArrayMemoryError: Unable to allocate 1.00 TiB for an array "
            "with shape (1,) and data type uint8",
        ),
        (
            RuntimeError("Caught MemoryError in pin memory thread for device 0.\n  …\nMemoryError"),
            "Caught MemoryError in pin memory thread for device 0.",
        ),
        (
            RuntimeError("unable to mmap 9 bytes from file </t_1>: Cannot allocate memory (12)"),
            "unable to mmap 9 bytes from file </t_1>: Cannot allocate memory (12)",
        ),
        (OSError(errno.ENOMEM, "no room"), "[Errno 12] no room"),
        (
            OSError("Caught OSError in DataLoader worker process 0.\nOSError: [Errno 12] Cannot "
                    "allocate memory"),
            "OSError: [Errno 12] Cannot allocate memory",
        ),
    ],
)  # fmt: skip
def test_the_machine_as_a_worker_or_the_system_says_it(error, cause):
    told = explain(error, 7)
    assert told.what == "this machine ran out of memory at step 7"
    assert told.cause == cause


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
    assert "lower --set train_dataloader.per_device_num_workers=…" in told.next


GONE = "DataLoader worker (pid {}) is killed by signal: {}. "
SHM = (
    GONE.format(7, "Bus error")
    + "It is possible that dataloader's workers are out of shared memory. Please try to raise your "
    "shared memory limit."
)


@pytest.mark.parametrize(
    ("text", "what", "cause", "advice"),
    [
        (
            GONE.format(123, "Killed"),
            "a data worker (pid 123) was killed at step 7",
            "ran out of memory (see dmesg)",
            "lower --set train_dataloader.per_device_num_workers=… or",
        ),
        (
            SHM,
            "a data worker (pid 7) ran out of shared memory at step 7",
            "/dev/shm is full, through which workers pass batches",
            "docker run --shm-size=8g",
        ),
        (
            "unable to write to file </torch_1_2_3>: No space left on device (28)",
            "a data worker ran out of shared memory at step 7",
            "/dev/shm is full",
            "per_device_num_workers=0",
        ),
        (
            "unable to allocate shared memory(shm) for file </torch_1_2_3>: No space left on "
            "device (28)",
            "a data worker ran out of shared memory at step 7",
            "/dev/shm is full",
            "per_device_num_workers=0",
        ),
        (
            GONE.format(5, "Segmentation fault"),
            "a data worker (pid 5) ended: segmentation fault at step 7",
            "a crash below Python",
            "python -X faulthandler",
        ),
        (
            "DataLoader worker (pid(s) 5, 6) exited unexpectedly",
            "a data worker (pid 5, 6) ended without an error message at step 7",
            "a crash below Python",
            "python -X faulthandler",
        ),
    ],
)
def test_a_data_worker(text, what, cause, advice):
    told = explain(RuntimeError(text), 7)
    assert told.what == what
    assert cause in told.cause
    assert advice in told.next
    assert told.next.endswith("then resume with --resume auto: checkpoints are as they were")


class Deadly(TinyDataset):
    """The worker that loads sample 20 is killed, as the OOM killer does it."""

    def get_sample(self, index, epoch):
        if index == 20 and torch.utils.data.get_worker_info() is not None:
            os.kill(os.getpid(), signal.SIGKILL)
        return super().get_sample(index, epoch)


def killed(work_dir):
    """A process of its own: torch tells of the worker wherever its trainer is just then."""
    config = tiny_config({"type": "OneProcessRunner", "max_epochs": 1}, workers=1)
    context = RunContext(config=config, section="runner", work_dir=work_dir)
    runner = build_runner_from_cfg(config["runner"], context)
    runner.run_setup(37)
    try:
        with unflushed():
            runner.run(Deadly())
    except RunFailed as error:
        (work_dir / "said").write_text(error.what)


def test_a_data_worker_that_is_killed_ends_the_run_in_words(tmp_path):
    assert run_ranks(1, killed, tmp_path) == [0]
    said = (tmp_path / "said").read_text()
    assert re.match(r"a data worker \(pid \d+\) was killed at step", said)


def test_torch_itself_runs_out_of_memory():
    with pytest.raises(RuntimeError) as caught:
        torch.empty(1 << 60, dtype=torch.uint8)
    assert explain(caught.value).what == "this machine ran out of memory"


def test_other_errors_are_left_alone():
    assert explain(RuntimeError("shape mismatch")) is None
    assert explain(OSError(errno.ENOSPC, "No space left on device")) is None
    loading = "/lib/libgomp.so.1: cannot allocate memory in static TLS block"
    assert explain(OSError(loading)) is None


def refuse():
    raise OSError(errno.ENOMEM, "Cannot allocate memory")


def test_a_worker_that_the_system_cannot_start_is_told_of(tmp_path, monkeypatch):
    config = tiny_config({"type": "OneProcessRunner", "max_steps": 2}, workers=1)
    context = RunContext(config=config, section="runner", work_dir=tmp_path)
    runner = build_runner_from_cfg(config["runner"], context)
    runner.run_setup(37)
    monkeypatch.setattr(os, "fork", refuse)
    with pytest.raises(RunFailed, match="this machine ran out of memory at step 1"):
        runner.run(TinyDataset())


def test_a_setup_that_the_system_has_no_memory_for_is_told_of(tmp_path, monkeypatch):
    monkeypatch.setattr(build, "build_dataset_from_cfg", lambda cfg, context: TinyDataset())
    runner = make(tmp_path)
    monkeypatch.setattr(runner, "run_setup", lambda n_train_examples: refuse())
    config = {"runner": {}, "train_dataloader": {"dataset": {}}}
    plan = SimpleNamespace(section="runner", config=SimpleNamespace(tree=config))
    context = RunContext(config=config, section="runner", work_dir=tmp_path)
    with pytest.raises(RunFailed, match="this machine ran out of memory"):
        _run_section(plan, lambda cfg, context: runner, context)


def test_a_run_keeps_what_it_saved_and_goes_on(tmp_path, monkeypatch):
    forward = TinyVLA.forward

    def growing(self, **batch):
        if self.batches == 4:
            raise OutOfMemoryError(CUDA)
        return forward(self, **batch)

    runner = make(tmp_path)
    runner.forward_arguments = None
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
