"""Low-rank adapters: what is trained, saved, resumed, and merged."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch

from fluxvla_core.build import RunContext, build_runner_from_cfg
from fluxvla_core.checkpoints.checkpoint import Checkpoint, folders, latest
from fluxvla_core.checkpoints.writer import CheckpointWriter
from fluxvla_core.errors import CheckpointError, ConfigError
from fluxvla_core.testing.training import (
    TinyDataset,
    TinyVLA,
    checkpoint_differences,
    tiny_config,
    unflushed,
)
from fluxvla_core.training import lora
from fluxvla_core.training.export import export
from fluxvla_core.training.lora import LoraOptions
from fluxvla_core.training.weights import (
    adapter_base_place,
    adapter_base_to_record,
    load_for_inference,
    load_initial_weights,
)

pytest.importorskip("peft")

LORA = {"rank": 2, "alpha": 4, "target_modules": ["linear"], "modules_to_save": ["head"]}


@pytest.fixture(autouse=True)
def _fast():
    with unflushed():
        yield


def make(work_dir, resume=None, **settings):
    table = {"type": "OneProcessRunner", "max_steps": 6, "max_keep_ckpts": 0, **settings}
    config = tiny_config(table)
    context = RunContext(config=config, section="runner", work_dir=Path(work_dir), resume=resume)
    return build_runner_from_cfg(config["runner"], context)


def run(work_dir, resume=None, **settings):
    runner = make(work_dir, resume, **settings)
    runner.run_setup(37)
    runner.run(TinyDataset())
    return runner


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    place = tmp_path_factory.mktemp("base")
    with unflushed():
        run(place, max_steps=2)
    return place


def batch(n=5):
    samples = [TinyDataset().get_sample(i, 0) for i in range(n)]
    return {k: torch.stack([torch.as_tensor(s[k]) for s in samples]) for k in samples[0]}


def loss_of(model):
    with torch.no_grad():
        return float(model.eval()(**batch())["loss"])


def test_only_the_adapter_is_trained_and_saved(tmp_path, base):
    """T2 of upstream's bugs: merged weights were saved, and the adapter was not rotated."""
    runner = run(tmp_path, init_from=str(base), lora=LORA, save_iter_interval=2, max_keep_ckpts=2)
    found = latest(tmp_path)
    assert {n for n in found.manifest.files if n.startswith("adapter/")} == {
        "adapter/adapter_config.json",
        "adapter/adapter_model.safetensors",
    }
    assert set(found.tensors("model.safetensors")) == {"batches"}
    assert set(found.tensors(lora.WEIGHTS)) == {
        *(f"base_model.model.blocks.{i}.linear.lora_{ab}.weight" for i in (0, 1) for ab in "AB"),
        "base_model.model.head.weight",
        "base_model.model.head.bias",
    }
    trained = {n for n, p in runner.model.named_parameters() if p.requires_grad}
    assert {n.rpartition("/")[0] for n in found.tensors("optimizer.safetensors")} == trained
    assert all(".lora_" in n or "modules_to_save" in n for n in trained)
    assert found.json("trainer.json")["left_out"]["sources"] == {"": str(latest(base).path)}
    assert len(folders(tmp_path)) == 2
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "checkpoints",
        "metrics.jsonl",
        "run.lock",
    ]


def test_it_goes_on_bit_for_bit(tmp_path, base):
    settings = {"init_from": str(base), "lora": LORA, "ema_decay": 0.9, "save_iter_interval": 4}
    run(tmp_path / "whole", **settings)
    run(tmp_path / "cut", **settings, max_steps=4)
    run(tmp_path / "cut", "auto", **settings)
    assert checkpoint_differences(*(folders(tmp_path / d)[-1] for d in ("whole", "cut"))) == []


