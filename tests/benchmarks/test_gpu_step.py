"""The benchmark for GPUs, tiny and on the CPU: both sides train the same; what is made of it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from benchmarks import _results, gpu_step
from benchmarks._gpu_step_sides import HAND, OURS, Samples, Setup, our_config

TINY = ["--size", "tiny", "--device", "cpu"]
SHORT = ["--batch", "2", "--workers", "0", "--warm-up", "1", "--steps", "2", "--blocks", "1"]


def test_both_sides_train_the_same_way_on_the_cpu(tmp_path: Path) -> None:
    out = tmp_path / "found.json"
    words = [*TINY, *SHORT, "--rounds", "1", "--peak-tflops", "0.01", "--profile"]
    assert gpu_step.main([*words, "--out", str(out)]) == 0
    found = json.loads(out.read_text(encoding="utf-8"))
    ours, hand = found["sides"][OURS], found["sides"][HAND]
    # The same weights and batches, in bf16 with the order of sums free: three steps.
    assert ours["last_loss"] == pytest.approx(hand["last_loss"], rel=0.02)
    assert ours["samples_per_s"] == pytest.approx(2 / ours["step_s"], rel=1e-3)
    ratio = ours["samples_per_s"] / hand["samples_per_s"]
    assert found["rate_of_runner_to_by_hand"] == pytest.approx(ratio, rel=1e-3)
    flops = found["tflop_per_sample"] * 1e12 * 2
    for side in (ours, hand):
        assert side["mfu"] == pytest.approx(flops / side["step_s"] / 1e10, rel=1e-3)
        assert side["peak_memory_gb"] > 0
    assert found["versions"]["torch"] == torch.__version__
    assert "goals" not in found
    table = out.with_suffix(".profile.txt").read_text(encoding="utf-8")
    assert "Self CPU %" in table
    assert "aten::mm" in table


@pytest.mark.parametrize("family", ["pi05", "gr00t"])
def test_models_of_plugins_train_the_same_way(family: str, tmp_path: Path) -> None:
    pytest.importorskip({"pi05": "fluxvla_pi", "gr00t": "fluxvla_gr00t"}[family])
    out = tmp_path / "found.json"
    words = [*TINY, *SHORT, "--rounds", "1", "--family", family, "--peak-tflops", "0.01"]
    assert gpu_step.main([*words, "--out", str(out)]) == 0
    found = json.loads(out.read_text(encoding="utf-8"))
    ours, hand = found["sides"][OURS], found["sides"][HAND]
    assert found["family"] == family
    # GR00T looks for the places of images in each prompt: nothing can be counted beforehand.
    assert (found["tflop_per_sample"] is None) == (family == "gr00t")
    assert ours["last_loss"] == pytest.approx(hand["last_loss"], rel=0.02)


@pytest.fixture
def no_gpu(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    monkeypatch.setattr(_results, "FOLDER", tmp_path)
    return tmp_path


@pytest.mark.parametrize(("words", "code"), [([], 0), (["--batch", "8"], 2)])
def test_without_a_gpu_that_is_said(
    words: list[str], code: int, no_gpu: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert gpu_step.main(words) == code
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith("gpu_step: no GPU: not measured")
    assert list(no_gpu.iterdir()) == []


def test_fewer_gpus_than_processes_is_said(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert gpu_step.main(["--nproc", "4"]) == 2
    assert "2 GPUs for 4 processes: not measured" in capsys.readouterr().out


def test_the_full_size_is_refused_on_a_cpu(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        gpu_step.main(["--device", "cpu"])
    assert "on a CPU only the tiny size" in capsys.readouterr().err


def found(*seconds: float, **more: Any) -> dict[str, Any]:
    return {"step_s": list(seconds), "peak_bytes": 5e10, "last_loss": 1.0, **more}


def test_figures_and_goals() -> None:
    setup = Setup(batch=10, nproc=2)
    counted = {"device": "NVIDIA H200", "flops": 1e14, "peak_flops": 1e15}
    ours = [found(0.2, 0.4, mfu=[0.5, 0.25], **counted), found(0.2, 0.2, mfu=[0.5, 0.5], **counted)]
    hand = [found(0.3, 0.3), found(0.25, 0.25)]
    summary = gpu_step.summarise({OURS: ours, HAND: hand}, setup)
    assert summary["sides"][OURS]["samples_per_s"] == pytest.approx(100.0)
    assert summary["sides"][OURS]["mfu"] == 0.5
    assert summary["sides"][HAND]["mfu"] == pytest.approx(1e14 / 0.275 / 1e15)
    assert summary["sides"][HAND]["peak_memory_gb"] == 50.0
    # Of rounds beside each other: 0.3 to 0.3, and 0.25 to 0.2.
    assert summary["rate_of_runner_to_by_hand"] == pytest.approx(1.125)
    assert summary["tflop_per_sample"] == 10.0
    assert summary["goals_met"] == {"samples_per_s_of_a_gpu": True, "mfu": True}
    slow = [found(0.5, mfu=[0.2], **counted)]
    met = gpu_step.summarise({OURS: slow, HAND: [found(0.5)]}, setup)["goals_met"]
    assert met == {"samples_per_s_of_a_gpu": False, "mfu": False}
    other = [found(0.1, device="NVIDIA A100")]
    alone = gpu_step.summarise({OURS: other, HAND: [found(0.1)]}, setup)
    assert "goals" not in alone
    assert alone["sides"][OURS]["mfu"] is None


def test_prompts_are_padded_at_the_end_or_whole() -> None:
    samples = Samples(Setup(size="tiny"))
    masks = samples.data["lang_masks"]
    assert masks.shape[1] == 10
    assert (masks[:, :-1] >= masks[:, 1:]).all()
    assert masks.sum(1).min() >= 3
    assert samples.get_sample(0, 0)["images"].dtype == "uint8"
    assert "lang_masks" not in Samples(Setup(size="tiny", whole_prompts=True)).data


def test_the_runner_is_told_what_the_benchmark_is() -> None:
    table = our_config(Setup(recompute=True, strategy="no-shard", peak_tflops=3.0))["runner"]
    assert table["enable_mixed_precision_training"] is True
    assert table["enable_gradient_checkpointing"] is True
    assert table["compile_blocks"] is False
    assert (table["sharding_strategy"], table["peak_tflops"]) == ("no-shard", 3.0)
