"""Statistics and transforms that do not fit are told before weights are read, with the place."""

from __future__ import annotations

from math import inf, nan
from typing import Any

import numpy as np
import pytest

from fluxvla_core.data import PrivateInferenceDataset
from fluxvla_core.data.inference_dataset import try_preparation
from fluxvla_core.data.statistics import check_statistics
from fluxvla_core.errors import CheckpointError, ConfigError

ROWS = {"mean": [0.0, 1.0], "std": [1.0, 2.0]}


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ({**ROWS, "std": [1.0, nan]}, "the statistics' 'std' of 'action' has nan"),
        ({**ROWS, "mean": [inf, 1.0]}, "the statistics' 'mean' of 'action' has inf"),
        ({**ROWS, "max": [[1.0, nan]]}, "the statistics' 'max' of 'action' has nan"),
        ({**ROWS, "std": [1.0]}, "'action' have 2 dimensions in 'mean', 1 in 'std'"),
        ({**ROWS, "std": ["a", "b"]}, r"'std' of 'action' is \['a', 'b'\]; finite numbers"),
        ({**ROWS, "std": []}, r"'std' of 'action' is \[\]; finite numbers"),
    ],
)
def test_statistics_that_are_no_numbers_of_one_width(entry: dict[str, Any], words: str) -> None:
    with pytest.raises(CheckpointError, match=words) as error:
        check_statistics({"private": {"proprio": ROWS, "action": entry}}, "/ckpt")
    assert error.value.where == "/ckpt"


def test_other_entries_of_statistics_are_left_alone() -> None:
    action = {**ROWS, "mask": [True, False], "count": 7, "min": [[0.0, 0.0], [1.0, 1.0]]}
    check_statistics({"private": {"proprio": {}, "action": action, "num_transitions": 3}}, "/ckpt")


def prepared(stats: dict[str, Any], **normalize: Any) -> tuple[Any, Any]:
    table = {"type": "NormalizeStatesAndActions", **normalize}
    prepare = PrivateInferenceDataset(["front"], [table], {"private": stats})
    return prepare, prepare.pipeline.transforms[0].denormalizer({"private": stats})


@pytest.mark.parametrize(
    ("stats", "states", "words"),
    [
        ({"proprio": ROWS, "action": ROWS}, 3, r"states have shape \(3,\).*describe 2 dimensions"),
        ({"proprio": ROWS}, 2, "no entry 'action'; they have proprio"),
        ({"proprio": ROWS, "action": {"mean": [0.0, 1.0]}}, 2, "have no 'std'; they have mean"),
    ],
)
def test_what_does_not_fit_names_the_checkpoint(
    stats: dict[str, Any], states: int, words: str
) -> None:
    prepare, undo = prepared(stats)
    with pytest.raises(ConfigError, match=words) as error:
        try_preparation(prepare, undo, {"front": (4, 6)}, states, (5, 2), "/ckpt")
    assert error.value.where == "/ckpt"


def test_what_fits_is_asked_once_with_blank_images() -> None:
    prepare, undo = prepared({"proprio": ROWS, "action": ROWS})
    asked: list[Any] = []

    def look(observation: Any) -> Any:
        asked.append(observation)
        return prepare(observation)

    try_preparation(look, undo, {"front": (4, 6)}, 2, (5, 2), "/ckpt")
    (observation,) = asked
    assert observation["images"]["front"].shape == (4, 6, 3)
    assert not np.any(observation["images"]["front"])
