"""A run without a policy of its own takes the newest checkpoint of its work dir."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("torch")

from fluxvla_core.errors import ConfigError
from tests.policies.saved import ARM, models, save

__all__ = ["models"]  # a fixture


def test_the_runner_loads_the_work_dirs_checkpoint(bench, make_arm):
    save(bench.work_dir)
    bench.arm = make_arm(embodiment=ARM)
    bench.arm.state = np.zeros(2)
    bench.policy = None

    result = bench.run(max_publish_step=20, execute_horizon=2, safety={"jump_s": 50, "excess": 50})

    assert result["outcome"] == "max_steps"
    summary = bench.episode()
    assert set(summary["timings"]) == {
        "receipt", "sync", "policy", "preprocess", "inference", "postprocess", "late", "send",
    }  # fmt: skip
    assert any("step-000000100" in line for line in bench.notes.lines)


@pytest.mark.parametrize("joining", ["rtc", {"method": "rtc", "window": 3}])
def test_a_model_that_continues_no_chunks_is_refused_before_it_is_loaded(
    bench, make_arm, joining, monkeypatch
):
    save(bench.work_dir)
    bench.arm = make_arm(embodiment=ARM)
    bench.policy = None
    monkeypatch.setattr("fluxvla_core.policies.loading.load_policy", pytest.fail)

    with pytest.raises(ConfigError) as caught:
        bench.run(chunk_joining=joining)

    assert str(caught.value).splitlines()[0] == (
        f"chunk_joining is {joining!r}, and LittleVLA cannot continue a chunk: its "
        "predict_action() takes no prev_actions, which models of flow matching take"
    )
    assert not bench.arm.calls