def test_the_base_is_another_runs_weights(tmp_path, base):
    run(tmp_path, init_from=str(base), lora=LORA, max_steps=1)
    started = TinyVLA()
    load_initial_weights(started, base)
    acts = TinyVLA()
    load_for_inference(acts, latest(tmp_path))
    assert torch.equal(acts.encoder.weight, started.encoder.weight)
    assert torch.equal(acts.blocks[0].norm.weight, started.blocks[0].norm.weight)
    assert not torch.equal(acts.blocks[0].linear.weight, started.blocks[0].linear.weight)
    assert not torch.equal(acts.head.weight, started.head.weight)


def test_peft_reads_the_adapter_and_agrees_with_the_merged_model(tmp_path, base):
    from peft import PeftModel

    run(tmp_path, init_from=str(base), lora=LORA)
    found = latest(tmp_path)
    merged, plain = TinyVLA(), TinyVLA()
    load_for_inference(merged, found)
    load_initial_weights(plain, base)
    assert set(merged.state_dict()) == set(plain.state_dict())
    assert [p.requires_grad for p in merged.parameters()] == [
        p.requires_grad for p in plain.parameters()
    ]
    assert not hasattr(merged, "peft_config")
    before = loss_of(plain)
    theirs = PeftModel.from_pretrained(plain, str(found.path / "adapter"))
    assert loss_of(merged) == pytest.approx(loss_of(theirs), rel=1e-5)
    assert abs(loss_of(merged) - before) > 1e-4


@pytest.mark.parametrize("ema", [None, 0.5])
def test_an_export_has_the_adapter_merged_and_needs_no_base(tmp_path, base, ema):
    moved = tmp_path / "base"
    shutil.copytree(base, moved)
    run(tmp_path / "run", init_from=str(moved), lora=LORA, ema_decay=ema)
    acts, alone = TinyVLA(), TinyVLA()
    load_for_inference(acts, latest(tmp_path / "run"))
    exported = export(tmp_path / "run", tmp_path / "policy")
    shutil.rmtree(moved)
    shutil.rmtree(tmp_path / "run")

    load_for_inference(alone, Checkpoint.open(exported))
    assert not (exported / "adapter").exists()
    for name, tensor in acts.state_dict().items():
        assert torch.equal(alone.state_dict()[name], tensor), name


def test_averaged_adapters_act(tmp_path, base):
    run(tmp_path, init_from=str(base), lora=LORA, ema_decay=0.5)
    found = latest(tmp_path)
    model = TinyVLA()
    load_for_inference(model, found)
    average = found.tensors("ema.safetensors")["head.modules_to_save.default.weight"]
    assert torch.equal(model.head.weight, average)


def test_a_full_training_goes_on_from_the_merged_model(tmp_path, base):
    run(tmp_path / "lora", init_from=str(base), lora=LORA)
    full = run(tmp_path / "full", init_from=str(tmp_path / "lora"), max_steps=1)
    trained = {n for n, p in full.model.named_parameters() if p.requires_grad}
    plain = {n for n, p in TinyVLA().named_parameters() if p.requires_grad}
    assert trained == plain
    assert "adapter/adapter_config.json" not in latest(tmp_path / "full").manifest.files


def test_another_base_is_refused(tmp_path, base):
    moved = tmp_path / "base"
    shutil.copytree(base, moved)
    run(tmp_path / "run", init_from=str(moved), lora=LORA, max_steps=2)
    shutil.rmtree(moved)
    run(moved, max_steps=3, seed=1)
    message = "frozen weights differ from those that the checkpoint was trained with"
    with pytest.raises(CheckpointError, match=message) as caught:
        run(tmp_path / "run", "auto", init_from=str(moved), lora=LORA)
    assert f"the model from {moved}" in str(caught.value)
    with pytest.raises(CheckpointError, match=message):
        load_for_inference(TinyVLA(), latest(tmp_path / "run"))
    shutil.rmtree(moved)
    with pytest.raises(CheckpointError, match="there is no checkpoint at"):
        load_for_inference(TinyVLA(), latest(tmp_path / "run"))


