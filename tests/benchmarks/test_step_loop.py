"""What a train runner's loop costs by itself, in a model so small that it shows."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks import step_loop
from fluxvla_core.testing.training import run_ranks

pytest.importorskip("torch")


@pytest.mark.slow
def test_the_loop_costs_less_than_a_step_of_one_layer_by_hand(tmp_path: Path) -> None:
    """As shares of a step, which are alike on slow machines; processor time, as others work too.

    Recorded are 0.25 to 0.5 of such a step. The 0.4 ms and more that the loop once cost are more
    than a whole one.
    """
    kind, ranks, model = step_loop.CASES[step_loop.ONE_LAYER]
    out = tmp_path / "taken.json"
    assert run_ranks(ranks, step_loop.measure, kind, ranks, model, 21, 100, out) == [0]
    found = step_loop.summarise(json.loads(out.read_text()), step_loop.ONE_LAYER)
    assert 0.0 < found["own_cpu_ms"] < 0.8 * found["by_hand_cpu_ms"], found
