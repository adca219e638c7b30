"""Published folders: imported, acted with, written again, trained from."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from fluxvla_openvla.formats import OpenVLAFormat

from fluxvla_core import load_policy
from fluxvla_core.checkpoints.foreign import read_foreign
from fluxvla_core.cli.main import main
from fluxvla_core.errors import CheckpointError, ConfigError, UsageError
from fluxvla_core.operators import Camera, EmbodimentSpec, Joint

from . import published

JOINTS = (*"xyz", "roll", "pitch", "yaw", "gripper")
SEEN = {
    "image": np.tile(np.arange(64, dtype=np.uint8)[None, :, None], (48, 1, 3)),
    "wrist_image": np.full((48, 64, 3), 90, np.uint8),
}


def arm(folder, cameras=("image", "wrist_image")):
    """Seven numbers to move by, eight to know where it is, as LIBERO's."""

    def joints(names):
        return tuple(Joint(name, "normalized", -1.0, 1.0, 9.0, 9.0) for name in names)

    spec = EmbodimentSpec(
        "arm",
        joints(JOINTS),
        tuple(Camera(name, 48, 64) for name in cameras),
        20.0,
        state_joints=joints(f"s{i}" for i in range(8)),
    )
    file = folder / "arm.json"
    file.write_text(json.dumps(spec.to_dict()))
    return str(file)


def run(*words):
    return main([str(word) for word in words])


def tensors_of(path):
    from safetensors.torch import load_file

    return load_file(path)


@pytest.mark.parametrize("settings", [{}, {"head": "diffusion"}, {"use_film": True}])
def test_an_imported_oft_acts_as_its_model(tmp_path, capsys, settings):
    model = published.oft(tmp_path / "theirs", **settings)
    out = tmp_path / "ours"
    words = ["--embodiment", arm(tmp_path)] if settings == {} else []
    assert run("import-checkpoint", tmp_path / "theirs", out, *words) == 0
    said = capsys.readouterr().out
    assert "OpenVLAOFT" in said
    assert "cameras image, wrist_image; chunks of 8 actions at 20 Hz" in said
    found, expected = tensors_of(out / "model.safetensors"), model.state_dict()
    assert found.keys() == expected.keys()
    for name, tensor in expected.items():
        assert torch.equal(found[name], tensor.bfloat16()), name
    if not words:
        return
    policy = load_policy(out)
    policy.reset(0)
    chunk = policy.predict_action(
        {"qpos": np.zeros(8, np.float32), "images": SEEN, "task_description": "pick up the cup"}
    )
    assert chunk.shape == (8, 7)
    # LIBERO's gripper is opened or closed, nothing between.
    assert set(chunk[:, 6]) <= {-1.0, 1.0}
    model.load_state_dict({n: t.bfloat16().float() for n, t in expected.items()})
    batch = policy._prepare(
        {"qpos": np.zeros(8), "images": SEEN, "task_description": "pick up the cup"}
    )
    with torch.no_grad():
        plain = model.eval().predict_action(
            **{k: batch[k] for k in ("images", "lang_tokens", "lang_masks", "states")}
        )
    scaled = 0.5 * (plain[0, :, :6].double() + 1) * 2.0 - 0.5
    np.testing.assert_allclose(chunk[:, :6], scaled, atol=1e-5)


def test_openvla_is_imported_and_written_back_bit_for_bit(tmp_path, capsys):
    published.openvla(tmp_path / "theirs")
    assert run("import-checkpoint", tmp_path / "theirs", tmp_path / "ours") == 0
    assert "chunks of 1 actions at 5 Hz" in capsys.readouterr().out
    assert run("export", tmp_path / "ours", tmp_path / "back", "--format", "openvla") == 0
    reader = OpenVLAFormat()
    first, again = (reader.read(tmp_path / n, str(tmp_path / "theirs")) for n in ("theirs", "back"))
    assert first.tensors.keys() == again.tensors.keys()
    for name, stored in first.tensors.items():
        whole = tuple(slice(0, n) for n in stored.shape)
        assert torch.equal(stored[whole], again.tensors[name][whole])
    assert again.model == {**first.model, **again.model}
    assert again.statistics == first.statistics


