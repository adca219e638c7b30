"""openpi's checkpoints: read by their shapes and statistics, and back bit for bit."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from fluxvla_pi.names import OPENPI
from fluxvla_pi.openpi_format import CAMERAS, OpenPiFormat
from safetensors.torch import load_file, save_file

from fluxvla_core import Camera, EmbodimentSpec
from fluxvla_core.cli.main import main
from fluxvla_core.errors import CheckpointError, UsageError
from fluxvla_core.models import load_policy

from .oracles import pi_inputs
from .published_folders import ROBOT, openpi_folder, tokenizer_folder, weights

FAMILIES = ("pi0", "pi05")
ARM = EmbodimentSpec(
    "arm", ROBOT.joints, tuple(Camera(name, 48, 64) for name in ("top", "left", "right")), 10.0
)


def brought(tmp_path, family, cameras=("top", "left", "right")):
    """A tiny checkpoint of openpi's, imported for a robot with three cameras."""
    source = openpi_folder(tmp_path / "theirs", family)
    words = tokenizer_folder(tmp_path / "words")
    (tmp_path / "arm.json").write_text(json.dumps(ARM.to_dict()))
    told = ["--tokenizer", str(words), "--embodiment", str(tmp_path / "arm.json"), "--rate", "10"]
    for theirs, ours in zip(CAMERAS, cameras, strict=True):
        told += ["--camera", f"{theirs}={ours}"]
    assert main(["import-checkpoint", str(source), str(tmp_path / "ours"), *told]) == 0
    return source, tmp_path / "ours"


@pytest.mark.parametrize("family", FAMILIES)
def test_it_acts(tmp_path, family):
    """Once with openpi's formulas written out around the model."""
    _, out = brought(tmp_path, family)
    policy = load_policy(out)
    images, state = pi_inputs.observation()
    images_by_camera = dict.fromkeys(("top", "left", "right"), images["front"])
    seen = {"images": images_by_camera, "qpos": state, "task_description": "put it away"}
    policy.reset(pi_inputs.SEED)
    found = policy.predict_action(seen)

    stats = pi_inputs.statistics()
    low, high = (stats["observation.state"][name] for name in ("q01", "q99"))
    mean, std = (stats["observation.state"][name] for name in ("mean", "std"))
    if family == "pi05":
        scaled = (state - low) / (high - low + 1e-6) * 2 - 1
        bins = np.digitize(scaled, np.linspace(-1, 1, 257)[:-1]) - 1
        text = f"Task: put it away, State: {' '.join(map(str, bins))};\nAction: "
    else:
        scaled, text = (state - mean) / (std + 1e-6), "put it away\n"
    ids = pi_inputs.tokenizer().encode(text).ids
    length = 48 if family == "pi0" else 200
    tokens = torch.zeros(1, length, dtype=torch.int64)
    tokens[0, : len(ids)] = torch.tensor(ids)
    from PIL import Image

    small = Image.fromarray(images["front"]).resize((28, 21), Image.Resampling.BILINEAR)
    canvas = Image.new("RGB", (28, 28))
    canvas.paste(small, (0, 3))
    image = torch.from_numpy(np.asarray(canvas).transpose(2, 0, 1).astype(np.float32))
    padded = torch.nn.functional.pad(torch.from_numpy(scaled.astype(np.float32)), (0, 1))
    with torch.no_grad():
        raw = policy.model.predict_action(
            images=(image / 255 * 2 - 1).repeat(3, 1, 1)[None],
            lang_tokens=tokens,
            lang_masks=torch.arange(length)[None] < len(ids),
            states=padded[None],
            noise=torch.from_numpy(pi_inputs.first_noise()),
        )[0, :, : pi_inputs.ROBOT_ACTIONS].numpy()
    low, high = (stats["action"][name] for name in ("q01", "q99"))
    mean, std = (stats["action"][name] for name in ("mean", "std"))
    if family == "pi05":
        expected = (raw + 1) / 2 * (high - low + 1e-6) + low
    else:
        expected = raw * (std + 1e-6) + mean
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("family", FAMILIES)
def test_it_goes_back_bit_for_bit(tmp_path, family):
    source, out = brought(tmp_path, family)
    assert main(["export", str(out), str(tmp_path / "back"), "--format", "openpi"]) == 0
    ours, theirs = (load_file(f / "model.safetensors") for f in (tmp_path / "back", source))
    assert ours.keys() == theirs.keys()
    used = ours.keys() - set(OPENPI.unused)
    assert all(torch.equal(ours[name], theirs[name]) for name in used)
    assert not any(ours[name].any() for name in OPENPI.unused)
    stats, before = (
        json.loads((f / "norm_stats.json").read_text())["norm_stats"]
        for f in (tmp_path / "back" / "assets" / "arm", source / "assets" / "acme" / "arm")
    )
    for key, rows in before.items():
        assert stats[key] == {name: row[:-1] for name, row in rows.items()}
    read = OpenPiFormat().read(tmp_path / "back")
    assert read.horizon == pi_inputs.HORIZON


def test_what_is_not_in_the_files_is_said(tmp_path):
    source = openpi_folder(tmp_path / "theirs", "pi05")
    (source / "config.json").unlink()
    read = OpenPiFormat().read(source)
    assert read.horizon == read.model["n_action_steps"] == 50
    text = " ".join(read.notes)
    assert "chunks of 50 are assumed" in text
    assert "openpi's data config is in no file" in text
    assert "dimensions that openpi had only filled up with zeros were left out" in text


