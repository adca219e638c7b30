"""How the evaluated model computes: execution modes and quantised weights, part of the results."""

from __future__ import annotations

import pytest

from fluxvla_core.build import RunContext
from fluxvla_core.errors import ConfigError
from fluxvla_core.evaluation.policies import PolicySource, chosen_checkpoint, load
from fluxvla_core.evaluation.runner import EvalRunner
from tests.evaluation.runs import WALK, evaluate


def test_how_the_model_computes_is_part_of_what_was_evaluated(tmp_path, checkpoint):
    def settings(**options):
        context = RunContext(work_dir=tmp_path, section="eval")
        runner = EvalRunner(context=context, environment=WALK, policy="checkpoint", **options)
        runner.run_setup()
        found = runner.identity()["settings"]
        return found["execution"], found["quantization"]

    assert settings() == ("eager", None)
    assert settings(execution="compiled") == ("compiled", None)


@pytest.mark.parametrize("name", ["checkpoint", "untrained"])
def test_a_policy_computes_as_the_evaluation_says(checkpoint, name):
    path = chosen_checkpoint(str(checkpoint), checkpoint)["path"]
    policy = load(PolicySource(policy=name, ckpt_path=path, execution="compiled"))
    assert policy.execution == "compiled"
    assert "forward" in vars(policy.model.mix)


@pytest.mark.parametrize("name", ["checkpoint", "untrained"])
def test_the_weights_are_quantised_as_the_evaluation_says(checkpoint, name):
    pytest.importorskip("torchao")
    path = chosen_checkpoint(str(checkpoint), checkpoint)["path"]
    plain = load(PolicySource(policy=name, ckpt_path=path))
    small = load(PolicySource(policy=name, ckpt_path=path, quantization="int8"))
    weights = [each.model.mix.weight.detach() for each in (plain, small)]
    assert type(weights[1]) is not type(weights[0])
    gap = (weights[1].dequantize() - weights[0]).abs().max() / weights[0].abs().max()
    assert 0 < gap < 0.01


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"execution": "fast"}, "execution .fast. is unknown; choose one of eager, comp"),
        ({"quantization": "int4"}, "quantization 'int4' is unknown; choose one of int8, fp8"),
    ],
)
def test_a_model_cannot_compute_in_unknown_ways(tmp_path, walking, options, text):
    pytest.importorskip("torch")
    options = {"policy": "checkpoint", "ckpt_path": str(tmp_path / "none"), **options}
    with pytest.raises(ConfigError, match=text):
        evaluate(tmp_path, **options)
    assert not (tmp_path / "eval").exists()


def test_a_model_that_continues_no_chunks_is_not_loaded_for_it(tmp_path, checkpoint):
    live = {"chunk_joining": {"method": "rtc", "window": 3}}
    walk = {**WALK, "limited": True}
    with pytest.raises(
        ConfigError, match=r"live has chunk_joining .*, and Strides cannot continue"
    ):
        evaluate(tmp_path, walk, policy="checkpoint", ckpt_path=str(checkpoint), live=live)
    assert not (tmp_path / "eval_live").exists()
