"""Variants of the shipped configs: adapters on the model's own layers, training to continue."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("mujoco")
pytest.importorskip("fluxvla_sim")

from fluxvla_core.checkpoints.checkpoint import Checkpoint
from fluxvla_core.cli.main import main
from fluxvla_core.config.load import load_config
from fluxvla_core.testing.training import checkpoint_differences

from .tiny import SHIPPED, tiny

WITHOUT_ADAPTERS = ("compact", "act", "diffusion")
"""Models that are small, and trained as a whole."""
ADAPTED = [name for name in SHIPPED if name not in WITHOUT_ADAPTERS]


def slow_but_for(names: list[str], quick: str) -> list[object]:
    return [n if n == quick else pytest.param(n, marks=pytest.mark.slow) for n in names]


@pytest.mark.timeout(300)
@pytest.mark.parametrize("family", slow_but_for(ADAPTED, "llava"))
def test_adapters_without_names(family: str, data: Path, tmp_path: Path) -> None:
    pytest.importorskip("peft")
    config = tiny(family, tmp_path, data)
    words = ["run", "--config", str(config), "--section", "runner"]
    words += ["--set", "runner.lora={rank = 2}"]
    assert main([*words, "--work-dir", str(tmp_path / "work")]) == 0
    saved = [tmp_path / "work" / "checkpoints" / f"step-{step:09d}" for step in (2, 4)]
    adapters = [
        Checkpoint.open(place).tensors("adapter/adapter_model.safetensors") for place in saved
    ]
    assert any((one != adapters[1][name]).any() for name, one in adapters[0].items())
    again = tmp_path / "again"
    assert main([*words, "--work-dir", str(again), "--resume", str(saved[0])]) == 0
    assert checkpoint_differences(saved[1], again / "checkpoints" / saved[1].name) == []


@pytest.mark.parametrize("family", WITHOUT_ADAPTERS)
def test_a_family_that_names_no_layers(
    family: str, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("peft")
    words = ["run", "--config", str(tiny(family, tmp_path, data)), "--section", "runner"]
    words += ["--work-dir", str(tmp_path / "work"), "--set", "runner.lora={rank = 2}"]
    assert main(words) == 2
    assert "runner.lora: lora needs 'target_modules'" in capsys.readouterr().err


@pytest.mark.timeout(300)
@pytest.mark.parametrize(
    "family", slow_but_for(["pi0", "pi05", "gr00t_n15", "gr00t_n17", "smolvla"], "gr00t_n15")
)
def test_training_to_continue_a_chunk(family: str, data: Path, tmp_path: Path) -> None:
    config = tiny(family, tmp_path, data)
    tree = load_config(config).tree
    tree["model"]["prefix_conditioning"] = True
    table = tree["train_dataloader"]["dataset"]
    table["transforms"] = [*table["transforms"], {"type": "SamplePrefixLength", "max_delay": 3}]
    tree["runner"]["collator"]["keys"] = [*tree["runner"]["collator"]["keys"], "prefix_len"]
    tree["inference"] |= {"chunk_joining": "rtc", "simulated_latency": 0.2}
    config.write_text("".join(f"{name} = {value!r}\n" for name, value in tree.items()))
    words = ["run", "--config", str(config), "--work-dir", str(tmp_path / "work")]
    assert main([*words, "--section", "runner"]) == 0
    assert main([*words, "--section", "inference", "--task", "1"]) == 0
    (trace,) = (tmp_path / "work").rglob("trace.jsonl")
    rows = [json.loads(line) for line in trace.read_text().splitlines()]
    sent = np.array([row["command"] for row in rows if row.get("event") == "command"])
    assert len(sent) >= 30
    assert np.isfinite(sent).all()