def test_bf16_weights_stay_so(tmp_path):
    source = openpi_folder(tmp_path / "theirs", "pi05")
    narrow = {name: t.bfloat16() for name, t in weights("pi05", OPENPI).items()}
    save_file(narrow, source / "model.safetensors")
    tensors = OpenPiFormat().read(source).tensors
    stored = tensors["llm_backbone.layers.0.mlp.up_proj.weight"]
    assert stored[tuple(slice(0, n) for n in stored.shape)].dtype == torch.bfloat16


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"time_mlp_in.bias": None}, r"1 missing \(time_mlp_in.bias\)"),
        ({"more": torch.zeros(1)}, r"1 of no use \(more\)"),
        ({"time_mlp_in.weight": torch.zeros(3, 24)}, r"time_mlp_in.weight: \(3, 24\), expected"),
        ({"action_out_proj.weight": None}, "action_out_proj.weight is missing"),
        ({"action_out_proj.weight": torch.zeros(3)}, r"has shape \(3,\)"),
    ],
)
def test_other_tensors_are_refused_by_name(tmp_path, change, words):
    source = openpi_folder(tmp_path / "theirs", "pi05")
    tensors = {**weights("pi05", OPENPI), **change}
    save_file({n: t for n, t in tensors.items() if t is not None}, source / "model.safetensors")
    with pytest.raises(CheckpointError, match=words):
        OpenPiFormat().read(source)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda s: s.pop("actions"), "'actions' has no mean, std, q01, q99; it has nothing"),
        (lambda s: s["state"].update(q01=None), "'state' has no q01; it has"),
        (lambda s: s["state"].update(q01=[0.0]), "are no rows of one length"),
        (lambda s: s["state"].update({key: [0.0] for key in s["state"]}), "is 0 throughout"),
    ],
)
def test_statistics_that_are_not_whole(tmp_path, change, words):
    source = openpi_folder(tmp_path / "theirs", "pi05")
    file = source / "assets" / "acme" / "arm" / "norm_stats.json"
    content = json.loads(file.read_text())
    change(content["norm_stats"])
    file.write_text(json.dumps(content))
    with pytest.raises(CheckpointError, match=words):
        OpenPiFormat().read(source)


def test_statistics_of_two_robots(tmp_path):
    source = openpi_folder(tmp_path / "theirs", "pi0")
    (source / "assets" / "other").mkdir()
    (source / "assets" / "other" / "norm_stats.json").write_text("{}")
    found = OpenPiFormat().read(source)
    assert (found.statistics, found.transforms) == ({"private": {}}, ())
    text = " ".join(found.notes)
    assert "statistics of several robots (acme/arm, other): choose one by --robot" in text
    chosen = OpenPiFormat().read(source, robot="acme/arm")
    alone = OpenPiFormat().read(openpi_folder(tmp_path / "alone", "pi0"))
    assert chosen.statistics == alone.statistics
    assert chosen.transforms == alone.transforms
    with pytest.raises(UsageError, match=r"--robot arm: .* It knows acme/arm, other"):
        OpenPiFormat().read(source, robot="arm")


@pytest.mark.parametrize("family", FAMILIES)
def test_a_camera_that_the_robot_lacks_is_as_one_that_is_masked(tmp_path, family, monkeypatch):
    """openpi gives the model an image of nothing, and masks it."""
    _, out = brought(tmp_path, family, ("top", "none", "right"))
    policy = load_policy(out)
    assert policy.cameras == ("top", "right")
    act, look, asked = policy.model.predict_action, policy.model.observe, []
    monkeypatch.setattr(policy.model, "observe", lambda **b: asked.append(b) or look(**b))
    images, state = pi_inputs.observation()
    images_by_camera = {"top": images["front"], "right": images["front"][::-1].copy()}
    policy.reset(pi_inputs.SEED)
    policy.predict_action(
        {"qpos": state, "images": images_by_camera, "task_description": "put it away"}
    )

    monkeypatch.undo()
    batch = {**asked[0], "noise": torch.ones(1, *policy.model.action_shape)}
    top, right = batch["images"].chunk(2, 1)
    masks = torch.tensor([[True, False, True]])
    with torch.no_grad():
        found = act(**batch)
        masked = torch.cat([top, -torch.ones_like(top), right], 1)
        expected = act(**{**batch, "images": masked, "img_masks": masks})
        turned = act(**{**batch, "images": torch.cat([right, top], 1)})
    torch.testing.assert_close(found, expected)
    assert not torch.allclose(found, turned)


def test_other_folders_are_not_recognised(tmp_path):
    assert OpenPiFormat().recognizes(openpi_folder(tmp_path / "theirs", "pi0"))
    assert not OpenPiFormat().recognizes(tmp_path)
    assert not OpenPiFormat().recognizes(tmp_path / "nowhere")


def test_sizes_that_lerobot_does_not_have_are_not_written_for_it(tmp_path, capsys):
    _, out = brought(tmp_path, "pi05")
    assert main(["export", str(out), str(tmp_path / "back"), "--format", "lerobot"]) != 0
    text = capsys.readouterr().err
    assert "LeRobot's policies have the sizes gemma_2b, gemma_300m, so400m" in text
