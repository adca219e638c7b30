from __future__ import annotations

import multiprocessing
import os
import platform
import random
import resource
import signal
import subprocess
import sys
import time
from itertools import islice
from multiprocessing.connection import Client
from multiprocessing.resource_sharer import DupFd
from pathlib import Path
from subprocess import PIPE

import numpy as np
import pytest
import torch

from fluxvla_core.contracts.runner import SilentReporter
from fluxvla_core.data.loader import DictCollator, make_loader
from fluxvla_core.data.sampler import Cursor, StepPlan, StepSampler, sample_rng
from fluxvla_core.errors import ConfigError, DataError

collate = DictCollator(["x", "noise"])


class Noisy:
    """Samples whose noise follows from (seed, epoch, index)."""

    broken = -1

    def get_sample(self, index, epoch):
        if index == self.broken:
            raise DataError("frame 3 is missing", where="file-000.mp4", next="copy it again")
        noise = sample_rng(42, epoch, index).random(4).astype(np.float32)
        return {"x": np.int64(index), "noise": noise}


class Grouped(Noisy):
    prepared = False
    asked = 0

    def prepare(self, reporter):
        reporter.progress("decode frames", 3, 3)
        self.prepared = True

    def get_samples(self, keys):
        assert self.prepared
        self.asked += 1
        return [self.get_sample(key.index, key.epoch) for key in keys]


class Careless(Noisy):
    """Samples whose noise comes from the global generators, as others' code draws it."""

    def get_sample(self, index, epoch):
        drawn = [random.random(), np.random.random(), float(torch.rand(())), random.random()]
        return {"x": np.int64(index), "noise": np.array(drawn, np.float32)}


def batches(count, workers=0, dataset=None, start=None, rank=0, world=1, seed=42, collate=collate):
    sampler = StepSampler(StepPlan(10, 2, world=world), rank, start)
    loader = make_loader(dataset or Noisy(), collate, sampler, workers, seed=seed)
    return list(islice(loader, count))


def equal(left, right):
    return all(torch.equal(a[k], b[k]) for a, b in zip(left, right, strict=True) for k in a)


def test_workers_change_nothing():
    assert equal(batches(8), batches(8, workers=2))


def test_a_position_resumes_with_equal_batches():
    whole = batches(9)
    assert equal(whole[6:], batches(3, start=Cursor(1, 2)))
    assert equal(whole[6:], batches(3, workers=1, start=Cursor(1, 2)))


def test_world_size_changes_who_loads_but_not_what():
    whole = batches(4)
    parts = [batches(2, rank=r, world=2) for r in range(2)]
    assert equal(whole, [parts[0][0], parts[1][0], parts[0][1], parts[1][1]])


def noise(found):
    return torch.cat([batch["noise"] for batch in found])


def test_global_generators_draw_by_the_batch_and_not_by_who_makes_it():
    """D3 of upstream's bugs, for workers: theirs began alike on every rank and after a restart."""
    whole = batches(9, dataset=Careless())
    assert equal(whole, batches(9, workers=2, dataset=Careless()))
    assert equal(whole[6:], batches(3, start=Cursor(1, 2), workers=2, dataset=Careless()))
    assert len(np.unique(noise(whole))) == 9 * 2 * 4


def test_global_generators_draw_different_numbers_on_two_ranks_and_by_another_seed():
    asked = [{"rank": 0}, {"rank": 1}, {"rank": 0, "seed": 43}]
    drawn = [noise(batches(2, 2, Careless(), world=2, **a)) for a in asked]
    assert len(np.unique(torch.cat(drawn))) == 3 * 2 * 2 * 4


def collate_carelessly(samples):
    return {"noise": torch.rand(len(samples))}


def test_a_collator_may_draw_from_them_too():
    found = [batches(4, workers, collate=collate_carelessly) for workers in (0, 2)]
    assert equal(*found)
    assert len(np.unique(noise(found[0]))) == 4 * 2


def test_making_batches_leaves_the_global_generators_as_they_were():
    def drawn(count):
        random.seed(1)
        np.random.seed(1)
        torch.manual_seed(1)
        batches(count, dataset=Careless())
        return random.random(), np.random.random(), float(torch.rand(()))

    assert drawn(0) == drawn(2)


def test_what_numpy_draws_beside_a_loader_does_not_depend_on_its_workers():
    """Numpy keeps every second normal number; where batches are made here it is forgotten."""

    def beside(workers):
        np.random.seed(1)
        loader = make_loader(Careless(), collate, StepSampler(StepPlan(10, 2)), workers)
        return [np.random.standard_normal() for _ in islice(loader, 3)]

    assert beside(0) == beside(2)


def test_a_dataset_may_prepare_and_read_a_batch_at_once():
    dataset = Grouped()
    assert equal(batches(3, dataset=dataset), batches(3))
    assert dataset.asked == 3