@pytest.mark.parametrize("place", ["base", "base/checkpoints/best"])
def test_the_bases_own_run_may_go_on(tmp_path, base, monkeypatch, place):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(base, "base")
    best = Path("base/checkpoints/best")
    best.symlink_to("step-000000002")
    run("run", init_from=place, lora=LORA, max_steps=2)
    run("base", "auto", max_steps=3)
    best.unlink(missing_ok=True)
    best.symlink_to("step-000000003")
    run("run", "auto", init_from=place, lora=LORA, max_steps=4)
    monkeypatch.chdir("/")
    alone, acts = TinyVLA(), TinyVLA()
    load_for_inference(acts, latest(tmp_path / "run"))
    load_for_inference(alone, Checkpoint.open(export(tmp_path / "run", tmp_path / "policy")))
    assert latest(tmp_path / "run").step == 4
    assert all(map(torch.equal, acts.parameters(), alone.parameters()))


def test_a_base_is_found_again_where_all_folders_have_moved_or_where_it_is_said_to_be(
    tmp_path, base, monkeypatch
):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    shutil.copytree(base, "base")
    run("run", init_from="base", lora=LORA, max_steps=2)
    monkeypatch.chdir((tmp_path / "here").rename(tmp_path / "there"))
    load_for_inference(TinyVLA(), latest("run"))
    run("run", "auto", init_from="base", lora=LORA, max_steps=3)
    Path("base").rename("foundation")
    run("run", "auto", init_from="foundation", lora=LORA, max_steps=4)
    found = latest("run").json("trainer.json")["left_out"]["sources"]
    assert found == {"": f"{tmp_path}/there/foundation/checkpoints/step-000000002"}


def test_a_run_that_goes_on_names_the_base_that_it_had(tmp_path, base, monkeypatch):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    shutil.copytree(base, "base")
    settings = {"lora": LORA, "save_iter_interval": 1, "max_keep_ckpts": 1}
    run("run", init_from="base", **settings, max_steps=2)
    run("run", "auto", **settings, max_steps=4)
    run("other", str(latest("run").path), **settings, max_steps=5)
    run("other", "auto", **settings, init_from="base", max_steps=6)
    monkeypatch.chdir((tmp_path / "here").rename(tmp_path / "there"))
    plain = TinyVLA()
    load_initial_weights(plain, "base")
    for place, step in (("run", 4), ("other", 6)):
        found, acts = latest(place), TinyVLA()
        assert found.step == step
        assert found.json(lora.CONFIG)["base_model_name_or_path"] == "base"
        load_for_inference(acts, found)
        assert torch.equal(acts.encoder.weight, plain.encoder.weight)


def test_weights_from_a_package_are_no_base(tmp_path):
    left_out = {"sources": {"": "package:words 1.0"}, "sha256": "0"}
    with CheckpointWriter(tmp_path, 1, 0) as writer:
        writer.write_json(lora.CONFIG, LoraOptions.read(LORA, None).for_peft())
        writer.write_json("trainer.json", {"left_out": left_out})
        found = Checkpoint.open(writer.commit())
    assert adapter_base_place(found) is adapter_base_place(found, "elsewhere") is None
    assert adapter_base_to_record(found, None) is adapter_base_to_record(found, "elsewhere") is None


def test_going_on_with_another_base_names_both(tmp_path, base):
    run(tmp_path / "run", init_from=str(base), lora=LORA, max_steps=2)
    run(tmp_path / "base", max_steps=3, seed=1)
    with pytest.raises(CheckpointError) as caught:
        run(tmp_path / "run", "auto", init_from=str(tmp_path / "base"), lora=LORA)
    before, now = latest(base).path, latest(tmp_path / "base").path
    assert (
        f"was trained with (the model from {now}; then from {before})\n"
        "  likely cause: init_from was changed, or that place has other weights by now\n"
        f"  next: --set <section>.init_from=DIR, where the weights of {before} are; or resume "
        "without it"
    ) in str(caught.value)
    shutil.copytree(base, tmp_path / "copy")
    run(tmp_path / "run", "auto", init_from=str(tmp_path / "copy"), lora=LORA)
    found = latest(tmp_path / "run").json(lora.CONFIG)["base_model_name_or_path"]
    assert found == str(tmp_path / "copy")


