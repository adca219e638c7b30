"""An unknown key that another framework has is answered with the key that it is called here."""

from __future__ import annotations

import dataclasses
import inspect

import pytest

from fluxvla_core.config.check import examine
from fluxvla_core.config.load import load_config
from fluxvla_core.config.resolve import LOADER_KEYS
from fluxvla_core.config.similar_keys import _OTHER_NAMES, similar_key
from fluxvla_core.data import ParquetDataset
from fluxvla_core.evaluation.options import EvalOptions
from fluxvla_core.robot.options import InferenceOptions
from fluxvla_core.training.options import TrainOptions

from .conftest import Write
from .toy import GOOD, _toy, findings

__all__ = ["_toy"]


@pytest.mark.parametrize(
    ("key", "hint"),
    [
        ("warmup_steps=500", "'warmup_ratio', the share of the run's steps, from 0 to 1? (defined"),
        ("num_train_epochs=3", "'max_epochs'? (set at"),
        ("lr=1e-4", "'learning_rate'? (defined at"),
    ],
)
def test_the_check_of_a_config_names_our_key(write: Write, key: str, hint: str) -> None:
    text = findings(GOOD.replace("max_epochs=1", f"max_epochs=1, {key}"), write)
    name = key.partition("=")[0]
    assert f"runner.{name}: ToyTrainRunner takes no {name!r}; did you mean {hint}" in text


@pytest.mark.parametrize(
    ("key", "ours"),
    [
        ("warmup_steps", "warmup_ratio"),
        ("gradient_accumulation_steps", "grad_accumulation_steps"),
        ("gradient_clip_val", "max_grad_norm"),
        ("bf16", "enable_mixed_precision_training"),
        ("save_steps", "save_iter_interval"),
        ("save_total_limit", "max_keep_ckpts"),
        ("logging_steps", "log_iter_interval"),
        ("use_ema", "ema_decay"),
        ("report_to", "metric"),
        ("batch_size", "train_dataloader.per_device_batch_size"),
    ],
)
def test_keys_of_other_frameworks_in_a_train_runner(write: Write, key: str, ours: str) -> None:
    pytest.importorskip("fluxvla_ddp")
    section = f"runner = dict(type='DDPTrainRunner', learning_rate=1, collator=dict(), {key}=1)\n"
    found = examine(load_config(write("c.py", section))).problems
    (problem,) = (each for each in found if each.key == f"runner.{key}")
    assert f"did you mean {ours}" in problem.what.replace("'", "")


def test_a_loader_s_key_of_another_framework(write: Write) -> None:
    text = findings(GOOD.replace("per_device_batch_size", "batch_size"), write)
    assert text.endswith("train_dataloader.batch_size: unknown key; did you mean "
                         "'per_device_batch_size'?")  # fmt: skip


def test_only_keys_that_there_are_are_named() -> None:
    assert similar_key("num_workers", LOADER_KEYS) == "per_device_num_workers"
    assert similar_key("num_workers", {"workers", "episodes"}) == "workers"
    assert similar_key("bf16", {"workers", "episodes"}) is None
    ours = {*LOADER_KEYS, *inspect.signature(ParquetDataset).parameters}
    for options in (EvalOptions, InferenceOptions, TrainOptions):
        ours |= {field.name for field in dataclasses.fields(options)}
    assert set(_OTHER_NAMES) <= ours
