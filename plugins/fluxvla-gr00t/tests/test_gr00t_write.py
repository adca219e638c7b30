"""What ``fluxvla export --format lerobot`` writes of GR00T.

``tests/written`` has it for the tiny models of gr00t_sizes.py. ``tests/oracles`` loads that in
LeRobot, N1.5 in its version 0.4.4 and N1.7 in 0.6.1, and records what follows there.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from fluxvla_gr00t import lerobot_format, tables
from fluxvla_gr00t.lerobot_format import LeRobotGR00TFormat
from fluxvla_gr00t.lerobot_write import _tensors
from fluxvla_gr00t.names import is_unread, published_name
from fluxvla_gr00t.robots import Robot
from safetensors.torch import load_file

from fluxvla_core.cli.main import main
from fluxvla_core.data import Pipeline
from fluxvla_core.errors import CheckpointError
from fluxvla_core.models import ForeignCheckpoint
from tests.oracles import fill

from . import published as folders
from .gr00t_sizes import VERSIONS, published, tiny
from .test_gr00t_names import listed

WRITTEN = Path(__file__).parent / "written"
GOLDEN = Path(__file__).parent / "golden"
ROWS = {
    "proprio": {"min": [-1.0, 0.0, -2.0, 0.5, 1.0], "max": [3.0, 0.5, 2.0, 0.75, 2.0]},
    "action": {"min": [-2.0, 1.0, -1.0, 0.0, -8.0], "max": [2.0, 1.5, 1.0, 4.0, 8.0]},
}


@pytest.fixture
def sizes(monkeypatch):
    """The tiny sizes as if they were published."""
    for version, (_, table) in VERSIONS.items():
        monkeypatch.setitem(tables.BACKBONES, version, table["vlm_backbone"])
        monkeypatch.setitem(lerobot_format.HEADS, version, table["vla_head"])


def made(version: str, **more: object) -> ForeignCheckpoint:
    """A checkpoint of the tiny model for a robot with five joints and two cameras."""
    robot = Robot(tag="arm", embodiment_id=2, img_keys=("front", "wrist"), norm_type="min_max")
    model = {**VERSIONS[version][1], "embodiment_id": 2}
    if version == "n1.5":
        transforms = tables.n15_transforms(model, robot, "words")
    else:
        settings = {"image_target_size": [64, 64], "crop_fraction": 0.95}
        resize = tables.resize_table(settings, "there")
        transforms = tables.n17_transforms(model, robot, "words", resize, True, True)
    middle = {key: {**row, "mean": row["min"], "std": [1.0] * 5} for key, row in ROWS.items()}
    facts: dict[str, object] = {
        "model": model,
        "tensors": tiny(version).state_dict(),
        "img_keys": robot.img_keys,
        "transforms": transforms,
        "statistics": {"private": middle},
        "horizon": 6,
    }
    return ForeignCheckpoint(**{**facts, **more})


@pytest.mark.parametrize("version", VERSIONS)
def test_it_comes_back_as_it_went(version, tmp_path, monkeypatch):
    source = folders.lerobot_folder(version, tmp_path / "theirs", monkeypatch)
    words = folders.tokenizer(version, tmp_path / "words")
    options = ["--tokenizer", str(words), "--rate", "20"]
    assert main(["import-checkpoint", str(source), str(tmp_path / "ours"), *options]) == 0
    back = tmp_path / "back"
    assert main(["export", str(tmp_path / "ours"), str(back), "--format", "lerobot"]) == 0

    theirs = load_file(source / "model.safetensors")
    found = load_file(back / "model.safetensors")
    read = {n for n in theirs if not is_unread(n.removeprefix("_groot_model."), version)}
    assert all(torch.equal(found[n], theirs[n]) and found[n].dtype == theirs[n].dtype for n in read)
    assert all(is_unread(n.removeprefix("_groot_model."), version) for n in found.keys() - read)
    (before,), (after,) = (list(f.glob("policy_pre*_v[13].safetensors")) for f in (source, back))
    numbers, again = load_file(before), load_file(after)
    assert numbers.keys() == again.keys()
    for name, value in numbers.items():
        torch.testing.assert_close(again[name], value.float(), rtol=0, atol=0)
    pack, other = (packing(folder) for folder in (source, back))
    kept = pack.keys() & other.keys() - {"embodiment_mapping", "embodiment_tag"}
    assert {name: other[name] for name in kept} == {name: pack[name] for name in kept}
    one, two = (LeRobotGR00TFormat().read(folder, "words") for folder in (source, back))
    assert (one.model, one.transforms) == (two.model, two.transforms)
    for entry, rows in one.statistics["private"].items():
        for name, row in rows.items():  # theirs are in float64
            again = two.statistics["private"][entry][name]
            np.testing.assert_allclose(row, again, rtol=1e-6, atol=1e-7)
    assert (one.img_keys, one.horizon) == (two.img_keys, two.horizon)


def packing(folder):
    steps = json.loads((folder / "policy_preprocessor.json").read_text())["steps"]
    return next(step["config"] for step in steps if "pack_inputs" in step["registry_name"])


@pytest.mark.parametrize("version", VERSIONS)
def test_every_tensor_of_the_published_file_is_written(version):
    table, _ = VERSIONS[version]
    found = _tensors(
        replace(made(version), model=table, tensors=published(version).state_dict()), version
    )
    shapes = {n.removeprefix("_groot_model."): tuple(t.shape) for n, t in found.items()}
    expected = listed(version)
    if version == "n1.7":  # the embedding's own memory, which LeRobot leaves out too
        expected.pop("backbone.model.lm_head.weight")
    assert shapes == expected


@pytest.mark.parametrize("version", VERSIONS)
def test_it_is_what_lerobot_was_given(version, tmp_path, sizes):
    """LeRobot's side was computed with these files: if they change, so does that, by nox."""
    LeRobotGR00TFormat().write(made(version), tmp_path)
    known = WRITTEN / version
    weights = load_file(tmp_path / "model.safetensors")
    own = tiny(version).state_dict()
    for name, tensor in own.items():
        assert torch.equal(weights[f"_groot_model.{published_name(name, version)}"], tensor)
    shapes = {name: list(tensor.shape) for name, tensor in weights.items()}
    assert shapes == json.loads((known / "tensors.json").read_text())
    (tmp_path / "model.safetensors").unlink()
    (tmp_path / "tensors.json").write_bytes((known / "tensors.json").read_bytes())
    assert {file.name for file in tmp_path.iterdir()} == {file.name for file in known.iterdir()}
    for file in tmp_path.iterdir():
        assert file.read_bytes() == (known / file.name).read_bytes(), file.name


