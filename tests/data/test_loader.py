from __future__ import annotations

import subprocess
import sys
import time
from itertools import islice
from pathlib import Path
from subprocess import PIPE

import numpy as np
import pytest
import torch

from fluxvla_core.contracts.reporter import SilentReporter
from fluxvla_core.data.collator import DictCollator
from fluxvla_core.data.loader import make_loader
from fluxvla_core.data.rng import sample_rng
from fluxvla_core.data.sampler import EpochSampler, Position
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


def batches(count, workers=0, dataset=None, start=None, rank=0, world=1):
    sampler = EpochSampler(10, 2, rank=rank, world=world, start=start)
    loader = make_loader(dataset or Noisy(), collate, sampler, workers)
    return list(islice(loader, count))


def equal(left, right):
    return all(torch.equal(a[k], b[k]) for a, b in zip(left, right, strict=True) for k in a)


def test_workers_change_nothing():
    assert equal(batches(8), batches(8, workers=2))


def test_a_position_resumes_with_equal_batches():
    whole = batches(9)
    assert equal(whole[6:], batches(3, start=Position(1, 1)))
    assert equal(whole[6:], batches(3, workers=1, start=Position(1, 1)))


def test_world_size_changes_who_loads_but_not_what():
    whole = batches(4)
    parts = [batches(2, rank=r, world=2) for r in range(2)]
    assert equal(whole, [parts[0][0], parts[1][0], parts[0][1], parts[1][1]])


def test_loading_draws_nothing_from_torchs_global_generator():
    before = torch.get_rng_state()
    batches(2)
    assert torch.equal(before, torch.get_rng_state())


def test_a_dataset_may_prepare_and_read_a_batch_at_once():
    dataset = Grouped()
    assert equal(batches(3, dataset=dataset), batches(3))
    assert dataset.asked == 3


def test_preparing_is_reported():
    told = []

    class Told(SilentReporter):
        def progress(self, name, done, total, **fields):
            told.append((name, done, total))

    make_loader(Grouped(), collate, EpochSampler(10, 2), reporter=Told())
    assert told == [("decode frames", 3, 3)]


@pytest.mark.parametrize("workers", [0, 1])
def test_an_error_arrives_as_it_was_raised(workers):
    dataset = Noisy()
    dataset.broken = 5
    with pytest.raises(DataError) as caught:
        batches(10, workers=workers, dataset=dataset)
    assert str(caught.value) == "file-000.mp4: frame 3 is missing\n  next: copy it again"


@pytest.mark.parametrize("workers", [0, 1])
def test_an_error_of_the_collator_arrives_too(workers):
    loader = make_loader(Noisy(), DictCollator(["x"]), EpochSampler(4, 2), workers)
    with pytest.raises(DataError, match="'noise' is in neither keys nor meta_keys"):
        next(iter(loader))


def test_negative_workers_are_refused():
    with pytest.raises(ConfigError, match="per_device_num_workers must be at least 0, got -1"):
        make_loader(Noisy(), collate, EpochSampler(4, 2), -1)


TRAINER = """
import multiprocessing, sys, time
import numpy as np
from fluxvla_core.data.collator import DictCollator
from fluxvla_core.data.loader import make_loader
from fluxvla_core.data.sampler import EpochSampler

class Numbers:
    def get_sample(self, index, epoch):
        return {"x": np.int64(index)}

if __name__ == "__main__":
    loader = make_loader(
        Numbers(), DictCollator(["x"]), EpochSampler(10, 2), 2, multiprocessing_context=sys.argv[1]
    )
    batches = iter(loader)
    next(batches)
    print(*(child.pid for child in multiprocessing.active_children()), flush=True)
    time.sleep(600)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
@pytest.mark.parametrize("context", ["fork", "forkserver", "spawn"])
def test_workers_end_with_a_trainer_that_is_killed(tmp_path, context):
    script = tmp_path / "trainer.py"
    script.write_text(TRAINER)
    with subprocess.Popen([sys.executable, str(script), context], stdout=PIPE) as trainer:
        workers = [Path("/proc", pid) for pid in trainer.stdout.readline().decode().split()]
        assert len(workers) == 2
        trainer.kill()
    until = time.monotonic() + 120
    while any(worker.exists() for worker in workers):
        assert time.monotonic() < until, "a worker is still there"
        time.sleep(0.05)