def test_without_an_adapter_a_run_that_goes_on_needs_no_base(tmp_path, base):
    moved = tmp_path / "base"
    shutil.copytree(base, moved)
    run(tmp_path / "whole", init_from=str(moved))
    run(tmp_path / "cut", init_from=str(moved), max_steps=3)
    shutil.rmtree(moved)
    run(tmp_path / "cut", "auto", init_from=str(moved))
    assert checkpoint_differences(*(folders(tmp_path / d)[-1] for d in ("whole", "cut"))) == []


def test_a_base_that_comes_from_nowhere_is_saved(tmp_path):
    run(tmp_path, lora=LORA, max_steps=1)
    found = latest(tmp_path)
    assert "blocks.0.linear.base_layer.weight" in found.tensors("model.safetensors")
    model = TinyVLA()
    load_for_inference(model, found)
    assert torch.equal(model.encoder.weight, found.tensors("model.safetensors")["encoder.weight"])


def test_with_and_without_an_adapter_are_two_models(tmp_path, base):
    run(tmp_path, init_from=str(base), lora=LORA, max_steps=2)
    with pytest.raises(CheckpointError) as caught:
        run(tmp_path, "auto", init_from=str(base))
    assert caught.value.what == "lora is not set, the checkpoint's run had rank=2, alpha=4"
    assert "begin another run from these weights: --set '<section>.init_from=" in str(caught.value)
    other = {**LORA, "rank": 3, "target_modules": ["head", "linear"]}
    with pytest.raises(CheckpointError) as caught:
        run(tmp_path, "auto", init_from=str(base), lora=other)
    # What is the same is not repeated: names of modules may fill a screen.
    assert caught.value.what == (
        "lora has rank=3, target_modules=['head', 'linear'], "
        "the checkpoint's run had rank=2, target_modules=['linear']"
    )
    run(tmp_path / "plain", init_from=str(base), max_steps=1)
    with pytest.raises(CheckpointError, match="lora is set, the checkpoint's run had none"):
        run(tmp_path / "plain", "auto", init_from=str(base), lora=LORA)


def test_adapters_learn_with_everything_else_on(tmp_path, base):
    runner = run(
        tmp_path,
        init_from=str(base),
        lora={**LORA, "dropout": 0.1},
        enable_gradient_checkpointing=True,
        enable_mixed_precision_training=True,
        grad_accumulation_steps=2,
    )
    weights = latest(tmp_path).tensors(lora.WEIGHTS)
    assert all(t.dtype == torch.float32 for t in weights.values())
    assert all(t.abs().sum() > 0 for n, t in weights.items() if "lora_B" in n)
    assert runner.progress.step == 6


def test_a_safetensors_file_to_start_from(tmp_path, base):
    runner = make(tmp_path, init_from=str(latest(base).path / "model.safetensors"))
    runner.run_setup(37)
    model = TinyVLA()
    load_for_inference(model, latest(base))
    assert torch.equal(runner.model.head.weight, model.head.weight)
    with pytest.raises(CheckpointError, match=r"there are no weights at .*gone\.safetensors"):
        load_initial_weights(model, tmp_path / "gone.safetensors")
    with pytest.raises(CheckpointError, match="the weights of the checkpoint are not this model's"):
        load_initial_weights(TinyVLA(width=16), latest(base).path / "model.safetensors")


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("all", "lora must be a table, got 'all'"),
        ({"rank": 2}, "lora needs 'target_modules'"),
        ({}, "lora needs 'rank' and 'target_modules'"),
        ({**LORA, "target_module": []}, "lora has no 'target_module'; did you mean 'target_mod"),
        ({**LORA, "x": 1}, "lora has no 'x'; it has rank, target_modules, alpha, dropout"),
        ({**LORA, "rank": 0}, "lora.rank must be a whole number above 0, got 0"),
        ({**LORA, "alpha": -1}, "lora.alpha must be a positive number, got -1"),
        ({**LORA, "dropout": 1}, "lora.dropout must be at least 0 and below 1, got 1"),
        ({**LORA, "target_modules": []}, "lora.target_modules must be names, or one regular exp"),
        ({**LORA, "modules_to_save": "head"}, "lora.modules_to_save must be names of modules"),
    ],
)
def test_tables_that_cannot_be_meant(tmp_path, table, message):
    with pytest.raises(ConfigError) as caught:
        make(tmp_path, lora=table)
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"target_modules": ["linear", "q"]}, "target_modules: no module's name ends in 'q'"),
        ({"target_modules": "query"}, "lora.target_modules: "),
        ({"target_modules": ["norm"]}, "lora.target_modules: Target module LayerNorm("),
        ({"modules_to_save": ["heads"]}, "lora.modules_to_save: no module's name ends in 'heads'"),
    ],
)
def test_modules_that_are_not_there(tmp_path, table, message):
    runner = make(tmp_path, lora={**LORA, **table})
    with pytest.raises(ConfigError) as caught:
        runner.run_setup(37)
    assert message in str(caught.value)
    assert "next: the model has encoder, blocks.0.norm, blocks.0.linear" in str(caught.value)


