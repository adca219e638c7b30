"""A checkpoint of FluxVLA 0.1.0 loads, and training goes on from it to the recorded losses."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from fluxvla_core.checkpoints.checkpoint import Checkpoint, folders
from fluxvla_core.testing.training import TinyVLA, train
from fluxvla_core.training.weights import load_for_inference

SAVED = Path(__file__).parents[1] / "fixtures" / "checkpoint-0.1.0"
"""Step 4 of a run of 8 steps, and the records of all 8; made by 0.1.0 on one process."""


def test_it_is_whole():
    (folder,) = folders(SAVED)
    checkpoint = Checkpoint.open(folder)
    checkpoint.verify()
    assert checkpoint.step == 4


def test_training_goes_on_to_the_recorded_losses(tmp_path):
    shutil.copytree(SAVED, tmp_path, dirs_exist_ok=True)
    config = Checkpoint.open(tmp_path).config()
    train({"config": config, "work_dir": str(tmp_path), "resume": "auto"})
    found, recorded = (
        [json.loads(line) for line in (place / "metrics.jsonl").read_text().splitlines()]
        for place in (tmp_path, SAVED)
    )
    assert [record["step"] for record in found] == list(range(1, 9))
    # Machines may add in another order: equal but for rounding.
    for now, then in zip(found, recorded, strict=True):
        assert {key: now[key] for key in then} == pytest.approx(then, rel=1e-5)


def test_its_weights_act():
    model = TinyVLA(assorted=True, centred=True)
    load_for_inference(model, Checkpoint.open(SAVED))
    assert int(model.batches) == 4
