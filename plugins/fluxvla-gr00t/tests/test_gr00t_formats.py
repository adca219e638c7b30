"""Published folders of GR00T become checkpoints that act as the model does."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from fluxvla_gr00t import robots
from fluxvla_gr00t.formats import GR00TN15Format, GR00TN17Format
from fluxvla_gr00t.lerobot_format import LeRobotGR00TFormat
from safetensors.torch import load_file, save_file

from fluxvla_core.checkpoints.foreign import read_foreign
from fluxvla_core.cli.main import main
from fluxvla_core.errors import CheckpointError, UsageError
from fluxvla_core.models import load_policy
from tests.oracles import fill

from . import published
from .published import CAMERAS, PLACE, SIDES, joined

FORMATS = {"n1.5": GR00TN15Format, "n1.7": GR00TN17Format}
TASK = "Lift the cup"


@pytest.fixture(autouse=True)
def numbers(monkeypatch):
    """The tiny head has layers for three robots."""
    monkeypatch.setitem(robots.N15_EMBODIMENTS, "new_embodiment", 2)


SAVED = {"gr00t": published.folder, "lerobot": published.lerobot_folder}


def chat(version, places):
    if version == "n1.5":
        seen = "".join(f"<image {i}><img>{'<IMG_CONTEXT>' * places}</img>" for i in (1, 2))
        return (
            "<|im_start|>system\nYou are a helpful assistant.<|im_end|>\n"
            f"<|im_start|>user\n{seen}['{TASK}']<|im_end|>\n<|im_start|>assistant\n"
        )
    seen = f"<|vision_start|>{'<|image_pad|>' * places}<|vision_end|>" * 2
    return f"<|im_start|>user\n{seen}{TASK.lower()}<|im_end|>\n"


def scaled(kind, low, high, values, back=False):
    low, high = joined(kind, low), joined(kind, high)
    low, high = np.where(low == high, low - 1, low), np.where(low == high, high + 1, high)
    if back:
        return (values + 1) / 2 * (high - low) + low
    return 2 * (values - low) / (high - low) - 1


@pytest.mark.parametrize("project", SAVED)
@pytest.mark.parametrize("version", ["n1.5", "n1.7"])
def test_an_imported_checkpoint_acts_as_the_model_does(
    version, project, tmp_path, monkeypatch, capsys
):
    side = SIDES[version]
    source = SAVED[project](version, tmp_path / "theirs", monkeypatch)
    words = published.tokenizer(version, tmp_path / "words")
    (tmp_path / "arm.json").write_text(json.dumps(published.robot(side).to_dict()))
    options = ["--tokenizer", str(words), "--embodiment", str(tmp_path / "arm.json")]
    rate = [] if (version, project) == ("n1.5", "gr00t") else ["--rate", "20"]
    out = tmp_path / "ours"

    assert main(["import-checkpoint", str(source), str(out), *options, *rate]) == 0

    assert "cameras front, wrist; chunks of 6 actions at 20 Hz; arm" in capsys.readouterr().out
    policy = load_policy(out)
    policy.reset(5)
    states = np.array([0.3, -0.2, 0.1, 0.4, 0.2], np.float32)
    images = {
        camera: fill.integers(camera, (side, side, 3), 256).astype(np.uint8) for camera in CAMERAS
    }
    chunk = policy.predict_action({"qpos": states, "images": images, "task_description": TASK})

    # The same by hand.
    from tokenizers import Tokenizer

    ids = Tokenizer.from_file(str(words / "tokenizer.json")).encode(chat(version, 4)).ids
    assert ids.count(PLACE) == 8
    planes = np.concatenate([images[c].transpose(2, 0, 1) for c in CAMERAS])
    percentiles = (version, project) == ("n1.7", "gr00t")
    low, high = ("q01", "q99") if percentiles else ("min", "max")
    state = scaled("state", low, high, states)
    if version == "n1.7":
        state = np.clip(state, -1, 1)
    noise = np.random.Generator(np.random.Philox(key=np.array([5, 0], np.uint64)))
    with torch.no_grad():
        actions = published.model(version).predict_action(
            images=torch.from_numpy(planes / 255 * 2 - 1).float()[None],
            lang_tokens=torch.tensor([ids]),
            lang_masks=torch.ones(1, len(ids), dtype=torch.bool),
            states=torch.from_numpy(np.pad(state, (0, 2))).float()[None],
            noise=torch.from_numpy(noise.standard_normal((1, 6, 5), dtype=np.float32)),
            embodiment_ids=torch.tensor([2]),
        )
    expected = scaled("action", low, high, actions[0].double().numpy(), back=True)
    np.testing.assert_allclose(chunk, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("version", ["n1.5", "n1.7"])
def test_a_checkpoint_of_several_robots_is_to_train_on(version, tmp_path, monkeypatch):
    source = published.folder(version, tmp_path / "theirs", monkeypatch, ("gr1", "oxe_droid"))
    found = FORMATS[version]().read(source)
    assert found.statistics == {"private": {}}
    assert found.model["embodiment_id"] == 0
    assert "knows several robots (gr1, oxe_droid): choose one by --robot" in found.notes[0]
    assert len(found.tensors) == len(published.model(version).state_dict())


@pytest.mark.parametrize("version", ["n1.5", "n1.7"])
def test_of_several_robots_one_is_chosen(version, tmp_path, monkeypatch):
    monkeypatch.setitem(robots.N15_EMBODIMENTS, "gr1", 1)
    tags = ("gr1", "new_embodiment", "oxe_droid")
    source = published.folder(version, tmp_path / "theirs", monkeypatch, tags)
    file = source / "experiment_cfg" / "metadata.json"
    if version == "n1.7":
        published.write(source / "embodiment_id.json", {"gr1": 1, "new_embodiment": 2})
        file = source / "statistics.json"
    content = json.loads(file.read_text())
    own = content["gr1"] if version == "n1.7" else content["gr1"]["statistics"]
    own["action"]["arm"] = {name: [-7.0] * 4 for name in own["action"]["arm"]}
    own["action"]["arm"] |= {"max": [8.0] * 4, "q99": [8.0] * 4}
    file.write_text(json.dumps(content))

    left, chosen = FORMATS[version]().read(source), FORMATS[version]().read(source, robot="gr1")

    assert (left.model["embodiment_id"], chosen.model["embodiment_id"]) == (2, 1)
    low = "q01" if version == "n1.7" else "min"
    assert chosen.statistics["private"]["action"][low] == [-7.0] * 4 + [joined("action", low)[4]]
    assert left.statistics["private"]["action"][low] == joined("action", low).tolist()
    with pytest.raises(UsageError, match=r"mean 'gr1'. It knows gr1, new_embodiment, oxe_droid"):
        FORMATS[version]().read(source, robot="gr2")


@pytest.mark.parametrize("project", SAVED)
@pytest.mark.parametrize("version", ["n1.5", "n1.7"])
def test_a_camera_that_the_robot_lacks_has_no_place(version, project, tmp_path, monkeypatch):
    source = SAVED[project](version, tmp_path / "theirs", monkeypatch)
    kind = LeRobotGR00TFormat if project == "lerobot" else FORMATS[version]
    found, both = kind().read(source, absent=("front",)), kind().read(source)
    assert (found.img_keys, both.img_keys) == (("wrist",), CAMERAS)
    prompts, of_both = (
        next(table for table in read.transforms if "max_len" in table) for read in (found, both)
    )
    if version == "n1.5":
        assert (prompts["num_images"], of_both["num_images"]) == (1, 2)
    assert prompts["max_len"] < of_both["max_len"]
    with pytest.raises(UsageError, match="no such camera; it has front, wrist"):
        kind().read(source, absent=("top",))


def test_lerobots_folders_are_of_one_robot(tmp_path, monkeypatch):
    source = published.lerobot_folder("n1.7", tmp_path / "theirs", monkeypatch)
    with pytest.raises(UsageError, match=r"--robot gr1: .* is of one robot, which has no name"):
        read_foreign(source, "lerobot", robot="gr1")


@pytest.mark.parametrize("version", ["n1.5", "n1.7"])
def test_each_format_knows_its_own_folders(version, tmp_path, monkeypatch):
    source = published.folder(version, tmp_path / "theirs", monkeypatch)
    assert [v for v, kind in FORMATS.items() if kind().recognizes(source)] == [version]
    config = json.loads((source / "config.json").read_text())
    assert not LeRobotGR00TFormat().recognizes(source)
    (source / "config.json").write_text(
        json.dumps({**config, "type": "groot", "input_features": {}})
    )
    assert not any(kind().recognizes(source) for kind in FORMATS.values())
    assert LeRobotGR00TFormat().recognizes(source)
    (source / "config.json").write_text("[")
    every = (*FORMATS.values(), LeRobotGR00TFormat)
    assert not any(kind().recognizes(source) for kind in every)
    assert not any(kind().recognizes(tmp_path / "none") for kind in every)


def test_actions_counted_from_the_state_are_read(tmp_path, monkeypatch):
    source = published.folder("n1.7", tmp_path / "theirs", monkeypatch)
    relative_to_state(source, {"rep": "RELATIVE", "type": "NON_EEF", "format": "DEFAULT"})
    found = GR00TN17Format().read(source)
    entry = found.statistics["private"]["action"]
    assert entry["relative"] == [1.0, 1.0, 1.0, 1.0, 0.0]
    # Four rows were written; the chunk has six, whose last ones are the fourth again.
    assert np.shape(entry["q01"]) == np.shape(entry["q99"]) == (6, 5)
    assert entry["q01"][3][:4] == entry["q01"][5][:4] == [-4.0] * 4
    assert entry["q99"][0][:4] == [1.0] * 4
    assert entry["q99"][0][4] == pytest.approx(joined("action", "q99")[4])
    assert found.transforms


def test_grippers_of_libero_are_not_converted(tmp_path, monkeypatch):
    source = published.folder("n1.7", tmp_path / "theirs", monkeypatch, ("libero_sim",))
    found = GR00TN17Format().read(source)
    assert found.statistics == {"private": {}}
    assert "those of LIBERO's simulator 1 to -1" in found.notes[0]


def test_relative_poses_of_a_hand_are_to_train_on(tmp_path, monkeypatch):
    source = published.folder("n1.7", tmp_path / "theirs", monkeypatch)
    relative_to_state(source, {"rep": "RELATIVE", "type": "EEF", "format": "XYZ_ROT6D"})
    found = GR00TN17Format().read(source)
    assert found.statistics == {"private": {}}
    assert "its actions arm are poses relative to the hand's" in found.notes[0]


def test_relative_actions_of_states_in_another_order_are_to_train_on(tmp_path, monkeypatch):
    source = published.folder("n1.7", tmp_path / "theirs", monkeypatch)
    relative_to_state(source, {"rep": "RELATIVE", "type": "NON_EEF"}, states=["grip", "arm"])
    found = GR00TN17Format().read(source)
    assert found.statistics == {"private": {}}
    assert "states in another order" in found.notes[0]


def relative_to_state(source, config, states=("arm", "grip")):
    """Make the arm's actions relative, with statistics of four steps."""
    file = source / "processor_config.json"
    content = json.loads(file.read_text())
    kwargs = content["processor_kwargs"]
    kwargs["use_relative_action"] = True
    modalities = kwargs["modality_configs"]["new_embodiment"]
    modalities["action"]["action_configs"][0] = config
    modalities["state"]["modality_keys"] = list(states)
    file.write_text(json.dumps(content))
    file = source / "statistics.json"
    content = json.loads(file.read_text())
    rows = [[float(step + 1)] * 4 for step in range(4)]
    lows = [[-float(step + 1)] * 4 for step in range(4)]
    group = {"min": lows, "max": rows, "mean": rows, "std": rows, "q01": rows, "q99": rows}
    content["new_embodiment"]["relative_action"] = {"arm": group}
    file.write_text(json.dumps(content))


