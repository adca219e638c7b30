"""What processes tell each other."""

from __future__ import annotations

import json
import os
import sys

import pytest
import torch

from fluxvla_core.errors import CheckpointError, ConfigError, FluxError, RunFailed
from fluxvla_core.testing.training import run_ranks
from fluxvla_core.training import distributed
from fluxvla_core.training.distributed import World, run_on_rank0, start
from fluxvla_core.training.failures import explain

ONE = World(0, 1, 0, torch.device("cpu"))
TWO = World(1, 2, 1, torch.device("cpu"))


class Own(FluxError):
    """An error class that the core does not know."""


def fail(error):
    raise error


def talk(folder):
    world = start("cpu")
    said = {
        "rank": (world.rank, world.size, world.is_rank0, world.owned),
        "maximum": distributed.all_reduce_max(world, 3 * world.rank),
        "sum": distributed.all_reduce_sum(world, torch.tensor([1.0, world.rank])).tolist(),
        "text": distributed.broadcast_text(world, "grüße" if world.is_rank0 else "other"),
        "no text": distributed.broadcast_text(world, ""),
        "texts": distributed.all_gather_text(world, f"r{world.rank}" * (1 + 1500 * world.rank)),
        "first": run_on_rank0(world, lambda: f"rank {world.rank}"),
    }
    for name, error in {
        "error": CheckpointError("torn", where="here", cause="why", next="do"),
        "own error": Own("mine"),
    }.items():
        try:
            run_on_rank0(world, lambda: fail(error))  # noqa: B023 - called at once
        except FluxError as caught:
            said[name] = [type(caught).__name__, str(caught)]
    (folder / f"{world.rank}.json").write_text(json.dumps(said))
    distributed.stop(world)


def test_two_ranks(tmp_path):
    assert run_ranks(2, talk, tmp_path) == [0, 0]
    first, second = (json.loads((tmp_path / f"{r}.json").read_text()) for r in range(2))
    assert first["rank"] == [0, 2, True, True]
    assert second["rank"] == [1, 2, False, True]
    assert second.pop("own error") == ["FluxError", "mine"]
    assert first.pop("own error") == ["Own", "mine"]
    first.pop("rank"), second.pop("rank")
    assert first == second
    assert first["maximum"] == 3
    assert first["sum"] == [2.0, 1.0]
    assert first["text"] == "grüße"
    assert first["no text"] == ""
    assert first["texts"] == ["r0", "r1" * 1501]
    assert first["first"] == "rank 0"
    assert first["error"] == [
        "CheckpointError",
        "here: torn\n  likely cause: why\n  next: do",
    ]


def test_one_process_needs_no_group():
    world = start("cpu")
    assert (world.rank, world.size, world.control, world.owned) == (0, 1, None, False)
    distributed.stop(world)
    assert distributed.all_reduce_max(ONE, 7) == 7
    assert distributed.all_gather_text(ONE, "a") == ["a"]
    assert distributed.broadcast_text(ONE, "a") == "a"
    assert run_on_rank0(ONE, lambda: "x") == "x"
    with pytest.raises(CheckpointError, match="torn"):
        run_on_rank0(ONE, lambda: fail(CheckpointError("torn")))


def test_the_deprecated_name_of_rank_0():
    with pytest.warns(DeprecationWarning, match=r"use World\.is_rank0"):
        assert (ONE.first, TWO.first) == (True, False)


def group_of_one():
    world = start("cpu", group_of_one=True)
    assert torch.distributed.is_initialized()
    assert world.size == 1
    distributed.stop(world)
    assert not torch.distributed.is_initialized()


def test_a_single_process_can_have_a_group():
    assert run_ranks(1, group_of_one) == [0]