@pytest.mark.parametrize("settings", [{}, {"head": "diffusion"}, {"use_film": True}])
def test_oft_is_written_back_bit_for_bit(tmp_path, settings):
    published.oft(tmp_path / "theirs", **settings)
    run("import-checkpoint", tmp_path / "theirs", tmp_path / "ours")
    assert run("export", tmp_path / "ours", tmp_path / "back", "--format", "openvla") == 0
    again = tmp_path / "again"
    tokenizer = ["--tokenizer", tmp_path / "theirs"]
    assert run("import-checkpoint", tmp_path / "back", again, *tokenizer) == 0
    first, second = (tensors_of(p / "model.safetensors") for p in (tmp_path / "ours", again))
    assert first.keys() == second.keys()
    assert all(torch.equal(first[name], second[name]) for name in first)
    before, after = (
        OpenVLAFormat().read(tmp_path / place, "tokenizer") for place in ("theirs", "back")
    )
    assert after.transforms == before.transforms
    assert (after.img_keys, after.horizon) == (before.img_keys, before.horizon)
    assert after.action_rate_hz == before.action_rate_hz


def test_the_native_layout_is_read(tmp_path):
    model = published.native(tmp_path / "theirs")
    found = OpenVLAFormat().read(tmp_path / "theirs")
    assert found.model["language"]["hidden_size"] == 32
    assert found.tensors.keys() == model.state_dict().keys()
    assert all(torch.equal(found.tensors[n], t) for n, t in model.state_dict().items())


def test_unmerged_lora_matrices_count(tmp_path):
    published.oft(tmp_path / "theirs", use_film=True)
    file = next((tmp_path / "theirs").glob("vision_backbone--*"))
    content = torch.load(file, weights_only=True)
    stem = "vision_backbone.featurizer.blocks.1.block.attn.qkv"
    content[f"{stem}.lora_B.default.weight"] += 0.25
    torch.save(content, file)
    tensors = OpenVLAFormat().read(tmp_path / "theirs").tensors
    base = content[f"{stem}.base_layer.weight"].float()
    found = tensors["vision_backbone.featurizer.blocks.1.attn.qkv.weight"]
    # 32 products of 0.25 and 1, times 16 / 32.
    torch.testing.assert_close(found.float(), (base + 4.0).bfloat16().float())


def test_of_several_statistics_one_is_chosen(tmp_path, capsys):
    both = {"bridge_orig": published.entry(), "fractal": published.entry()}
    both["fractal"]["action"]["q99"] = [1.25] * 7
    published.openvla(tmp_path / "theirs", both)
    source, out = tmp_path / "theirs", tmp_path / "ours"
    words = ["--embodiment", arm(tmp_path, ("image",)), "--rate", "5"]
    assert run("import-checkpoint", source, out, *words) == 0
    assert "statistics of 2 datasets: bridge_orig, fractal" in capsys.readouterr().out
    with pytest.raises(ConfigError, match=r"bridge_orig.*fractal"):
        load_policy(out)
    sidecar = json.loads((source / "fluxvla_openvla.json").read_text())
    (source / "fluxvla_openvla.json").write_text(json.dumps({**sidecar, "unnorm_key": "fractal"}))
    assert run("import-checkpoint", source, tmp_path / "chosen", *words) == 0
    read = OpenVLAFormat().read
    found, chosen = read(source), OpenVLAFormat().read(source, robot="bridge_orig")
    for got, name in ((found, "fractal"), (chosen, "bridge_orig")):
        kept = {key: both[name][key] for key in ("proprio", "action")}
        assert got.statistics == {"private": kept}
    assert chosen.action_rate_hz == 5.0  # Bridge's
    capsys.readouterr()
    words += ["--robot", "bridge"]
    assert run("import-checkpoint", source, tmp_path / "other", *words) == 2
    told = capsys.readouterr().err
    assert "--robot bridge: the checkpoint knows no such robot; did you mean 'bridge_orig'" in told
    assert "It knows bridge_orig, fractal" in told
    with pytest.raises(UsageError, match="needs the images of all cameras"):
        read_foreign(source, absent=("image",))
    policy = load_policy(tmp_path / "chosen")
    policy.reset(0)
    images = {"image": SEEN["image"]}
    chunk = policy.predict_action(
        {"qpos": np.zeros(8, np.float32), "images": images, "task_description": "put it down"}
    )
    assert chunk.shape == (1, 7)
    assert (chunk[:, :6] >= -0.5).all()
    assert (chunk[:, :6] <= 1.5).all()


def test_other_folders_are_not_recognised(tmp_path):
    known = OpenVLAFormat()
    assert not known.recognizes(tmp_path)
    (tmp_path / "config.json").write_text("{")
    assert not known.recognizes(tmp_path)
    (tmp_path / "config.json").write_text('["openvla"]')
    assert not known.recognizes(tmp_path)
    (tmp_path / "config.json").write_text('{"model_type": "llama"}')
    assert not known.recognizes(tmp_path)


def change(folder, name, **values):
    file = folder / name
    file.write_text(json.dumps({**json.loads(file.read_text()), **values}))


