"""Settings that cannot be meant are refused, all at once, with their places."""

from __future__ import annotations

import pytest

from fluxvla_core import BaseTrainRunner
from fluxvla_core.build import RunContext, build_runner_from_cfg
from fluxvla_core.errors import ConfigError
from fluxvla_core.testing.training import tiny_config


def build(config, **context):
    return build_runner_from_cfg(
        config["runner"], RunContext(config=config, section="runner", **context)
    )


def runner(**settings):
    return build(tiny_config({"type": "OneProcessRunner", "max_steps": 3, **settings}))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"max_epochs": 2}, "max_epochs: give max_epochs or max_steps, got both"),
        ({"max_steps": None}, "max_epochs: give max_epochs or max_steps, got none"),
        ({"max_steps": 0}, "max_steps: must be a whole number above 0, got 0"),
        ({"max_steps": True}, "max_steps: must be a whole number above 0, got True"),
        ({"save_iter_interval": 0}, "save_iter_interval: must be a whole number above 0"),
        ({"save_epoch_interval": 1.5}, "save_epoch_interval: must be a whole number above 0"),
        ({"grad_accumulation_steps": "2"}, "must be a whole number above 0, got '2'"),
        ({"log_iter_interval": 0}, "log_iter_interval: must be a whole number above 0, got 0"),
        ({"max_keep_ckpts": -1}, r"max_keep_ckpts: must be 0 \(keep all\) or more, got -1"),
        ({"seed": -1}, "seed: must be a whole number from 0 up, got -1"),
        ({"learning_rate": 0}, "learning_rate: must be a positive number, got 0"),
        ({"learning_rate": float("nan")}, "learning_rate: must be a positive number, got nan"),
        ({"weight_decay": -0.1}, "weight_decay: must be a number from 0 up, got -0.1"),
        ({"max_grad_norm": 0}, "max_grad_norm: must be positive, or None for no clipping, got 0"),
        ({"ema_decay": 1.0}, "ema_decay: must be above 0 and below 1, or None, got 1.0"),
        ({"sampler": "weighted"}, "sampler: must be None or 'distributed', got 'weighted'"),
        ({"mixed_precision_dtype": "fp16"}, r"must be in \('bf16',\), got 'fp16'"),
        ({"enable_mixed_precision_training": 1}, "must be true or false, got 1"),
        ({"enable_gradient_checkpointing": "no"}, "must be true or false, got 'no'"),
        ({"lr_scheduler_type": "cosine"}, "lr_scheduler_type: unknown lr_scheduler_type 'cosine'"),
        ({"lr_schedule": {0: 1e-4}}, "lr_schedule belongs to lr_scheduler_type 'step-based'"),
    ],
)
def test_one_setting(settings, message):
    with pytest.raises(ConfigError, match=message) as caught:
        runner(**settings)
    assert caught.value.exit_code == 2


def test_all_findings_at_once_with_their_places():
    config = tiny_config({"type": "OneProcessRunner", "max_steps": 0, "seed": -1})
    with pytest.raises(ConfigError) as caught:
        build(config, origins={"runner.max_steps": "c.py:4", "runner.seed": "c.py:9"})
    assert str(caught.value) == (
        "2 problems in the config:\n"
        "  c.py:4: max_steps: must be a whole number above 0, got 0\n"
        "  c.py:9: seed: must be a whole number from 0 up, got -1"
    )


def test_an_unknown_key_is_refused():
    """T12 of upstream's bugs: a misspelt key gave a constant learning rate."""
    with pytest.raises(ConfigError, match="got an unexpected keyword argument 'lr_scheduler'"):
        runner(lr_scheduler="linear-warmup+cosine-decay")


def test_step_based_runs_need_no_epochs():
    """T5 of upstream's bugs: a default of max_epochs made max_steps unusable."""
    assert runner(max_steps=5).max_epochs is None


def test_train_dataloader_is_needed_and_checked():
    config = tiny_config({"type": "OneProcessRunner", "max_steps": 3})
    loader = config.pop("train_dataloader")
    with pytest.raises(ConfigError) as caught:
        build(config, config_file="my.py")
    assert str(caught.value) == (
        "my.py: the config has no table 'train_dataloader', which training needs\n"
        "  next: train_dataloader = dict(per_device_batch_size=…, dataset=dict(type=…))"
    )
    config["train_dataloader"] = {**loader, "per_device_num_worker": 2, "x": 1}
    with pytest.raises(ConfigError) as caught:
        build(config, origins={"train_dataloader.per_device_num_worker": "my.py:3"})
    assert str(caught.value) == (
        "2 problems in the config:\n"
        "  my.py:3: train_dataloader.per_device_num_worker: unknown key; did you mean "
        "'per_device_num_workers'?\n"
        "  train_dataloader.x: unknown key; known: per_device_batch_size, "
        "per_device_num_workers, shuffle_episodes, dataset"
    )
    config["train_dataloader"] = {"per_device_num_workers": -1, "shuffle_episodes": 1}
    with pytest.raises(ConfigError) as caught:
        build(config)
    assert "per_device_batch_size: must be a whole number above 0, got None" in str(caught.value)
    assert "per_device_num_workers: must be a whole number from 0 up, got -1" in str(caught.value)
    assert "shuffle_episodes: must be a whole number above 1, or None, got 1" in str(caught.value)


def test_no_model():
    config = tiny_config({"type": "OneProcessRunner", "max_steps": 3})
    del config["model"]
    with pytest.raises(ConfigError, match=r"my\.py: the config has no 'model' to train"):
        build(config, config_file="my.py").run_setup(10)


def test_an_option_that_there_is_not_is_refused_in_python_too():
    with pytest.raises(ConfigError, match=r"BaseTrainRunner: got an unexpected .* 'lr'"):
        BaseTrainRunner(learning_rate=1e-3, collator=len, lr=1.0)
