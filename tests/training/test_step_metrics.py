"""The numbers of steps, fetched together."""

from __future__ import annotations

import types

import pytest
import torch

from fluxvla_core.errors import RunFailed
from fluxvla_core.testing.training import run_ranks
from fluxvla_core.training import distributed, step_metrics
from fluxvla_core.training.distributed import World
from fluxvla_core.training.step_metrics import Step, StepMetrics

ONE = World(0, 1, 0, torch.device("cpu"))


def add(window, step, *losses, norm=1.0, ids=None, wait=0.0):
    tensors = [torch.tensor(loss) for loss in losses]
    numbers = ids or [torch.tensor([10 * step + i]) for i in range(len(losses))]
    window.add(Step(step, 0.5, 1e-3, tensors, numbers, torch.tensor(norm), 8, wait))


def test_losses_are_means_over_the_batches_of_a_step():
    window = StepMetrics(ONE)
    add(window, 1, 1.0, 3.0)
    add(window, 2, 5.0, 6.0, norm=2.0)
    first, second = window.fetch()
    wanted = {"epoch": 0.5, "lr": 1e-3}
    assert {**first, "global_step": 1, "loss": 2.0, "grad_norm": 1.0, **wanted} == first
    assert {**second, "global_step": 2, "loss": 5.5, "grad_norm": 2.0, **wanted} == second
    assert window.fetch() == []


class Clock:
    """Stands still unless a test moves it."""

    def __init__(self, monkeypatch):
        self.now = 0.0
        fixed = types.SimpleNamespace(perf_counter=lambda: self.now)
        monkeypatch.setattr(step_metrics, "time", fixed)


def test_times_add_up_and_a_save_is_left_out(monkeypatch):
    clock = Clock(monkeypatch)
    window = StepMetrics(ONE, began=0.0)
    for step, seconds, wait in ((1, 2.0, 0.25), (2, 4.0, 0.0)):
        clock.now += seconds
        add(window, step, 1.0, wait=wait)
    clock.now += 1.0  # what fetching takes is the last step's
    first, second = window.fetch()
    keys = ("step_time", "data_wait", "samples_per_s")
    assert [first[key] for key in keys] == [2.0, 0.125, 4.0]
    assert [second[key] for key in keys] == [5.0, 0.0, 1.6]
    clock.now += 100.0
    window.restart_clock()
    clock.now += 2.0
    add(window, 3, 1.0)
    assert window.fetch()[0]["step_time"] == 2.0


class OnDevice(torch.Tensor):
    """Of a device that computes while the host goes on; fetching it waits."""

    clock: Clock
    done = 0.0

    @classmethod
    def __torch_function__(cls, func, types, args=(), kwargs=None):
        if func is torch.Tensor.cpu:
            cls.clock.now = max(cls.clock.now, cls.done)
        return super().__torch_function__(func, types, args, kwargs or {})


def test_a_host_that_runs_ahead_of_its_device_tells_the_devices_time(monkeypatch):
    """The host takes 1 s for a step, the device 10 s."""
    clock = OnDevice.clock = Clock(monkeypatch)
    OnDevice.done = 0.0
    window = StepMetrics(World(0, 1, 0, torch.device("meta")), began=0.0)
    found = []
    for step in range(1, 9):
        clock.now += 1.0
        OnDevice.done = max(OnDevice.done, clock.now) + 10.0
        loss = torch.tensor(1.0).as_subclass(OnDevice)
        wait = 1.0 if step == 1 else 0.0
        window.add(Step(step, 0.0, 1e-3, [loss], [None], torch.tensor(1.0), 8, wait))
        if step % 4 == 0:
            found += window.fetch()
            window.restart_clock()  # as after a save
    assert sum(record["step_time"] for record in found) == clock.now == 82.0
    assert {record["step_time"] for record in found} == {10.25}
    assert {record["samples_per_s"] for record in found} == {8 / 10.25}
    assert [record["data_wait"] for record in found] == [0.25 / 10.25] * 4 + [0.0] * 4