def test_what_lerobot_knows_of_groups_of_joints_is_read(tmp_path, monkeypatch):
    groups = {"state": published.statistics("state"), "action": published.statistics("action")}
    modalities = {
        "video": {"modality_keys": ["wrist_image", "front"], "delta_indices": [0]},
        "state": {"modality_keys": ["arm", "grip"]},
        "action": {"modality_keys": ["arm", "grip"], "action_configs": [{}, {}]},
    }
    pack = {
        "raw_stats": groups,
        "modality_config": modalities,
        "use_percentiles": True,
        "video_modality_keys": ["wrist", "front"],
    }
    source = published.lerobot_folder("n1.7", tmp_path / "theirs", monkeypatch, **pack)
    decode = {"registry_name": "groot_n1_7_action_decode_v1", "config": {}}
    published.write(source / "policy_postprocessor.json", {"steps": [decode]})
    with pytest.raises(CheckpointError, match="is True, of the postprocessor False"):
        LeRobotGR00TFormat().read(source)
    decode["config"] = {"use_percentiles": True}
    published.write(source / "policy_postprocessor.json", {"steps": [decode]})
    found = LeRobotGR00TFormat().read(source)
    assert found.img_keys == ("wrist", "front")
    assert found.model["embodiment_id"] == 2
    entry = found.statistics["private"]["action"]
    np.testing.assert_allclose(entry["q99"], joined("action", "q99"))


