"""Bad input from the command line: one message that says what, where and what to do."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest
from fluxvla_openvla.normalize import NormalizeOpenVLA

from fluxvla_core.data import PrivateInferenceDataset
from fluxvla_core.errors import ConfigError
from tests.policies.refused import (
    change_json,
    change_rows,
    checked_with_transformers,
    drop,
    import_refused,
    shorten,
    spoil,
)

from . import published

MADE = {"openvla": published.openvla, "oft": published.oft}


@pytest.mark.parametrize("kind", MADE)
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (drop("q99", "max"), "the statistics of 'action' lack q99, max; they have"),
        (spoil(math.nan), "has nan; finite numbers are expected"),
        (shorten("q99"), "dimensions in 'q01', 7 in 'q99'"),
        (spoil("a"), "finite numbers are expected"),
    ],
)
def test_statistics_that_are_wrong(tmp_path, capsys, kind, change, words):
    MADE[kind](tmp_path / "theirs")
    change_rows(tmp_path / "theirs" / "dataset_statistics.json", change)
    assert words in import_refused(tmp_path / "theirs", [], capsys)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda c: c.update(logit_softcap=30.0), "logit_softcap is '30.0', and no setting"),
        (
            lambda c: c["text_config"].update(rope_scaling={"factor": 2.0}),
            "config.json: text_config: rope_scaling is \"{'factor': 2.0}\", and no setting",
        ),
        (
            lambda c: c["text_config"].update(hidden_act="gelu"),
            "text_config.hidden_act is 'gelu'; only 'silu' is built",
        ),
    ],
)
def test_settings_that_change_the_numbers(tmp_path, capsys, change, words):
    published.openvla(tmp_path / "theirs")
    change_json(tmp_path / "theirs" / "config.json", change)
    assert words in import_refused(tmp_path / "theirs", [], capsys)


def test_no_camera_at_all():
    table = {"type": "ResizeOpenVLAImages", "size": 28}
    prepare = PrivateInferenceDataset([], [table, NormalizeOpenVLA(states=False)])
    with pytest.raises(ConfigError, match="ResizeOpenVLAImages needs 'images'") as error:
        prepare({"qpos": [0.0] * 7, "task_description": "go"})
    assert error.value.cause == "img_keys names no camera"


@pytest.mark.parametrize("number", [math.nan, -math.inf])
def test_statistics_of_a_checkpoint_that_are_no_numbers(number):
    row = {**published.row(7), "q99": [number] + [1.0] * 6}
    with pytest.raises(ConfigError, match="'q99' of the statistics of 'action' is"):
        NormalizeOpenVLA(states=False).denormalizer({"private": {"action": row}})


@pytest.mark.parametrize("name", ["openvla_libero", "openvla_oft_aloha"])
def test_another_version_of_transformers(tmp_path, name):
    config = Path(__file__).parents[3] / "configs" / f"{name}.py"
    said = checked_with_transformers("4.40.0", config, tmp_path)
    assert re.search(r"openvla_\w+\.py:\d+: model\.type: fluxvla-openvla", said)
    assert "needs transformers>=5,<6, but 4.40.0 is installed" in said