def damage(folder, what):
    if what == "unnorm_key":
        change(folder, "fluxvla_openvla.json", unnorm_key="berkeley")
    elif what == "unknown key":
        change(folder, "fluxvla_openvla.json", unormkey="x")
    elif what == "towers":
        change(folder, "config.json", vision_backbone_id="siglip-vit-so400m")
    elif what == "bins":
        change(folder, "config.json", n_action_bins=512)
    elif what == "statistics":
        (folder / "dataset_statistics.json").unlink()
    elif what == "tokenizer":
        (folder / "tokenizer.json").unlink()
    elif what == "two heads":
        file = folder / "action_head--150000_checkpoint.pt"
        (folder / "action_head--5_checkpoint.pt").write_bytes(file.read_bytes())
    elif what == "code":
        torch.save({"x": Evil()}, folder / "action_head--150000_checkpoint.pt")
    elif what == "no tensors":
        torch.save({"x": 3}, folder / "action_head--150000_checkpoint.pt")
    elif what == "horizon":
        statistics = json.loads((folder / "dataset_statistics.json").read_text())
        renamed = {"kitchen": next(iter(statistics.values()))}
        (folder / "dataset_statistics.json").write_text(json.dumps(renamed))


class Evil:
    pass


@pytest.mark.parametrize(
    ("what", "words"),
    [
        ("unnorm_key", "'berkeley' is not in the statistics; they have libero_spatial_no_noops"),
        ("unknown key", "unknown key 'unormkey'; known are unnorm_key"),
        ("towers", "vision_backbone_id is 'siglip-vit-so400m'"),
        ("bins", "n_action_bins is 512; only 256 is built here"),
        ("statistics", "there are no statistics of actions"),
        ("tokenizer", "the folder has no tokenizer.json"),
        ("two heads", "several files of action_head: action_head--150000_checkpoint.pt, action"),
        ("code", "it cannot be read as tensors"),
        ("no tensors", "'x' is not a tensor"),
        ("horizon", "the dataset's name 'kitchen' does not say either"),
    ],
)
def test_folders_that_cannot_be_read(tmp_path, what, words):
    published.oft(tmp_path / "theirs")
    damage(tmp_path / "theirs", what)
    with pytest.raises(CheckpointError, match=words):
        OpenVLAFormat().read(tmp_path / "theirs")


def test_a_missing_tensor_is_named(tmp_path, capsys):
    published.oft(tmp_path / "theirs")
    file = tmp_path / "theirs" / "action_head--150000_checkpoint.pt"
    content = torch.load(file, weights_only=True)
    del content["module.model.fc1.bias"]
    torch.save(content, file)
    assert run("import-checkpoint", tmp_path / "theirs", tmp_path / "ours") == 2
    assert "action_head.model.fc1.bias" in capsys.readouterr().err


def test_openvla_gets_new_heads(tmp_path, capsys):
    model = published.openvla(tmp_path / "openvla")
    out = tmp_path / "start"
    assert (
        run(
            "openvla-oft",
            tmp_path / "openvla",
            out,
            "--robot",
            "aloha",
            "--action-dim",
            "14",
            "--state-dim",
            "14",
            "--film",
        )
        == 0
    )
    # 16 of the head, 4 of the projector, and for 6 blocks two layers each.
    assert "; 44 are new" in capsys.readouterr().out
    found = OpenVLAFormat().read(out)
    table = {k: found.model[k] for k in ("type", "horizon", "action_dim", "state_dim", "use_film")}
    assert table == {
        "type": "OpenVLAOFT",
        "horizon": 25,
        "action_dim": 14,
        "state_dim": 14,
        "use_film": True,
    }
    assert found.img_keys == ("image", "left_wrist_image", "right_wrist_image")
    assert found.action_rate_hz == 25.0
    assert {t["type"]: t for t in found.transforms}["NormalizeOpenVLA"]["bounds"] == "min_max"
    for name, tensor in model.state_dict().items():
        kept = found.tensors[name]
        kept = (
            kept if isinstance(kept, torch.Tensor) else kept[tuple(slice(0, n) for n in kept.shape)]
        )
        assert torch.equal(kept, tensor.bfloat16()), name
    assert found.tensors["action_head.model.fc1.weight"].float().std() > 0.01
    assert run("import-checkpoint", out, tmp_path / "ours") == 0
    assert run("openvla-oft", out, tmp_path / "more") == 2
    assert "the source is OpenVLAOFT already" in capsys.readouterr().err
    assert run("openvla-oft", tmp_path / "openvla", out) == 2
    assert run("openvla-oft", tmp_path / "nothing", tmp_path / "more") == 2
    assert "is no folder of OpenVLA" in capsys.readouterr().err
    assert not list(tmp_path.glob("*.partial"))