def test_devices_that_are_not_there_are_refused(monkeypatch):
    with pytest.raises(ConfigError, match="device 'gpu' is not one of 'auto', 'cpu', 'cuda'"):
        start("gpu")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ConfigError, match="device is 'cuda', but torch finds no GPU here"):
        start("cuda")
    assert start("auto").device.type == "cpu"
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    monkeypatch.setenv("LOCAL_RANK", "1")
    with pytest.raises(ConfigError, match=r"process 2 .* no GPU of its own: torch sees 1") as found:
        start("auto")
    assert "--nproc 1, or --set <section>.device=cpu" in str(found.value)


def test_a_lost_rank_is_explained_and_other_errors_are_not():
    error = RuntimeError("[gloo/pair.cc:553] Connection closed by peer [127.0.0.1]:4009")
    lost = explain(error, 12, TWO)
    assert isinstance(lost, RunFailed)
    assert str(lost) == (
        "rank 1 of 2 lost another rank during step 12\n"
        "  likely cause: another process of this run ended; its own message says why "
        "([gloo/pair.cc:553] Connection closed by peer [127.0.0.1]:4009)\n"
        "  next: fix what that message names, then run the same command with --resume auto"
    )
    assert explain(RuntimeError("mat1 and mat2 shapes cannot be multiplied"), 12, TWO) is None
    assert explain(error, 12, ONE) is None


@pytest.mark.parametrize(
    "text",
    [
        "[../gloo/transport/tcp/pair.cc:547] Read error [127.0.0.1]:1: Connection reset by peer",
        "[../gloo/transport/tcp/unbound_buffer.cc:78] Timed out waiting 1800000ms for recv "
        "operation to complete",
        "[../gloo/transport/tcp/pair.cc:534] Socket closed [127.0.0.1]:1",
        "Application timeout caused pair closure",
        "failed to recv, got 0 bytes. Connection was likely closed. Did the remote server shutdown "
        "or crash?",
        "The client socket has timed out after 60000ms while trying to connect to (localhost, 1).",
        "Socket Timeout",
        "wait timeout after 300000ms, keys: /worker/1",
        "Timed out after 61 seconds waiting for clients. 1/2 clients joined.",
        "NCCL error in: ProcessGroupNCCL.cpp:3356, remote process exited or there was a network "
        "error",
        "NCCL communicator was aborted on rank 1.",
        "[Rank 0] Watchdog caught collective operation timeout: WorkNCCL(SeqNum=3) ran for 600000 "
        "milliseconds before timing out.",
    ],
)
def test_what_gloo_c10d_and_nccl_say_of_a_lost_rank(text):
    assert explain(RuntimeError(text), 12, TWO) is not None


WORKER = "Caught RuntimeError in DataLoader worker process 0.\nOriginal Traceback …\nRuntimeError: "


@pytest.mark.parametrize(
    "error",
    [
        RuntimeError(WORKER + "the camera's Connection reset by peer"),
        RuntimeError("could not decode /data/peg_in_socket/ep.mp4"),
        RuntimeError("DataLoader timed out after 5 seconds"),
        BrokenPipeError(32, "Broken pipe"),
    ],
)
def test_what_is_of_this_rank_is_not_blamed_on_another(error):
    assert explain(error, 12, TWO) is None


def interfaces(folder, local_size):
    for kind in ("GLOO", "NCCL"):  # set in the parent by any test that made a process group there
        os.environ.pop(f"{kind}_SOCKET_IFNAME", None)
    os.environ["LOCAL_WORLD_SIZE"] = local_size
    world = start("cpu")
    names = [os.environ.get(f"{kind}_SOCKET_IFNAME") for kind in ("GLOO", "NCCL")]
    (folder / f"{local_size}-{world.rank}").write_text(str(names))
    distributed.stop(world)


@pytest.mark.skipif(sys.platform != "linux", reason="its loopback has another name")
@pytest.mark.parametrize(("local_size", "name"), [("2", "lo"), ("1", None)])
def test_processes_of_one_machine_listen_to_it_alone(tmp_path, local_size, name):
    assert run_ranks(2, interfaces, tmp_path, local_size) == [0, 0]
    said = {(tmp_path / f"{local_size}-{rank}").read_text() for rank in range(2)}
    assert said == {str([name, name])}
