"""A dataset that version 0.1.0 wrote still gives the same samples, in the same order."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fluxvla_core.build import build_dataset_from_cfg
from fluxvla_core.cli.main import main
from fluxvla_core.data.sampler import StepPlan, sample_rng

pytest.importorskip("av")
pytest.importorskip("pyarrow")

ROOT = Path(__file__).parents[1] / "fixtures" / "dataset-0.1.0"
EXPECTED = json.loads(ROOT.with_name(f"{ROOT.name}.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def dataset() -> Any:
    return build_dataset_from_cfg(
        {
            "type": "ParquetDataset",
            "data_root_path": str(ROOT),
            "transforms": [],
            "img_keys": ["top"],
            "action_window_size": 4,
            "relative_actions": True,
        }
    )


@pytest.fixture(scope="module")
def samples(dataset: Any) -> list[dict[str, Any]]:
    return [dataset.get_sample(index, 0) for index in range(len(dataset))]


def test_its_metadata_is_the_same(dataset: Any) -> None:
    assert len(dataset) == EXPECTED["samples"]
    assert dataset.fps == EXPECTED["fps"]
    assert list(dataset.tasks) == EXPECTED["tasks"]
    assert dataset.episode_ends.tolist() == EXPECTED["episode_ends"]
    assert dataset.embodiment.name == "arm"


@pytest.mark.parametrize("key", sorted(EXPECTED["sha256"]))
def test_numbers_are_the_same_to_the_bit(samples: list[dict[str, Any]], key: str) -> None:
    joined = b"".join(np.ascontiguousarray(sample[key]).tobytes() for sample in samples)
    assert hashlib.sha256(joined).hexdigest() == EXPECTED["sha256"][key]


def test_images_and_places_are_the_same(samples: list[dict[str, Any]]) -> None:
    shapes = {sample["images"].shape for sample in samples}
    assert shapes == {tuple(EXPECTED["image_shape"])}
    # Versions of FFmpeg may round colours differently.
    means = [float(sample["images"].mean()) for sample in samples]
    assert means == pytest.approx(EXPECTED["image_means"], abs=0.5)
    infos = [sample["info"] for sample in samples]
    assert [[i["episode_index"], i["frame_index"]] for i in infos] == EXPECTED["info"]


def test_statistics_are_the_same(dataset: Any) -> None:
    found = dataset.statistics["private"]
    for part, expected in EXPECTED["statistics"]["private"].items():
        assert found[part].keys() == expected.keys()
        for name, value in expected.items():
            np.testing.assert_allclose(found[part][name], value, rtol=1e-12, err_msg=name)


def test_order_and_noise_are_the_same() -> None:
    plan = StepPlan(EXPECTED["samples"], 5, seed=7)
    assert [plan.order(epoch).tolist() for epoch in range(2)] == EXPECTED["order"]
    assert sample_rng(7, 1, 2).standard_normal(3).tolist() == EXPECTED["noise"]


def test_it_is_valid(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["data", "validate", str(ROOT)]) == 0
    assert "2 episodes, 15 frames" in capsys.readouterr().out
