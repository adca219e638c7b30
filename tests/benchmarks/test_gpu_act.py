"""The benchmark of acting on GPUs, tiny and on the CPU; its roofline at full size."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from benchmarks import gpu_act
from benchmarks._gpu_act_models import CASES

TINY = ["--size", "tiny", "--device", "cpu", "--calls", "2", "--warmup", "0"]


def test_the_tiny_size_runs_on_the_cpu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without translating code, which takes a minute; the graph needs a GPU, and says so."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(gpu_act, "EXECUTIONS", ("eager", "graph"))
    out = tmp_path / "found.json"
    assert gpu_act.main([*TINY, "--out", str(out)]) == 0
    found = json.loads(out.read_text(encoding="utf-8"))
    assert set(found["cases"]) == {"pi05, 2 cameras", "pi05, 3 cameras", "gr00t, 2 cameras"}
    for case in found["cases"].values():
        eager, graph = case["modes"]["eager"], case["modes"]["graph"]
        for part in ("transfer", "prefix", "denoise", "total"):
            assert 0 <= eager[part]["p50"] <= eager[part]["p99"]
        assert "needs a GPU" in graph["not_run"]
        assert case["floor_ms"]["prefix"] > 0
        assert case["inputs_sha256"] != case["answers_sha256"]
    two, three = (found["cases"][f"pi05, {n} cameras"]["gflops"]["prefix"] for n in (2, 3))
    assert two < three
    assert "goals_met" not in found
    assert found["published"][0]["ms"] == 17.58


def test_a_roofline_needs_no_gpu() -> None:
    """Against the sizes: Gemma-2B's and So400m's weights by tokens, the expert's by steps."""
    found = gpu_act.roofline()["pi05, 2 cameras"]
    vision = 2 * 2 * 256 * (27 * (4 * 1152**2 + 2 * 1152 * 4304))
    # The last layer of the language model gives keys and values alone.
    layer = 2 * 2048 * 2048 + 2 * 2048 * 256 + 3 * 2048 * 16384
    text = 2 * (512 + 200) * 17 * layer
    least, most = (vision + text) / 1e9, 1.1 * (vision + text) / 1e9
    assert least < found["gflops"]["prefix"] < most
    expert = 18 * (2 * 1024 * 2048 + 2 * 1024 * 256 + 3 * 1024 * 4096)
    assert found["gigabytes"]["denoise"] > 10 * 2 * expert / 1e9
    h200 = found["floor_ms"]["H200"]
    assert h200["prefix"] > least / 989.5
    assert h200["denoise"] > 10 * 2 * expert / 4800e9 * 1e3
    assert found["floor_ms"]["A100"]["prefix"] > h200["prefix"]


def test_without_a_gpu_that_is_said(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert gpu_act.main(["--calls", "2"]) == 2
    assert capsys.readouterr().out.startswith("gpu_act: no GPU: not measured")
    with pytest.raises(SystemExit, match="2"):
        gpu_act.main(["--device", "cpu"])
    assert "on a CPU only the tiny size" in capsys.readouterr().err


def test_goals_are_an_h200_s() -> None:
    def case(eager: float, graph: float) -> dict[str, Any]:
        return {"modes": {n: {"total": {"p50": ms}} for n, ms in
                          (("eager", eager), ("graph", graph))}}  # fmt: skip

    found = {case_.name: case(90.0, 18.0 if case_.cameras == 2 else 21.0) for case_ in CASES}
    met = gpu_act.judged(found, "NVIDIA H200")["goals_met"]
    assert met == {
        "pi05, 2 cameras: below 20 ms": True,
        "pi05, 2 cameras: 5 times eager": True,
        "pi05, 3 cameras: below 20 ms": False,
        "pi05, 3 cameras: 5 times eager": False,
        "gr00t, 2 cameras: below 15 ms": False,
    }
    assert gpu_act.judged(found, "NVIDIA A100") == {}