@pytest.mark.parametrize("version", VERSIONS)
def test_states_and_actions_are_scaled_as_in_lerobot(version):
    golden = load_file(GOLDEN / f"written_{version.replace('.', '')}.safetensors")
    stats = made(version).statistics["private"]
    listed_tables = [t for t in made(version).transforms if t["type"] in _SCALED]
    raw = fill.normal("raw state", (5,))
    sample = Pipeline(listed_tables)({"states": raw, "stats": stats})
    np.testing.assert_allclose(sample["states"], golden["state"], rtol=1e-5, atol=1e-6)
    undo = Pipeline(listed_tables[:1]).transforms[0].denormalizer({"private": stats})
    commands = undo({"action": golden["actions"][None].numpy(), "states": raw})
    np.testing.assert_allclose(commands, golden["commands"], rtol=1e-5, atol=1e-6)
    assert golden["embodiment_id"].item() == 2
    # Images of one colour each: 10 in front, 20 at the wrist.
    assert golden["views"].tolist() == [10, 20]


@pytest.mark.parametrize("version", VERSIONS)
def test_the_model_acts_as_in_lerobot(version):
    golden = load_file(GOLDEN / f"written_{version.replace('.', '')}.safetensors")
    model = tiny(version)
    with torch.no_grad():
        actions = model.predict_action(
            images=golden["images"],
            lang_tokens=golden["tokens"],
            lang_masks=torch.ones_like(golden["tokens"], dtype=torch.bool),
            states=golden["state"][None],
            noise=torch.from_numpy(fill.normal("noise", (1, 6, 5))),
            embodiment_ids=golden["embodiment_id"].long(),
        )
    scale = golden["actions"].abs().max()
    assert (actions[0] - golden["actions"]).abs().max() < 1e-5 * scale


_SCALED = ("NormalizeStatesAndActions", "ClipNormalized")


def renormalised(version, **more):
    return [
        {**table, **more} if table["type"] == "NormalizeStatesAndActions" else table
        for table in made(version).transforms
    ]


@pytest.mark.parametrize(
    ("version", "more", "words"),
    [
        ("n1.7", {"transforms": renormalised("n1.7", norm_type="mean_std")}, "by mean_std; LeRobo"),
        ("n1.7", {"transforms": renormalised("n1.7", std_floor=0.1)}, "std_floor is 0.1"),
        ("n1.7", {"transforms": made("n1.7").transforms[1:]}, "no ResizeCropImages is among"),
        (
            "n1.5",
            {"transforms": [*made("n1.5").transforms, {"type": "ClipNormalized"}]},
            "ClipNormalized is among the transforms",
        ),
        ("n1.5", {"img_keys": ("wrist", "front")}, "in the order of the alphabet"),
        ("n1.5", {"statistics": {"private": {}}}, "no statistics of observation.state"),
    ],
)
def test_what_lerobot_cannot_say_is_refused(version, more, words, tmp_path, sizes):
    with pytest.raises(CheckpointError) as caught:
        LeRobotGR00TFormat().write(made(version, **more), tmp_path)
    assert words in str(caught.value)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("version", VERSIONS)
def test_other_sizes_than_the_published_are_refused(version, tmp_path):
    with pytest.raises(CheckpointError, match=r"vla_head\.context_heads is 2; LeRobot's GR00T N1"):
        LeRobotGR00TFormat().write(made(version), tmp_path)


def test_relative_actions_are_refused(tmp_path, sizes):
    stats = {key: dict(row) for key, row in made("n1.7").statistics["private"].items()}
    stats["action"]["relative"] = [1.0] * 5
    with pytest.raises(CheckpointError, match="count from the state"):
        LeRobotGR00TFormat().write(made("n1.7", statistics={"private": stats}), tmp_path)


def test_a_range_by_percentiles_becomes_minimum_and_maximum(tmp_path, sizes):
    stats = {
        key: {**row, "q01": row["min"], "q99": row["max"], "min": [-9.0] * 5, "max": [9.0] * 5}
        for key, row in made("n1.7").statistics["private"].items()
    }
    more = {
        "transforms": renormalised("n1.7", norm_type="quantile"),
        "statistics": {"private": stats},
    }
    LeRobotGR00TFormat().write(made("n1.7", **more), tmp_path)
    (file,) = tmp_path.glob("policy_pre*.safetensors")
    numbers = load_file(file)
    assert numbers["action.min"].tolist() == ROWS["action"]["min"]
    assert numbers["observation.state.max"].tolist() == ROWS["proprio"]["max"]
