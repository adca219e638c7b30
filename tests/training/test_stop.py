"""Being asked to stop."""

from __future__ import annotations

import os
import signal
import threading

import pytest
import torch

from fluxvla_core.errors import RunFailed
from fluxvla_core.testing.training import run_ranks
from fluxvla_core.training import distributed, stop
from fluxvla_core.training.distributed import World
from fluxvla_core.training.stop import StopRequest, stopped

ONE = World(0, 1, 0, torch.device("cpu"))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_asks_for_a_stop_and_handlers_come_back(number):
    before = signal.getsignal(number)
    with StopRequest(ONE) as request:
        assert request.poll(1) == 0
        os.kill(os.getpid(), number)
        assert request.poll(2) == number
    assert signal.getsignal(number) is before


def test_a_signal_that_comes_twice_at_once_is_one(monkeypatch):
    """A terminal sends SIGINT to every process, and a launcher passes its own on."""
    with StopRequest(ONE) as request:
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)
        assert request.poll(1) == signal.SIGINT


def test_a_second_interrupt_ends_at_once(monkeypatch):
    monkeypatch.setattr(stop, "_SECOND_S", -1.0)
    with StopRequest(ONE):
        os.kill(os.getpid(), signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)


def test_a_forked_data_worker_ignores_what_is_meant_for_its_parent():
    with StopRequest(ONE) as request:
        pid = os.fork()
        if pid == 0:
            os.kill(os.getpid(), signal.SIGTERM)
            os._exit(request.poll(1))
        assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
        assert request.poll(1) == 0


def test_other_threads_set_no_handlers():
    before = signal.getsignal(signal.SIGINT)
    seen = []

    def run():
        with StopRequest(ONE) as request:
            seen.append((signal.getsignal(signal.SIGINT) is before, request.poll(1)))

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert seen == [(True, 0)]


def test_ranks_compare_notes_about_twice_a_second():
    request = StopRequest(World(0, 2, 0, torch.device("cpu")))
    request.set_interval(0.01)
    assert request.poll(49) == 0  # asks nobody: there is no process group here
    request.set_interval(10.0)
    assert request._every == 1
    request.set_interval(0.0)
    assert request._every == 1


def test_how_a_stopped_run_ends():
    assert isinstance(stopped(signal.SIGINT, "here"), KeyboardInterrupt)
    error = stopped(signal.SIGTERM, "step 3 in work")
    assert isinstance(error, RunFailed)
    assert error.exit_code == 1
    assert str(error) == (
        "training was stopped by SIGTERM\n"
        "  likely cause: all is saved: step 3 in work\n"
        "  next: run the same command again with --resume auto"
    )


def ranks(folder):
    world = distributed.start("cpu")
    with StopRequest(world) as request:
        seen = [request.poll(1)]
        request.set_interval(stop.NOTICE_S / 3)
        if world.rank == 1:
            os.kill(os.getpid(), signal.SIGTERM)
        seen += [request.poll(2), request.poll_now(), request.poll(3)]
    (folder / str(world.rank)).write_text(str(seen))
    distributed.stop(world)


def test_all_ranks_stop_when_one_is_asked(tmp_path):
    assert run_ranks(2, ranks, tmp_path) == [0, 0]
    assert [(tmp_path / str(r)).read_text() for r in range(2)] == ["[0, 0, 15, 15]"] * 2
