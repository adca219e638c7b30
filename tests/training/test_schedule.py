"""Learning rates by step."""

from __future__ import annotations

import math

import pytest
import torch

from fluxvla_core.errors import ConfigError
from fluxvla_core.training.optimizers import TYPES, ScheduledLR, make_schedule


def rates(kind, total=10, lr=1.0, **more):
    schedule = make_schedule(kind, lr, total, **more)
    return [schedule(step) for step in range(total)]


def test_constant():
    assert rates("constant") == [1.0] * 10


def test_constant_with_warm_up():
    assert rates("constant", warmup_ratio=0.4) == [0.25, 0.5, 0.75, 1.0] + [1.0] * 6


def test_warm_up_then_cosine_to_zero():
    found = rates("linear-warmup+cosine-decay", total=102, lr=2.0, warmup_ratio=2 / 102)
    assert found[:3] == [1.0, 2.0, 2.0]
    assert found[2 + 50] == pytest.approx(1.0)
    assert found[2 + 25] == pytest.approx(1 + math.cos(math.pi / 4))
    assert make_schedule("linear-warmup+cosine-decay", 2.0, 100)(100) == pytest.approx(0.0)


def test_cosine_stays_at_zero_beyond_the_end():
    assert make_schedule("linear-warmup+cosine-decay", 1.0, 10)(15) == pytest.approx(0.0)


def test_wsd_holds_and_decays_over_the_last_fifth():
    found = rates("wsd", total=100, warmup_ratio=0.1)
    assert found[9] == 1.0
    assert found[10:81] == [1.0] * 71
    assert found[81] < 1.0
    assert found[85] == pytest.approx(0.5)
    assert make_schedule("wsd", 1.0, 100)(100) == 0.0


def test_wsd_whose_warm_up_reaches_into_the_decay():
    found = rates("wsd", total=10, warmup_ratio=0.9)
    assert max(found) == 1.0
    assert found == sorted(found)


def test_step_based_takes_the_rates_as_they_are():
    table = {"0": 3e-4, "0.5": 1e-4, "0.9": 1e-5}
    found = rates("step-based", lr=9.0, lr_schedule=table)
    assert found == [3e-4] * 5 + [1e-4] * 4 + [1e-5]


@pytest.mark.parametrize("percent", range(1, 100))
def test_step_based_changes_at_the_very_step(percent):
    """0.07 * 100 is 7.000000000000001: the rate changed a step late."""
    found = rates("step-based", total=100, lr_schedule={0: 1.0, percent / 100: 2.0})
    assert found == [1.0] * percent + [2.0] * (100 - percent)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"kind": "cosine"}, "unknown lr_scheduler_type 'cosine'; choose one of 'constant'"),
        ({"kind": "constant", "warmup_ratio": 1.0}, "warmup_ratio must be at least 0 and below 1"),
        ({"kind": "step-based"}, "lr_schedule belongs to lr_scheduler_type 'step-based'"),
        ({"kind": "wsd", "lr_schedule": {0: 1}}, "lr_schedule belongs to lr_scheduler_type"),
        ({"kind": "step-based", "lr_schedule": {0.5: 1}}, r"0 among them, got \[0\.5\]"),
        ({"kind": "step-based", "lr_schedule": {}}, r"0 among them, got \[\]"),
        ({"kind": "step-based", "lr_schedule": {"x": 1}}, "maps ratios to rates"),
        ({"kind": "step-based", "lr_schedule": {0: -0.1}}, r"rates from 0 up, got \[-0\.1\]"),
        ({"kind": "step-based", "lr_schedule": {0: 1, 1: math.nan}}, "rates from 0 up"),
        (
            {"kind": "step-based", "lr_schedule": {0: 1}, "warmup_ratio": 0.1},
            "'step-based' has no warm-up",
        ),
    ],
)
def test_what_cannot_be_meant_is_refused(arguments, message):
    with pytest.raises(ConfigError, match=message):
        make_schedule(learning_rate=1.0, total_steps=10, **arguments)


@pytest.mark.parametrize("kind", [t for t in TYPES if t != "step-based"])
def test_the_scheduler_goes_on_from_its_step_alone(kind):
    def fresh():
        optimizer = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=0.3)
        return optimizer, ScheduledLR(optimizer, make_schedule(kind, 0.3, 20, 0.2), 0.3)

    optimizer, scheduler = fresh()
    seen = []
    for step in range(20):
        if step == 7:
            state = scheduler.state_dict()
            assert state == {"step": 7}
        seen.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        scheduler.step()
    optimizer, scheduler = fresh()
    scheduler.load_state_dict(state)
    for step in range(7, 20):
        assert optimizer.param_groups[0]["lr"] == seen[step]
        optimizer.step()
        scheduler.step()


def test_groups_of_the_runs_rate_have_the_schedules_bit_for_bit_and_others_their_share():
    groups = [{"params": [torch.nn.Parameter(torch.zeros(1))]} for _ in range(3)]
    groups[1]["lr"], groups[2]["lr"] = 0.03, 0.0
    optimizer = torch.optim.SGD(groups, lr=0.3)
    schedule = make_schedule("linear-warmup+cosine-decay", 0.3, 20, 0.2)
    scheduler = ScheduledLR(optimizer, schedule, 0.3)
    for step in range(20):
        rates = [group["lr"] for group in optimizer.param_groups]
        assert rates[0] == schedule(step)
        assert rates[1:] == [pytest.approx(0.1 * schedule(step)), 0.0]
        optimizer.step()
        scheduler.step()