@pytest.mark.parametrize(
    ("step", "words"),
    [
        (
            {
                "registry_name": "groot_action_unpack_unnormalize_v2",
                "config": {"libero_gripper_action": True},
            },
            "its gripper's actions are 0 to 1, and those of LIBERO's",
        ),
        ({"registry_name": "absolute_actions_processor"}, "counts its actions from the state"),
    ],
)
def test_what_lerobot_does_to_actions_and_is_not_done_here(step, words, tmp_path, monkeypatch):
    source = published.lerobot_folder("n1.7", tmp_path / "theirs", monkeypatch)
    published.write(source / "policy_postprocessor.json", {"steps": [step]})
    found = LeRobotGR00TFormat().read(source)
    assert found.statistics == {"private": {}}
    assert words in found.notes[-1]


def test_a_processor_of_another_policy_is_refused(tmp_path, monkeypatch):
    source = published.lerobot_folder("n1.7", tmp_path / "theirs", monkeypatch)
    steps = [{"registry_name": "device_processor"}]
    published.write(source / "policy_preprocessor.json", {"steps": steps})
    with pytest.raises(CheckpointError, match="has the steps device_processor; one of groot_pack"):
        LeRobotGR00TFormat().read(source)


@pytest.mark.parametrize("version", ["n1.5", "n1.7"])
@pytest.mark.parametrize("stem", ["policy_preprocessor", "policy_postprocessor"])
def test_a_step_that_is_not_done_here_is_refused(version, stem, tmp_path, monkeypatch):
    """It would change inputs or commands, and be lost silently."""
    source = published.lerobot_folder(version, tmp_path / "theirs", monkeypatch)
    file = source / f"{stem}.json"
    steps = json.loads(file.read_text())["steps"]
    LeRobotGR00TFormat().read(source)
    for name in ("normalizer_processor", "image_crop_resize_processor"):
        published.write(file, {"steps": [*steps, {"registry_name": name, "config": {}}]})
        with pytest.raises(CheckpointError, match=f"the step '{name}' .* not known") as caught:
            LeRobotGR00TFormat().read(source)
        assert str(file) in str(caught.value)
    published.write(file, {"steps": [*steps, {"class": "mine.Blur"}]})
    with pytest.raises(CheckpointError, match=r"the step 'mine\.Blur' .* not known here"):
        LeRobotGR00TFormat().read(source)