def test_a_module_that_cannot_be_trained_as_a_whole(tmp_path):
    runner = make(
        tmp_path, lora={**LORA, "target_modules": ["head"], "modules_to_save": ["blocks"]}
    )
    with pytest.raises(ConfigError, match=r"lora\.modules_to_save: .*ModuleList"):
        runner.run_setup(37)


def test_a_regular_expression_and_the_default_alpha(tmp_path):
    table = {"rank": 2, "target_modules": r"blocks\.0\.\w+ear"}
    run(tmp_path, lora=table, max_steps=1)
    assert LoraOptions.of_checkpoint(latest(tmp_path)) == LoraOptions(2, r"blocks\.0\.\w+ear", 2)
    assert [n for n in latest(tmp_path).tensors(lora.WEIGHTS) if "blocks.1" in n] == []
    load_for_inference(TinyVLA(), latest(tmp_path))


@pytest.fixture
def naming(monkeypatch):
    """The model names layers itself."""
    own = {"target_modules": ["linear"], "modules_to_save": ["head"]}
    monkeypatch.setattr(TinyVLA, "lora_defaults", own, raising=False)


def test_a_model_may_name_the_layers(tmp_path, naming):
    short = {"rank": 2, "alpha": 4}
    run(tmp_path / "own", lora=short, max_steps=4)
    run(tmp_path / "named", lora=LORA, max_steps=4)
    own, named = (latest(tmp_path / name) for name in ("own", "named"))
    assert LoraOptions.of_checkpoint(own) == LoraOptions.of_checkpoint(named)
    found, expected = (one.tensors(lora.WEIGHTS) for one in (own, named))
    assert found.keys() == expected.keys()
    assert all(torch.equal(found[name], expected[name]) for name in found)
    assert run(tmp_path / "own", "auto", lora=short).progress.step == 6
    load_for_inference(TinyVLA(), latest(tmp_path / "own"))


def test_names_of_the_config_replace_those_of_the_model(naming):
    given = LoraOptions.read({"rank": 2, "target_modules": ["head"]}, None)
    assert given.for_model(TinyVLA()) == given
    more = LoraOptions.read({"rank": 2, "modules_to_save": ["blocks.0"]}, None, declared=True)
    found = more.for_model(TinyVLA())
    assert (found.target_modules, found.modules_to_save) == (("linear",), ("blocks.0",))


def test_options_for_a_model_that_names_none():
    options = LoraOptions.read({"rank": 2}, None, declared=True)
    with pytest.raises(ConfigError, match=r"a\.py:3: runner\.lora: lora needs 'target_modules'"):
        lora.attach(TinyVLA(), options, "a.py:3: runner.lora")


def test_without_peft(tmp_path, monkeypatch):
    import importlib.util

    real = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda n: None if n == "peft" else real(n))
    with pytest.raises(ConfigError) as caught:
        make(tmp_path, lora=LORA)
    assert str(caught.value) == (
        "lora needs the package peft, which is not installed\n"
        "  next: pip install 'fluxvla-core[lora]'"
    )
