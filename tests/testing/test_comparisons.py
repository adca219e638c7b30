"""``assert_trained_alike`` passes two equal trainings and names what differs of others."""

from __future__ import annotations

import pytest

from fluxvla_core.testing.training import assert_trained_alike, losses, tiny_config, train


@pytest.fixture
def learn(tmp_path):
    def run(name, **settings):
        kept = {"max_steps": 4, "save_iter_interval": 2, "max_keep_ckpts": 0}
        config = tiny_config({"type": "OneProcessRunner", **kept, **settings})
        train({"config": config, "work_dir": tmp_path / name})
        return tmp_path / name

    return run


def test_equal_trainings_pass_and_others_do_not(learn):
    one, same, other = learn("one"), learn("same"), learn("other", learning_rate=2e-2)
    assert len(losses(one)) == 4
    assert_trained_alike(same, one, steps=4)
    with pytest.raises(AssertionError, match="4 / 4 steps, not 20"):
        assert_trained_alike(same, one)
    with pytest.raises(AssertionError, match=r"loss of step \d: "):
        assert_trained_alike(other, one, steps=4)
    with pytest.raises(AssertionError, match=r" differs by "):
        assert_trained_alike(other, one, steps=4, rtol=10.0)


def test_trainings_that_change_nothing_are_not_compared(learn):
    still = learn("still", learning_rate=1e-12)
    with pytest.raises(AssertionError, match="no training"):
        assert_trained_alike(still, still, steps=4)
