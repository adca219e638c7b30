"""A small model, dataset and launcher for tests of training strategies.

``testing.train_runner`` has the proofs; FluxVLA's own runners are tested with them.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar
from unittest import mock

import numpy as np
import torch
from torch import Tensor, nn

from fluxvla_core.build import RunContext, build_runner_from_cfg
from fluxvla_core.checkpoints.checkpoint import folders
from fluxvla_core.checkpoints.writer import Disk
from fluxvla_core.contracts.runner import SilentReporter
from fluxvla_core.contracts.training import VLA
from fluxvla_core.data.loader import DictCollator
from fluxvla_core.data.sampler import sample_rng
from fluxvla_core.plugins.registry import RUNNERS, VLAS
from fluxvla_core.spec import EmbodimentSpec, Joint
from fluxvla_core.testing.comparisons import (
    assert_trained_alike,
    checkpoint_differences,
    differences,
    losses,
)
from fluxvla_core.training import stop
from fluxvla_core.training.base_runner import BaseTrainRunner
from fluxvla_core.training.distributed import LOOPBACK, loopback_store

__all__ = [
    "ACTIONS",
    "HORIZON",
    "STATES",
    "Block",
    "OneProcessRunner",
    "TinyDataset",
    "TinyVLA",
    "assert_trained_alike",
    "checkpoint_differences",
    "differences",
    "losses",
    "run_ranks",
    "tiny_config",
    "train",
    "train_all",
]

STATES, HORIZON, ACTIONS = 6, 2, 3
SCALARS = ("trained", "frozen")
"""Kinds of parameters without dimensions that a ``TinyVLA`` can have."""
KEYS = ("states", "actions", "noise", "sample_ids")
PRELOAD = (
    "fluxvla_core.testing.training",
    "fluxvla_core.training.optimizers",
    "fluxvla_core.training.state",
    "fluxvla_core.training.optimizers",
    "fluxvla_core.training.trainer",
    "torch._dynamo",  # imported by the first optimizer, and slowly
    "torch.distributed.fsdp",
)


class Block(nn.Module):
    """Residual layer with dropout, so that a lost random state shows in the weights."""

    def __init__(self, width: int, dropout: float) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.linear = nn.Linear(width, width)
        self.dropout = nn.Dropout(dropout)

    def forward(self, x: Tensor) -> Tensor:
        """``(B, width)`` -> ``(B, width)``."""
        out: Tensor = x + self.dropout(torch.relu(self.linear(self.norm(x))))
        return out


@VLAS.register_module()
class TinyVLA(VLA, nn.Module):
    """A frozen encoder, two blocks, a head, and a buffer that training changes.

    Args:
        bad_sample: id of a sample whose loss is NaN; -1 for none.
        spare: have a layer that the forward pass does not use.
        centred: subtract a running mean of the states, a buffer that follows from the batches of
            its own process: how samples are shared between processes then shows in the loss.
        batch_norm: normalise over the batch in a block and before the head, which follows from the
            batches of its own process as well.
        assorted: have a parameter of one element and two layers that share their weights.
        scalar: have a parameter without dimensions, ``trained`` or ``frozen``.
    """

    def __init__(
        self,
        width: int = 8,
        dropout: float = 0.1,
        bad_sample: int = -1,
        spare: bool = False,
        centred: bool = False,
        batch_norm: bool = False,
        assorted: bool = False,
        scalar: str | None = None,
    ) -> None:
        super().__init__()
        self.encoder = nn.Linear(STATES, width).requires_grad_(False)
        self.blocks = nn.ModuleList(Block(width, dropout) for _ in range(2))
        self.head = nn.Linear(width, HORIZON * ACTIONS)
        self.spare = nn.Linear(1, 1) if spare else None
        self.bad_sample = bad_sample
        self.batches: Tensor
        self.register_buffer("batches", torch.zeros((), dtype=torch.int64))
        self.mean: Tensor | None
        self.register_buffer("mean", torch.zeros(STATES) if centred else None)
        self.batch_norm = nn.BatchNorm1d(width) if batch_norm else None
        if batch_norm:
            self.blocks[1] = nn.Sequential(nn.BatchNorm1d(width), self.blocks[1])
        self.mixers = _tied(width) if assorted else None
        self.offset = nn.Parameter(torch.zeros(1)) if assorted else None
        self.gain = nn.Parameter(torch.tensor(0.5), scalar == "trained") if scalar else None

    def forward(
        self, states: Tensor, actions: Tensor, noise: Tensor, sample_ids: Tensor
    ) -> dict[str, Tensor]:
        """``(B, 6)``, ``(B, 2, 3)``, ``(B, 2, 3)``, ``(B,)`` -> ``{"loss": scalar}``."""
        x = self.encoder(states if self.mean is None else self._centre(states, self.mean))
        for block in self.blocks:
            x = block(x)
        if self.batch_norm is not None:
            x = self.batch_norm(x)
        if self.mixers is not None:
            x = x + self.mixers(x) + self.offset
        if self.gain is not None:
            x = self.gain * x
        found = self.head(x).unflatten(1, (HORIZON, ACTIONS))
        loss = (found - actions - 0.1 * noise).square().mean()
        if self.bad_sample >= 0:
            loss = loss + torch.where(sample_ids == self.bad_sample, torch.nan, 0.0).sum()
        if self.training:
            self.batches += 1
        return {"loss": loss}

    def _centre(self, states: Tensor, mean: Tensor) -> Tensor:
        if self.training:
            with torch.no_grad():
                mean.lerp_(states.mean(0), 0.1)
        return states - mean

    @property
    def action_shape(self) -> tuple[int, int]:
        """``(T, D)`` of a chunk."""
        return HORIZON, ACTIONS

    def fsdp_units(self) -> list[nn.Module]:
        """The blocks."""
        return list(self.blocks)


def _tied(width: int) -> nn.Sequential:
    first, second = (nn.Linear(width, width, bias=False) for _ in range(2))
    second.weight = first.weight
    return nn.Sequential(first, second)


@RUNNERS.register_module()
class OneProcessRunner(BaseTrainRunner):
    """The base class as it is."""


class TinyDataset:
    """``length`` samples whose noise follows from (seed, epoch, index)."""

    fps = 10.0
    statistics: ClassVar[dict[str, Any]] = {
        "private": {"action": {"mean": [0.0] * ACTIONS, "std": [1.0] * ACTIONS}}
    }
    embodiment = EmbodimentSpec(
        "tiny", tuple(Joint(f"j{i}", "rad", -1.0, 1.0, 1.0, 1.0) for i in range(ACTIONS)), (), 10.0
    )

    def __init__(self, length: int = 37) -> None:
        self.length = length

    def __len__(self) -> int:
        return self.length

    def get_sample(self, index: int, epoch: int) -> dict[str, Any]:
        """One sample; keys are :data:`KEYS`."""
        fixed = np.random.default_rng(index)
        noise = sample_rng(42, epoch, index).standard_normal((HORIZON, ACTIONS))
        return {
            "states": fixed.standard_normal(STATES).astype(np.float32),
            "actions": fixed.standard_normal((HORIZON, ACTIONS)).astype(np.float32),
            "noise": noise.astype(np.float32),
            "sample_ids": np.int64(index),
        }


def tiny_config(
    runner: Mapping[str, Any], batch: int = 4, workers: int = 0, **model: Any
) -> dict[str, Any]:
    """A whole config around ``runner``, with ``batch`` samples and ``workers`` per process."""
    collator = {"type": "DictCollator", "keys": list(KEYS)}
    return {
        "model": {"type": "TinyVLA", **model},
        "train_dataloader": {
            "per_device_batch_size": batch,
            **({"per_device_num_workers": workers} if workers else {}),
        },
        "runner": {"learning_rate": 1e-2, "collator": collator, **runner},
    }


class Notes(SilentReporter):
    """Writes the messages of a run into ``said.txt`` of its work dir."""

    def __init__(self, work_dir: Path) -> None:
        self.path = work_dir / "said.txt"

    def info(self, text: str) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self.path.open("a") as file:
            file.write(text + "\n")

    def warn(self, text: str) -> None:
        self.info(f"warning: {text}")


def train(settings: Mapping[str, Any]) -> Any:
    """Run a training in this process; returns its runner.

    Args:
        settings: ``work_dir`` and ``config``; ``resume`` (None); ``dataset``, or the ``length``
            (37) of a ``TinyDataset``;
            ``signal`` (rank, n, number): the rank sends itself signal ``number`` when it collates
            its n-th batch; ``kill_write`` n: SIGKILL before the n-th file operation of checkpoints;
            ``kill_forward`` (rank, n): the rank ends by SIGKILL before its n-th forward pass,
            as soon as there is a checkpoint; ``nap_s``: seconds to sleep before each of them;
            ``notice_s`` (0.5): seconds within which ranks hear of each other's signals.
    """
    config = settings["config"]
    context = RunContext(
        config=config,
        section="runner",
        work_dir=Path(settings["work_dir"]),
        resume=settings.get("resume"),
        reporter=Notes(Path(settings["work_dir"])),
    )
    table = dict(config["runner"])
    if settings.get("signal"):
        rank, batch, number = settings["signal"]
        if rank == int(os.environ.get("RANK", "0")):
            table["collator"] = SignallingCollator(batch, number, context.work_dir)
    stop.NOTICE_S = settings.get("notice_s", stop.NOTICE_S)
    if settings.get("kill_write"):
        kill_at_operation(settings["kill_write"])
    dataset = settings.get("dataset") or TinyDataset(settings.get("length", 37))
    with unflushed():
        runner = build_runner_from_cfg(table, context)
        runner.run_setup(len(dataset))
        if "kill_forward" in settings or "nap_s" in settings:
            runner._training_step = _endangered(runner._training_step, settings)
        runner.run(dataset)
    return runner


def _endangered(step: Callable[..., Any], settings: Mapping[str, Any]) -> Callable[..., Any]:
    rank, left = settings.get("kill_forward", (-1, 0))
    mine = rank == int(os.environ.get("RANK", "0"))

    def run(batch: dict[str, Any]) -> Any:
        nonlocal left
        left -= 1
        time.sleep(settings.get("nap_s", 0.0))
        if mine and left == 0:
            await_checkpoint(Path(settings["work_dir"]))
            os.kill(os.getpid(), signal.SIGKILL)
        return step(batch)

    return run


def await_checkpoint(work_dir: Path) -> None:
    """Return once there is one: it may still be on its way when its step is done."""
    limit = time.monotonic() + 60.0
    while not folders(work_dir):
        assert time.monotonic() < limit, "no checkpoint within a minute"
        time.sleep(0.01)


@contextmanager
def unflushed() -> Iterator[None]:
    """Let nothing wait for the device: a process that is killed loses nothing that it wrote."""
    with mock.patch.object(os, "fsync", return_value=None):
        yield


def train_all(*runs: Mapping[str, Any]) -> None:
    """Several runs one after the other, in one process group."""
    if "RANK" in os.environ:
        torch.distributed.init_process_group("gloo")
    for settings in runs:
        train(settings)


class SignallingCollator(DictCollator):
    """Sends this process signal ``number`` on the way to the ``batch``-th batch.

    SIGKILL waits until a checkpoint is there, which may still be on its way when a step is done.
    """

    def __init__(self, batch: int, number: int, work_dir: Path) -> None:
        super().__init__(KEYS)
        self.left, self.number, self.work_dir = batch, number, work_dir

    def __call__(self, samples: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        self.left -= 1
        if self.left == 0:
            if self.number == signal.SIGKILL:
                await_checkpoint(self.work_dir)
            os.kill(os.getpid(), self.number)
        return super().__call__(samples)


def kill_at_operation(number: int) -> None:
    """End this process by SIGKILL before the ``number``-th file operation of its checkpoints."""
    left = [number]
    for name in [n for n in vars(Disk) if not n.startswith("_")]:
        setattr(Disk, name, _counted(getattr(Disk, name), left))


def _counted(operation: Callable[..., Any], left: list[int]) -> Callable[..., Any]:
    def run(*args: Any) -> Any:
        left[0] -= 1
        if left[0] <= 0:
            os.kill(os.getpid(), signal.SIGKILL)
        return operation(*args)

    return run


def run_ranks(
    ranks: int,
    function: Callable[..., Any],
    *args: Any,
    timeout: float = 600.0,
    watch: Callable[[Sequence[Any]], None] | None = None,
) -> list[int | None]:
    """Call ``function(*args)`` in ``ranks`` new processes that form one group on the loopback.

    The processes are forked from a server that has torch imported already, so that a start takes
    a tenth of a second. ``watch`` is called with the processes once all have been started. One
    that is still alive after ``timeout`` seconds is killed.

    Returns:
        The exit code of each: 0, 1 after an exception, ``-9`` after SIGKILL.
    """
    usual = multiprocessing.get_start_method()
    context = multiprocessing.get_context("forkserver")
    # Slow to import, so only for those who use it.
    context.set_forkserver_preload([*PRELOAD, *(n for n in ("peft",) if n in sys.modules)])
    store = loopback_store() if ranks > 1 else None  # kept until all have ended
    port = 0 if store is None else store.port
    processes = [
        context.Process(target=_rank, args=(rank, ranks, port, usual, function, args))
        for rank in range(ranks)
    ]
    for process in processes:
        process.start()
    if watch is not None:
        watch(processes)
    for process in processes:
        process.join(timeout)
        if process.is_alive():
            process.kill()
            process.join()
    return [process.exitcode for process in processes]


def _rank(
    rank: int,
    ranks: int,
    port: int,
    start_method: str,
    function: Callable[..., Any],
    args: tuple[Any, ...],
) -> None:
    # A process has the way of its own start as its default; loader workers are to start as in a
    # run from the command line, and one that is not forked imports torch again.
    multiprocessing.set_start_method(start_method, force=True)
    torch.set_num_threads(1)
    if ranks > 1:
        os.environ.update(
            RANK=str(rank),
            LOCAL_RANK=str(rank),
            WORLD_SIZE=str(ranks),
            LOCAL_WORLD_SIZE=str(ranks),
            MASTER_ADDR=LOOPBACK,
            MASTER_PORT=str(port),
            TORCHELASTIC_USE_AGENT_STORE=str(True),
        )
    function(*args)