@pytest.mark.parametrize(
    ("version", "pack", "words"),
    [
        ("n1.7", {"normalize_min_max": False}, "normalize_min_max is False"),
        ("n1.7", {"state_horizon": 2}, "state_horizon is 2, 1 is known here"),
        ("n1.7", {"video_horizon": 3}, "video_horizon is 3, 1 is known here"),
        ("n1.5", {"formalize_language": True}, "formalize_language is True; False is known"),
    ],
)
def test_settings_of_a_step_that_are_not_done_here(version, pack, words, tmp_path, monkeypatch):
    source = published.lerobot_folder(version, tmp_path / "theirs", monkeypatch, **pack)
    with pytest.raises(CheckpointError, match=words):
        LeRobotGR00TFormat().read(source)


@pytest.mark.parametrize("name", ["image_target_size", "image_crop_size"])
def test_images_that_are_not_square_are_refused(name, tmp_path, monkeypatch):
    source = published.lerobot_folder("n1.7", tmp_path / "lerobot's", monkeypatch)
    file = source / "policy_preprocessor.json"
    content = json.loads(file.read_text())
    content["steps"][3]["config"][name] = [64, 48]
    published.write(file, content)
    with pytest.raises(CheckpointError, match=rf"{name} \[64, 48\] is not square"):
        LeRobotGR00TFormat().read(source)
    source = published.folder("n1.7", tmp_path / "nvidia's", monkeypatch)
    file = source / "processor_config.json"
    content = json.loads(file.read_text())
    content["processor_kwargs"][name] = [64, 48]
    published.write(file, content)
    with pytest.raises(CheckpointError, match=rf"{name} \[64, 48\] is not square"):
        FORMATS["n1.7"]().read(source)


