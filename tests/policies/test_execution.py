"""How a policy's model computes: parts and clocks, recordings, precision, quantisation."""

from __future__ import annotations

import importlib.util
from typing import Any

import numpy as np
import pytest

from fluxvla_core.contracts.training import VLA
from fluxvla_core.errors import ConfigError
from fluxvla_core.spec import EmbodimentSpec, Joint

torch = pytest.importorskip("torch")

from fluxvla_core.policies import cuda_graph, execution  # noqa: E402
from fluxvla_core.policies.execution import (  # noqa: E402
    KEPT_SHAPES,
    Eager,
    Graphed,
    HostClock,
    Transfer,
)
from fluxvla_core.policies.inference_weights import (  # noqa: E402
    check_quantization,
    quantize,
    ready,
    store_in_bf16,
)
from fluxvla_core.policies.local import LocalPolicy  # noqa: E402
from fluxvla_core.testing.execution import Refused, Tape, check_capturable  # noqa: E402

ARM = EmbodimentSpec("arm", tuple(Joint(n, "rad", -1.0, 1.0, 1.0, 1.0) for n in "ab"), (), 50.0)


class Steps(VLA, torch.nn.Module):
    """Three steps of a small network; its words are looked up and predicted by one matrix."""

    action_shape = (4, 2)
    observe_is_capturable = True

    def __init__(self, width: int = 8) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.words = torch.nn.Embedding(5, width)
        self.tied = torch.nn.Linear(width, 5, bias=False)
        self.tied.weight = self.words.weight
        self.inner = torch.nn.Linear(2 + 2, width)
        self.out = torch.nn.Linear(width, 2)
        self.observed = 0

    def observe(self, states: Any) -> dict[str, Any]:
        self.observed += 1
        return {"states": states[:, None] * 2}

    def denoise(self, seen: Any, noise: Any, tables: Any) -> Any:
        x = noise
        for step in range(3):
            joined = torch.cat([x, seen["states"].expand_as(x)], dim=-1)
            x = x - torch.tanh(self.out(self.inner(joined).relu())) * tables["share"][step]
        return x

    def step_tables(self) -> dict[str, Any]:
        return {"share": self.out.bias.sum().abs() + torch.arange(3) / 3}

    def predict_action(
        self, states: Any, noise: Any, prev_actions: Any = None, prefix_weights: Any = None,
        prefix_len: Any = None, max_guidance_weight: Any = None,
    ) -> Any:  # fmt: skip
        found = self.denoise(self.observe(states), noise, self.step_tables())
        return found if prev_actions is None else found + 100

    def fsdp_units(self) -> list[Any]:
        return [self.inner]

    def exact_modules(self) -> list[Any]:
        return [self.out]


class OneGo(torch.nn.Module):
    action_shape = (4, 2)

    def predict_action(self, states: Any, noise: Any) -> Any:
        return noise + states[:, None]


def batch(seed: int, rows: int = 1) -> dict[str, Any]:
    generator = torch.Generator().manual_seed(seed)
    return {
        "states": torch.randn(rows, 2, generator=generator),
        "noise": torch.randn(rows, 4, 2, generator=generator),
    }


def policy(model: Any, **settings: Any) -> LocalPolicy:
    def prepare(observation: Any) -> dict[str, Any]:
        return {"states": torch.from_numpy(np.asarray(observation["qpos"], np.float32))[None]}

    def denormalize(found: Any) -> Any:
        return found["action"][0].astype(np.float64)

    return LocalPolicy(model, prepare, denormalize, ARM, (), 10.0, 4, **settings)


OBSERVATION: Any = {"qpos": np.array([0.3, -0.2]), "images": {}, "task_description": ""}


# -- parts -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("model", "parts"),
    [(Steps, ["transfer", "prefix", "denoise"]), (OneGo, ["transfer", "forward"])],
)
def test_a_policy_says_how_long_each_part_took(model: Any, parts: list[str]) -> None:
    asked = policy(model().eval())
    asked.reset(0)
    asked.predict_action(OBSERVATION)
    assert list(asked.parts) == parts
    assert all(seconds >= 0 for seconds in asked.parts.values())
    assert sum(asked.parts.values()) <= asked.stages["inference"]


def test_weights_may_change_between_eager_answers() -> None:
    model = Steps().eval()
    asked = policy(model)
    asked.reset(0)
    first = asked.predict_action(OBSERVATION)
    with torch.no_grad():
        model.out.bias += 1
    asked.reset(0)
    assert np.abs(asked.predict_action(OBSERVATION) - first).max() > 0.1


def test_a_model_in_place_of_another_is_executed_alike() -> None:
    asked = policy(Steps().eval(), execution="compiled")
    assert "forward" in asked.model.inner.__dict__
    other = Steps().eval()
    asked.model = other
    assert "forward" in other.inner.__dict__
    once = other.inner.__dict__["forward"]
    asked.execute("compiled")
    assert other.inner.__dict__["forward"] is once