def test_a_strategy_that_tells_no_norm_has_none():
    window = StepMetrics(ONE)
    window.add(Step(1, 0.0, 1e-3, [torch.tensor(1.0)], [None], None, 8, 0.0))
    assert window.fetch()[0]["grad_norm"] is None


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_loss_that_is_not_finite_names_step_and_samples(bad):
    """O3 of upstream's bugs: no NaN detection."""
    window = StepMetrics(ONE)
    add(window, 1, 1.0, 2.0)
    add(window, 2, 1.0, bad)
    add(window, 3, bad, bad)
    with pytest.raises(RunFailed) as caught:
        window.fetch()
    assert str(caught.value) == (
        f"the loss is {bad} at step 2\n"
        f"    rank 0: loss {bad} on samples [21]\n"
        "  likely cause: a learning rate that is too high, or samples with wrong or huge values\n"
        "  next: look at those samples, or lower the learning rate, and resume from the last "
        "checkpoint, which was saved before this"
    )


def test_ids_may_be_a_list_or_missing():
    for ids, text in (([[4, 5]], "on samples [4, 5]"), ([None], "on a batch without sample_ids")):
        window = StepMetrics(ONE)
        add(window, 1, float("nan"), ids=ids)
        with pytest.raises(RunFailed, match=text.replace("[", r"\[")):
            window.fetch()


def test_a_gradient_that_is_not_finite_names_all_batches_of_its_step():
    window = StepMetrics(ONE)
    add(window, 3, 0.5)
    add(window, 4, 0.5, 0.5, 0.5, norm=float("inf"), ids=[torch.tensor([7, 9]), [4], None])
    with pytest.raises(RunFailed) as caught:
        window.fetch()
    assert caught.value.what == (
        "the gradient norm is inf at step 4, with loss 0.5\n"
        "    rank 0: samples [7, 9], samples [4], a batch without sample_ids"
    )


def two_ranks(folder):
    world = distributed.start("cpu")
    window = StepMetrics(world)
    add(window, 1, 1.0 + world.rank)
    (record,) = window.fetch()
    add(window, 2, 1.0 if world.rank == 0 else float("nan"), ids=[torch.tensor([7, 9])])
    try:
        window.fetch()
    except RunFailed as error:
        (folder / f"{world.rank}").write_text(f"{record['loss']}\n{error.what}")
    distributed.stop(world)


def test_losses_are_of_all_ranks_and_every_rank_hears_of_another_ones_nan(tmp_path):
    """O1 of upstream's bugs: the logged loss was the first rank's."""
    assert run_ranks(2, two_ranks, tmp_path) == [0, 0]
    said = [(tmp_path / str(rank)).read_text() for rank in range(2)]
    assert (
        said[0]
        == said[1]
        == "1.5\nthe loss is nan at step 2\n    rank 1: loss nan on samples [7, 9]"
    )


def by_dataset(record):
    return {key.removeprefix("loss/"): v for key, v in record.items() if key.startswith("loss/")}


def test_the_loss_of_each_dataset():
    """Of three datasets one has no sample in the second step."""
    window = StepMetrics(ONE, {"cubes": 10, "cups": 5, "plates": 100})
    losses = [torch.tensor([1.0, 3.0, 5.0]), torch.tensor([7.0, 9.0])]
    ids = [torch.tensor([0, 9, 10]), torch.tensor([14, 15])]
    means = [part.mean() for part in losses]
    window.add(Step(1, 0.0, 1e-3, means, ids, None, 5, 0.0, losses))
    window.add(Step(2, 0.0, 1e-3, means[:1], ids[:1], None, 3, 0.0, losses[:1]))
    window.add(Step(3, 0.0, 1e-3, means[:1], ids[:1], None, 3, 0.0, [None]))
    window.add(Step(4, 0.0, 1e-3, means[:1], [None], None, 3, 0.0, losses[:1]))
    found = [by_dataset(record) for record in window.fetch()]
    assert found == [
        {"cubes": 2.0, "cups": 6.0, "plates": 9.0},
        {"cubes": 2.0, "cups": 5.0},
        {},
        {},
    ]


def test_one_dataset_has_no_loss_of_its_own():
    window = StepMetrics(ONE, {"cubes": 10})
    each = torch.tensor([1.0])
    window.add(Step(1, 0.0, 1e-3, [each.mean()], [torch.tensor([0])], None, 1, 0.0, [each]))
    assert by_dataset(window.fetch()[0]) == {}