def test_preparing_is_reported():
    reported = []

    class Reports(SilentReporter):
        def progress(self, name, done, total, **fields):
            reported.append((name, done, total))

    make_loader(Grouped(), collate, StepSampler(StepPlan(10, 2)), reporter=Reports())
    assert reported == [("decode frames", 3, 3)]


@pytest.mark.parametrize("workers", [0, 1])
def test_an_error_arrives_as_it_was_raised(workers):
    dataset = Noisy()
    dataset.broken = 5
    with pytest.raises(DataError) as caught:
        batches(10, workers=workers, dataset=dataset)
    assert str(caught.value) == "file-000.mp4: frame 3 is missing\n  next: copy it again"


@pytest.mark.parametrize("workers", [0, 1])
def test_an_error_of_the_collator_arrives_too(workers):
    loader = make_loader(Noisy(), DictCollator(["x"]), StepSampler(StepPlan(4, 2)), workers)
    with pytest.raises(DataError, match="'noise' is in neither keys nor meta_keys"):
        next(iter(loader))


class Large:
    """Each sample makes images, and returns how many page faults that took."""

    def get_sample(self, index, epoch):
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        images = [np.ones(900_000, np.uint8) for _ in range(24)]
        after = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        return {"x": np.int64(after - before), "noise": sum(int(p[0]) for p in images)}


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="mallopt is of glibc")
def test_a_worker_uses_the_memory_of_a_batch_for_the_next_one():
    """22 MB are 5300 pages; each batch got all of them anew."""
    found = batches(6, workers=1, dataset=Large(), collate=DictCollator(["x"], ["noise"]))
    pages = [int(batch["x"].sum()) for batch in found]
    assert pages[0] > 4000, "the first has to get them"
    assert max(pages[2:]) < 1000, pages


class Handed:
    """Samples that name the socket where this worker hands its batches over."""

    def get_sample(self, index, epoch):
        address, _ = DupFd(0)._id
        return {"x": np.int64(index), "address": address}


def test_a_trainer_that_is_gone_while_it_takes_a_batch_is_no_error_of_the_worker(capfd):
    loader = make_loader(
        Handed(),
        DictCollator(["x"], ["address"]),
        StepSampler(StepPlan(10, 2)),
        1,
        prefetch_factor=1,
    )
    taken = iter(loader)
    address = next(taken)["address"][0]
    Client(address, authkey=multiprocessing.current_process().authkey).close()
    # Served after that connection, by the same thread.
    assert [len(next(taken)["x"]) for _ in range(4)] == [2] * 4
    taken.close()
    assert capfd.readouterr().err == ""


def test_negative_workers_are_refused():
    with pytest.raises(ConfigError, match="per_device_num_workers must be at least 0, got -1"):
        make_loader(Noisy(), collate, StepSampler(StepPlan(4, 2)), -1)


TRAINER = """
import multiprocessing, signal, sys, time
import numpy as np
from fluxvla_core.data.loader import DictCollator
from fluxvla_core.data.loader import make_loader
from fluxvla_core.data.sampler import StepPlan, StepSampler

class Numbers:
    def get_sample(self, index, epoch):
        return {"x": np.int64(index)}

if __name__ == "__main__":
    loader = make_loader(
        Numbers(),
        DictCollator(["x"]),
        StepSampler(StepPlan(10, 2)),
        2,
        multiprocessing_context=sys.argv[1],
    )
    batches = iter(loader)
    next(batches)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: None)
    print(*(child.pid for child in multiprocessing.active_children()), flush=True)
    sys.stdin.readline()
    print(sum(len(next(batches)["x"]) for _ in range(20)), flush=True)
    if sys.argv[2] == "stay":
        time.sleep(600)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
@pytest.mark.parametrize(
    ("context", "end"),
    [("fork", "stay"), ("fork", "leave"), ("forkserver", "stay"), ("spawn", "stay")],
)
def test_workers_end_with_their_trainer_and_of_no_signal_to_its_group(tmp_path, context, end):
    """The trainer is killed, or ends with its loader still open."""
    script = tmp_path / "trainer.py"
    script.write_text(TRAINER)
    command = [sys.executable, str(script), context, end]
    with subprocess.Popen(
        command, stdin=PIPE, stdout=PIPE, text=True, start_new_session=True
    ) as trainer:
        workers = [Path("/proc", pid) for pid in trainer.stdout.readline().split()]
        assert len(workers) == 2
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            os.killpg(trainer.pid, number)
        trainer.stdin.write("go on\n")
        trainer.stdin.flush()
        assert trainer.stdout.readline() == "40\n"
        if end == "leave":
            assert trainer.wait(60) == 0
        trainer.kill()
    until = time.monotonic() + 120
    while any(worker.exists() for worker in workers):
        assert time.monotonic() < until, "a worker is still there"
        time.sleep(0.05)