# -- recordings ------------------------------------------------------------------------------


def test_a_recording_is_replayed_for_each_batch() -> None:
    model = Steps().eval()
    made = Graphed(model, Tape)
    with torch.inference_mode():
        expected = [model.predict_action(**batch(seed)) for seed in range(3)]
        model.observed = 0
        for seed in (0, 1, 2, 0):
            found = made.answer(batch(seed), HostClock())
            torch.testing.assert_close(found, expected[seed])
    assert model.observed == 1


def test_shapes_are_recorded_one_by_one_and_the_oldest_is_forgotten() -> None:
    model = Steps().eval()
    made = Graphed(model, Tape)
    with torch.inference_mode():
        for rows in (*range(1, KEPT_SHAPES + 2), KEPT_SHAPES + 1):
            expected = model.predict_action(**batch(0, rows))
            torch.testing.assert_close(made.answer(batch(0, rows), HostClock()), expected)
        model.observed = 0
        made.answer(batch(1, KEPT_SHAPES), HostClock())
        assert model.observed == 0
        made.answer(batch(1, 1), HostClock())
        assert model.observed == 1


def test_what_may_not_be_captured_runs_each_time() -> None:
    model = Steps().eval()
    model.observe_is_capturable = False
    made = Graphed(model, Tape)
    with torch.inference_mode():
        expected = [model.predict_action(**batch(seed)) for seed in range(2)]
        made.answer(batch(0), HostClock())
        model.observed = 0
        for seed in (0, 1):
            torch.testing.assert_close(made.answer(batch(seed), HostClock()), expected[seed])
    assert model.observed == 2


def test_a_chunk_that_continues_another_is_not_replayed() -> None:
    model = Steps().eval()
    made = Graphed(model, Tape)
    more = {"prev_actions": torch.zeros(1, 4, 2)}
    with torch.inference_mode():
        plain = made.answer(batch(0), HostClock()).clone()
        guided = made.answer({**batch(0), **more}, HostClock())
    torch.testing.assert_close(guided, plain + 100)


def test_what_does_not_fit_a_recording_is_refused() -> None:
    memory = {"a": torch.zeros(2), "b": torch.zeros(3)}
    with pytest.raises(ValueError, match=r"recorded with \['a', 'b'\], called with \['a'\]"):
        cuda_graph.copy_into(memory, {"a": torch.ones(2)})
    with pytest.raises(ValueError, match=r"b was recorded as \(3,\) torch.float32, and is \(1,\)"):
        cuda_graph.copy_into(memory, {"a": torch.ones(2), "b": torch.ones(1)})
    assert torch.equal(memory["a"], torch.zeros(2))
    cuda_graph.copy_into(memory, {"a": torch.ones(2), "b": memory["b"]})
    assert torch.equal(memory["a"], torch.ones(2))


def test_memory_of_a_recording_can_be_written_in_any_mode() -> None:
    with torch.inference_mode():
        memory = cuda_graph.static({"a": torch.zeros(2)})
    memory["a"].copy_(torch.ones(2))
    assert torch.equal(memory["a"], torch.ones(2))


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda x: x * float(x.sum()), r"aten\.item\S* gives a value to the host"),
        (lambda x: x[x > 0].sum(), "by a mask: the size of the result depends on values"),
        (lambda x: x + torch.tensor([1.0, 2.0]), "lift_fresh"),
        (lambda x: x.to("meta"), "copies between"),
    ],
)
def test_what_a_capture_does_not_allow_is_refused(spoil: Any, said: str) -> None:
    with pytest.raises(Refused, match=said), torch.inference_mode():
        check_capturable(lambda: spoil(torch.randn(3, 2)))


def test_a_tape_repeats_operations_and_not_python() -> None:
    calls = []

    def function(inputs: Any) -> dict[str, Any]:
        calls.append(1)
        x = inputs["x"]
        view = x.view(-1)
        return {"y": view + len(calls), "z": x.clone().mul_(2)}

    tape = Tape(function, {"x": torch.zeros(2, 2)})
    found = tape({"x": torch.ones(2, 2)})
    assert len(calls) == 1
    assert torch.equal(found["y"], torch.full((4,), 2.0))
    assert torch.equal(found["z"], torch.full((2, 2), 2.0))


# -- what cannot be done here ----------------------------------------------------------------


def test_an_unknown_execution_is_refused() -> None:
    with pytest.raises(ConfigError, match="execution 'fast' is unknown; choose one of eager"):
        policy(Steps(), execution="fast")