@pytest.mark.parametrize(
    ("kind", "settings", "words"),
    [
        ("state", {"delta_indices": [-1, 0]}, "several states at once"),
        ("state", {"sin_cos_embedding_keys": ["arm"]}, "groups arm are normalised in another"),
        ("state", {"mean_std_embedding_keys": ["grip"]}, "groups grip are normalised in another"),
        ("action", {"mean_std_embedding_keys": ["grip"]}, "groups grip are normalised in another"),
    ],
)
def test_groups_that_are_normalised_by_themselves(kind, settings, words, tmp_path, monkeypatch):
    """It can be trained on; acting by the others' formula would be other numbers."""
    source = published.folder("n1.7", tmp_path / "theirs", monkeypatch)
    file = source / "processor_config.json"
    content = json.loads(file.read_text())
    kwargs = content["processor_kwargs"]
    kwargs["apply_sincos_state_encoding"] = "sin_cos_embedding_keys" in settings
    kwargs["modality_configs"]["new_embodiment"][kind].update(settings)
    published.write(file, content)
    found = FORMATS["n1.7"]().read(source)
    assert found.statistics == {"private": {}}
    assert words in found.notes[0]


def test_cameras_that_lerobot_renames_keep_the_robots_name(tmp_path, monkeypatch):
    source = published.lerobot_folder("n1.7", tmp_path / "theirs", monkeypatch)
    file = source / "policy_preprocessor.json"
    steps = json.loads(file.read_text())["steps"]
    names = {"observation.images.top": "observation.images.front"}
    steps[0]["config"]["rename_map"] = names
    published.write(file, {"steps": steps})
    assert LeRobotGR00TFormat().read(source).img_keys == ("top", "wrist")
    steps[0]["config"]["rename_map"] = {"a": 3}
    published.write(file, {"steps": steps})
    with pytest.raises(CheckpointError, match=r"rename_map is \{'a': 3\}, no table of names"):
        LeRobotGR00TFormat().read(source)


def test_relative_actions_that_lerobot_counts_itself(tmp_path, monkeypatch):
    source = published.lerobot_folder("n1.7", tmp_path / "theirs", monkeypatch)
    file = source / "policy_preprocessor.json"
    steps = json.loads(file.read_text())["steps"]
    for enabled in (True, False):
        step = {"registry_name": "relative_actions_processor", "config": {"enabled": enabled}}
        published.write(file, {"steps": [*steps, step]})
        assert bool(LeRobotGR00TFormat().read(source).statistics["private"]) is not enabled


@pytest.mark.parametrize(
    ("version", "file", "change", "words"),
    [
        ("n1.5", "config.json", {"backbone_cfg": {"select_layer": 2, "project_to_dim": 8}}, "is 8"),
        ("n1.7", "config.json", {"add_pos_embed": False}, "add_pos_embed is False, True is known"),
        ("n1.7", "config.json", {"state_history_length": 2}, "state_history_length is 2, 1 is"),
        ("n1.7", "config.json", {"action_horizon": "6"}, "action_horizon is '6', a whole number"),
        ("n1.7", "embodiment_id.json", {"new_embodiment": None}, "'new_embodiment' has no number"),
        ("n1.7", "statistics.json", {"new_embodiment": {}}, "state: no table"),
        ("n1.7", "processor_config.json", {"processor_kwargs": 1}, "are no table"),
    ],
)
def test_what_is_not_known_is_refused(version, file, change, words, tmp_path, monkeypatch):
    source = published.folder(version, tmp_path / "theirs", monkeypatch)
    content = json.loads((source / file).read_text())
    (source / file).write_text(json.dumps({**content, **change}))
    with pytest.raises(CheckpointError, match=words):
        FORMATS[version]().read(source)


@pytest.mark.parametrize("version", ["n1.5", "n1.7"])
def test_tensors_that_do_not_fit_are_named(version, tmp_path, monkeypatch):
    source = published.folder(version, tmp_path / "theirs", monkeypatch)
    tensors = load_file(source / "model.safetensors")
    tensors["more"] = tensors.pop("action_head.vlln.weight")
    save_file(tensors, source / "model.safetensors")
    with pytest.raises(CheckpointError) as caught:
        FORMATS[version]().read(source)
    assert "1 missing: action_head.vlln.weight" in str(caught.value)
    assert "1 unexpected: more" in str(caught.value)
