"""Checkpoints of other projects: imported, trained from, and written back."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from fluxvla_core.build import RunContext, build_runner_from_cfg
from fluxvla_core.checkpoints.checkpoint import Checkpoint
from fluxvla_core.checkpoints.foreign import (
    check_settings,
    explain_other_family,
    formats,
    read_foreign,
)
from fluxvla_core.cli.main import main
from fluxvla_core.errors import CheckpointError, IncompatiblePlugin, SpecMismatch, UsageError
from fluxvla_core.models import (
    chosen_robot,
    without_cameras,
)
from fluxvla_core.plugins.registry import CHECKPOINT_FORMATS
from fluxvla_core.policies.loading import load_policy
from fluxvla_core.spec import EmbodimentSpec, Joint
from fluxvla_core.testing.training import TinyDataset, tiny_config
from fluxvla_core.training.export import embodiment_in, export_foreign, import_checkpoint

from .reach import ARM, ROW, ReachFormat, plugin, published, weights

__all__ = ["plugin"]


def test_an_imported_checkpoint_acts(tmp_path, capsys):
    source = published(tmp_path / "theirs")
    (tmp_path / "arm.json").write_text(json.dumps(ARM.to_dict()))
    out = tmp_path / "ours"
    words = ["--embodiment", str(tmp_path / "arm.json"), "--camera", "base=front"]

    assert main(["import-checkpoint", str(source), str(out), *words]) == 0

    assert capsys.readouterr().out == (
        f"{out}: ReachVLA, 4 tensors; cameras front; chunks of 4 actions at 10 Hz; arm\n"
        "note: the wrist camera is not used\n"
    )
    Checkpoint.open(out).verify()
    policy = load_policy(out)
    policy.reset(3)
    chunk = policy.predict_action(
        {
            "qpos": np.array([0.3, -0.4], np.float32),
            "images": {"front": np.zeros((8, 8, 3), np.uint8)},
            "task_description": "wave",
        }
    )
    noise = np.random.Generator(np.random.Philox(key=np.array([3, 0], np.uint64)))
    drawn = torch.from_numpy(noise.standard_normal((4, 2), dtype=np.float32)).double()
    w, b, s = (tensor.double() for tensor in weights().values())
    mean, std = torch.tensor(ROW["mean"]).double(), torch.tensor(ROW["std"]).double()
    state = (torch.tensor([0.3, -0.4]).double() - mean) / std
    expected = (s * (drawn @ w.T + b) @ w.T + state) * std + mean
    np.testing.assert_allclose(chunk, expected, rtol=1e-5, atol=1e-6)


def test_weights_keep_their_dtype_and_go_back_bit_for_bit(tmp_path, capsys):
    source = published(tmp_path / "theirs")
    out, _ = import_checkpoint(source, tmp_path / "ours")
    assert load_file(out / "model.safetensors")["gain.weight"].dtype == torch.bfloat16

    assert main(["export", str(out), str(tmp_path / "back"), "--format", "reach"]) == 0

    ours, theirs = load_file(tmp_path / "back" / "model.safetensors"), weights()
    assert set(ours) == set(theirs)
    assert all(torch.equal(ours[n], theirs[n]) and ours[n].dtype == theirs[n].dtype for n in ours)
    assert json.loads((tmp_path / "back" / "reach.json").read_text()) == {"hz": 10.0}


@pytest.mark.parametrize("named_by", ["pretrained_name_or_path", "init_from"])
def test_a_training_starts_from_it(tmp_path, named_by):
    source = published(tmp_path / "theirs")
    settings = {"init_from": str(source)} if named_by == "init_from" else {}
    config = tiny_config({"type": "OneProcessRunner", "max_steps": 1, **settings})
    config["model"] = {"type": "ReachVLA"}
    if not settings:
        config["model"]["pretrained_name_or_path"] = str(source)
    context = RunContext(config=config, section="runner", work_dir=tmp_path / "run")
    runner = build_runner_from_cfg(config["runner"], context)

    runner.run_setup(len(TinyDataset(37)))

    model = runner.vla
    assert torch.equal(model.gain.weight.detach(), weights()["net.w"].float())
    assert model.scale.item() == 1.5


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"net.b": None}, "1 missing: net.b"),
        ({"extra": torch.zeros(1)}, "1 unexpected: extra"),
        ({"net.w": torch.zeros(3, 2)}, r"2 of another size: gain.weight: \(3, 2\) in the"),
    ],
)
def test_other_tensors_are_refused_by_name(tmp_path, change, words):
    tensors = {n: t for n, t in {**weights(), **change}.items() if t is not None}
    source = published(tmp_path / "theirs", tensors)
    with pytest.raises(CheckpointError, match=words):
        import_checkpoint(source, tmp_path / "ours")
    assert not (tmp_path / "ours").exists()


def test_what_no_format_recognises(tmp_path, capsys):
    (tmp_path / "theirs").mkdir()
    assert main(["import-checkpoint", str(tmp_path / "theirs"), str(tmp_path / "ours")]) == 2
    text = capsys.readouterr().err
    assert "no installed format recognises the checkpoint: it has no config.json" in text
    assert "reach (ReachVLA)" in text


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ('{"type": "pi09"}', "its config.json says type 'pi09'"),
        ('{"model_type": "gr00t_n9"}', "its config.json says model_type 'gr00t_n9'"),
        ("{}", "its config.json says neither type nor model_type"),
        ('{"type":', "its config.json cannot be read: invalid JSON"),
    ],
)
def test_what_is_not_recognised_is_called_as_it_calls_itself(tmp_path, content, words):
    (tmp_path / "config.json").write_text(content)
    with pytest.raises(CheckpointError, match=words):
        read_foreign(tmp_path)


def test_formats_that_cannot_be_loaded_are_told_once_a_reason(tmp_path, monkeypatch):
    why = "fluxvla-x 1.0 needs transformers>=5,<6, but 4.40.0 is installed"
    broken = [
        IncompatiblePlugin(f"fluxvla.checkpoint_formats:{name}: {why}", next="pip install it")
        for name in ("A", "B")
    ]
    known, _ = formats()
    monkeypatch.setattr("fluxvla_core.checkpoints.foreign.formats", lambda: (known, broken))
    with pytest.raises(CheckpointError) as error:
        read_foreign(tmp_path)
    assert error.value.cause.count(why) == 1
    assert error.value.next == "pip install it"
    with pytest.raises(UsageError, match=f"there is no checkpoint format 'x'.*{why}"):
        read_foreign(tmp_path, "x")


@pytest.mark.parametrize("value", [True, 30.0, "tanh", [1], {"a": 1}])
def test_a_setting_that_nobody_knows_is_refused_with_its_value(value):
    settings = {"horizon": 5, "_private": True, "off": False, "none": None, "cap": value}
    with pytest.raises(CheckpointError, match=r"cap is .*no setting of that name") as error:
        check_settings(settings, {"horizon"}, "/theirs/config.json")
    assert str(value) in error.value.what
    assert error.value.where == "/theirs/config.json"
    check_settings({**settings, "cap": 0}, {"horizon"}, "/theirs/config.json")


def test_two_formats_that_recognise_it_are_told_apart_by_name(tmp_path):
    class AlsoFormat(ReachFormat):
        name = "also"

    CHECKPOINT_FORMATS.register_module()(AlsoFormat)
    try:
        source = published(tmp_path / "theirs")
        with pytest.raises(CheckpointError, match=r"also .*, reach .*") as caught:
            import_checkpoint(source, tmp_path / "ours")
        assert "--format NAME" in str(caught.value)
        import_checkpoint(source, tmp_path / "ours", format="also")
    finally:
        CHECKPOINT_FORMATS.unregister("AlsoFormat")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--format", "raech"], "there is no checkpoint format 'raech'; did you mean 'reach'?"),
        (["--camera", "wrist=front"], "the checkpoint has no such camera; it has base"),
        (["--camera", "front"], "'front' is not THEIRS=OURS"),
        (["--camera", "base=a", "--camera", "base=b"], "--camera base=… is given twice"),
        (["--camera", "base=none"], "ReachVLA (reach) needs the images of all cameras"),
        (["--robot", "arm"], "a checkpoint of ReachVLA (reach) is of one robot"),
        (["--rate", "0"], "--rate 0 is not a rate"),
        (["--rate", "nan"], "--rate nan is not a rate"),
        (["--embodiment", "nowhere"], "there is no embodiment.json at nowhere"),
    ],
)
def test_options_that_do_not_fit(tmp_path, capsys, words, said):
    source = published(tmp_path / "theirs")
    assert main(["import-checkpoint", str(source), str(tmp_path / "ours"), *words]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "ours").exists()


class ManyFormat(ReachFormat):
    """Two robots, three cameras, of which the model may lack some."""

    name = "many"

    def recognizes(self, folder):
        return (folder / "many").is_file()

    def read(self, folder, tokenizer=None, robot=None, absent=()):
        found = super().read(folder, tokenizer)
        chosen = chosen_robot(("acme_arm", "acme_dog"), robot, str(folder))
        cameras = ("observation.images.base", "left", "right")
        row = {**ROW, "mean": [len(chosen or ""), 0.0]}
        return replace(
            found,
            img_keys=without_cameras(cameras, absent, str(folder)),
            statistics={"private": {"proprio": row, "action": row}},
            notes=(),
        )


@pytest.fixture
def many(tmp_path):
    CHECKPOINT_FORMATS.register_module()(ManyFormat)
    source = published(tmp_path / "theirs")
    (source / "many").touch()
    yield [str(source), str(tmp_path / "ours"), "--format", "many"]
    CHECKPOINT_FORMATS.unregister("ManyFormat")


def test_one_of_several_robots_without_some_cameras(many, tmp_path, capsys):
    cameras = ["--camera", "left=none", "--camera", "right=wrist"]
    assert main(["import-checkpoint", *many, "--robot", "acme_dog", *cameras]) == 0
    assert "cameras base, wrist; chunks of 4" in capsys.readouterr().out
    written = Checkpoint.open(tmp_path / "ours")
    assert written.statistics()["private"]["action"]["mean"] == [8, 0.0]
    dataset = written.config()["train_dataloader"]["dataset"]
    assert dataset["img_keys"] == ["base", "wrist"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--robot", "acme_arn"], "mean 'acme_arm'? It knows acme_arm, acme_dog"),
        (["--camera", "wrist=none"], "has no such camera; it has base, left, right"),
        (
            [word for name in ("base", "left", "right") for word in ("--camera", f"{name}=none")],
            "no camera is left of base, left, right",
        ),
        (
            ["--camera", "left=wrist", "--camera", "right=wrist"],
            "left and right would both be the robot's camera 'wrist'",
        ),
        (["--camera", "left=right"], "left and right would both be the robot's camera 'right'"),
    ],
)
def test_choices_that_a_checkpoint_does_not_have(many, tmp_path, capsys, words, said):
    assert main(["import-checkpoint", *many, *words]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "ours").exists()


def test_the_robot_of_a_dataset(tmp_path):
    (tmp_path / "data" / "meta").mkdir(parents=True)
    path = tmp_path / "data" / "meta" / "fluxvla_embodiment.json"
    path.write_text(json.dumps(ARM.to_dict()))
    assert embodiment_in(tmp_path / "data") == ARM


def test_another_robot_is_refused(tmp_path):
    source = published(tmp_path / "theirs")
    with pytest.raises(SpecMismatch, match="looks at base; arm has front") as caught:
        import_checkpoint(source, tmp_path / "ours", embodiment=ARM)
    assert "--camera base=NAME" in str(caught.value)
    assert "base=none if it has no such camera" in str(caught.value)
    joints = (*ARM.joints, Joint("c", "rad", -1.0, 1.0, 1.0, 1.0))
    longer = EmbodimentSpec("longer", joints, ARM.cameras, 50.0)
    with pytest.raises(SpecMismatch, match="'action' have 2 dimensions, longer has 3"):
        import_checkpoint(source, tmp_path / "ours", embodiment=longer, cameras={"base": "front"})


def test_without_a_robot_it_drives_nothing(tmp_path):
    out, _ = import_checkpoint(published(tmp_path / "theirs"), tmp_path / "ours")
    with pytest.raises(SpecMismatch, match="does not say the embodiment"):
        load_policy(out)


def test_a_folder_with_something_in_it_is_left_alone(tmp_path):
    source = published(tmp_path / "theirs")
    with pytest.raises(UsageError, match="there is something at"):
        import_checkpoint(source, source)
    out, _ = import_checkpoint(source, tmp_path / "ours")
    with pytest.raises(UsageError, match="there is something at"):
        export_foreign(out, source, "reach")


def test_a_model_that_a_format_does_not_hold(tmp_path, monkeypatch):
    out, _ = import_checkpoint(published(tmp_path / "theirs"), tmp_path / "ours")
    monkeypatch.setattr(ReachFormat, "model_types", ("OtherVLA",))
    with pytest.raises(UsageError, match="format 'reach' holds no ReachVLA; it holds OtherVLA"):
        export_foreign(out, tmp_path / "back", "reach")
    assert not (tmp_path / "back").exists()


def test_a_write_that_fails_leaves_nothing_behind(tmp_path, monkeypatch):
    def write(self, checkpoint, folder):
        (folder / "half").touch()
        raise CheckpointError("it does not fit")

    out, _ = import_checkpoint(published(tmp_path / "theirs"), tmp_path / "ours")
    monkeypatch.setattr(ReachFormat, "write", write)
    with pytest.raises(CheckpointError, match="it does not fit"):
        export_foreign(out, tmp_path / "out" / "back", "reach")
    assert list((tmp_path / "out").iterdir()) == []


def test_weights_of_another_family_name_both():
    class OtherVLA:
        pass

    with (
        pytest.raises(CheckpointError, match="they differ") as error,
        explain_other_family({"type": "fluxvla-reach:ReachVLA"}, OtherVLA()),
    ):
        raise CheckpointError("they differ", cause="unknown")
    assert error.value.cause == "the checkpoint is of ReachVLA, the config's model is OtherVLA"
    with (
        pytest.raises(CheckpointError) as error,
        explain_other_family({"type": "OtherVLA"}, OtherVLA()),
    ):
        raise CheckpointError("they differ", cause="unknown")
    assert error.value.cause == "unknown"


def test_weights_of_another_size_name_the_numbers_that_differ():
    class Model:
        width, depth, horizon = 8, 2, 5

    with (
        pytest.raises(CheckpointError) as error,
        explain_other_family({"type": "Model", "width": 6, "depth": 2, "horizon": 7}, Model()),
    ):
        raise CheckpointError("they differ", cause="unknown")
    assert error.value.cause == (
        "the checkpoint's model has width 6, the config's 8; horizon 7, the config's 5"
    )
    assert error.value.next.startswith("--set model.width=6 --set model.horizon=7, and data")


@pytest.mark.parametrize("key", ["runner.init_from", "model.pretrained_name_or_path"])
def test_a_training_names_the_key_of_what_it_starts_from(tmp_path, key):
    config = tiny_config({"type": "OneProcessRunner", "max_steps": 1})
    config["model"] = {"type": "ReachVLA"}
    section, _, name = key.partition(".")
    config[section][name] = str(tmp_path / "nowhere")
    context = RunContext(config, "runner", tmp_path / "run", origins={key: "c.py:3"})
    runner = build_runner_from_cfg(config["runner"], context)
    with pytest.raises(CheckpointError, match="there is no checkpoint at") as error:
        runner.run_setup(4)
    assert error.value.where == f"c.py:3: {key}"