def test_a_graph_needs_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ConfigError, match="execution 'graph' needs a GPU, and torch finds none"):
        policy(Steps(), execution="graph")
    with pytest.raises(ConfigError, match="needs a GPU"):
        cuda_graph.CudaGraph(lambda inputs: inputs, {"x": torch.zeros(1)})


def test_a_graph_needs_a_model_that_divides_its_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(execution, "check_gpu", lambda: None)
    with pytest.raises(ConfigError, match=r"OneGo has no observe\(\) and denoise\(\)"):
        policy(OneGo(), execution="graph")


def test_compiling_needs_blocks() -> None:
    with pytest.raises(ConfigError, match="OneGo names no blocks to compile"):
        policy(OneGo(), execution="compiled")


# -- host and device -------------------------------------------------------------------------


def test_a_cpu_s_batch_is_not_copied_and_its_answer_is() -> None:
    transfer, given = Transfer("cpu"), {"x": torch.ones(2), "words": ["a"]}
    found = transfer.to_device(given)
    assert found["x"] is given["x"]
    assert found["words"] == ["a"]
    array = transfer.fetch(given["x"])
    given["x"].zero_()
    assert array.tolist() == [1.0, 1.0]


def test_memory_on_the_host_is_kept_by_name_shape_and_dtype() -> None:
    """With memory that is not pinned, which needs a GPU: on the meta device only sizes count."""
    transfer = Transfer("meta", pinned=False)
    first = transfer._buffer("answer", torch.zeros(2, 3))
    assert transfer._buffer("answer", torch.ones(2, 3)) is first
    assert transfer._buffer("answer", torch.zeros(3, 2)) is not first
    assert transfer._buffer("answer", torch.zeros(3, 2).half()).dtype is torch.float16
    with torch.inference_mode():
        made = transfer._buffer("other", torch.zeros(1))
    made.copy_(torch.ones(1))
    assert transfer.to_device({"x": torch.ones(2)})["x"].device.type == "meta"


# -- weights ---------------------------------------------------------------------------------


def test_bf16_is_what_autocast_computes_with() -> None:
    model = Steps(64).eval()
    with torch.inference_mode(), torch.autocast("cpu", torch.bfloat16):
        expected = model.predict_action(**batch(0))
        store_in_bf16(model)
        assert torch.equal(model.predict_action(**batch(0)), expected)
    assert model.inner.weight.dtype is torch.bfloat16
    # Computed exactly; looked up elsewhere, in float32.
    assert model.out.weight.dtype is torch.float32
    assert model.words.weight.dtype is torch.float32
    assert model.tied.weight is model.words.weight
    assert ready(Steps(), "float32", None).inner.weight.dtype is torch.float32


@pytest.mark.parametrize(
    ("kind", "device", "said"),
    [
        ("int4", "cpu", "quantization 'int4' is unknown; choose one of int8, fp8, fp8_dynamic"),
        ("fp8_dynamic", "cpu", "needs a GPU of compute capability 8.9 .*, the device is cpu"),
    ],
)
def test_what_cannot_be_quantised_is_refused(
    kind: str, device: str, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda n: object() if n == "torchao" else real(n)
    )
    with pytest.raises(ConfigError, match=said):
        check_quantization(kind, device)


def test_an_old_gpu_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda n: object())
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: (8, 0))
    with pytest.raises(ConfigError, match=r"the device is one of compute capability 8\.0"):
        check_quantization("fp8_dynamic", "cuda")
    check_quantization("fp8", "cuda")


def test_without_torchao(monkeypatch: pytest.MonkeyPatch) -> None:
    real = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda n: None if n == "torchao" else real(n))
    with pytest.raises(ConfigError, match="needs the package torchao") as caught:
        check_quantization("int8", "cpu")
    assert caught.value.next == "pip install 'fluxvla-core[quantize]'"


@pytest.mark.parametrize("kind", ["int8", "fp8"])
def test_quantised_weights_change_little(kind: str) -> None:
    pytest.importorskip("torchao", reason="torchao is not installed: no quantisation")
    model = Steps(256).eval()
    with torch.inference_mode():
        expected = model.predict_action(**batch(0))
        assert quantize(model, kind) == 1
        found = model.predict_action(**batch(0))
    gap = float((found - expected).abs().max() / expected.abs().max())
    assert 0 < gap < 0.02
    assert type(model.out.weight) is torch.nn.Parameter


def test_a_model_without_linear_layers_cannot_be_quantised() -> None:
    pytest.importorskip("torchao", reason="torchao is not installed: no quantisation")
    model = Steps()
    model.fsdp_units = list  # type: ignore[method-assign]
    with pytest.raises(ConfigError, match="Steps has no linear layers in its blocks"):
        quantize(model, "int8")


def test_eager_needs_no_division() -> None:
    model = OneGo().eval()
    found = Eager(model).answer(batch(0), HostClock())
    torch.testing.assert_close(found, model.predict_action(**batch(0)))
