"""The configs of this family are sound, and the specification's own one acts."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from fluxvla_gr00t import robots

from fluxvla_core.cli.main import main
from fluxvla_core.data import LeRobotWriter
from fluxvla_core.models import load_policy
from fluxvla_core.operators import Camera, Continuation, EmbodimentSpec, Joint
from tests.policies.benched import DIVIDED, stages_of

from . import published

CONFIGS = Path(__file__).parents[3] / "configs"
# The section ``inference`` of configs/gr00t/gr00t_eagle_3b_aloha_full_finetune.py, as the tutorial
# "Adding Custom Engines" has it.
SPECIFIED = """
inference = dict(
    type='AlohaInferenceRunner',
    seed=7,
    task_descriptions={
        '1': 'place it on the blue plate with right arm',
        '2': 'pick up the green bowl with right arm',
    },
    dataset=dict(
        type='PrivateInferenceDataset',
        embodiment_id=0,
        img_keys=['cam_high', 'cam_left_wrist', 'cam_right_wrist'],
        transforms=[
            dict(
                type='ProcessPromptsWithImage',
                max_len=900,
                num_images=3,
                tokenizer=dict(
                    type='PretrainedTokenizer',
                    model_path=
                    '/path/to/models/eagle2_hg_model',
                )),
            dict(type='ResizeImages', height=224, width=224),
            dict(
                type='NormalizeImages',
                means=[[123.515625, 116.04492188, 103.59375],
                       [123.515625, 116.04492188, 103.59375],
                       [123.515625, 116.04492188, 103.59375]],
                stds=[[58.27148438, 57.02636719, 57.27539062],
                      [58.27148438, 57.02636719, 57.27539062],
                      [58.27148438, 57.02636719, 57.27539062]]),
            dict(
                type='NormalizeStatesAndActions',
                state_dim=64,
                state_key='proprio',
                action_key='action',
                norm_type='mean_std'),
        ]),
    denormalize_action=dict(
        type='DenormalizePrivateAction',
        norm_type='mean_std',
        action_dim=14),
    operator=dict(
        type='AlohaOperator',
        img_front_topic='/camera_f/color/image_raw',
        img_left_topic='/camera_l/color/image_raw',
        img_right_topic='/camera_r/color/image_raw',
        img_front_depth_topic='/camera_f/depth/image_raw',
        img_left_depth_topic='/camera_l/depth/image_raw',
        img_right_depth_topic='/camera_r/depth/image_raw',
        puppet_arm_left_cmd_topic='/master/joint_left',
        puppet_arm_right_cmd_topic='/master/joint_right',
        puppet_arm_left_topic='/puppet/joint_left',
        puppet_arm_right_topic='/puppet/joint_right',
        robot_base_topic='/odom_raw',
        robot_base_cmd_topic='/cmd_vel'))
"""


@pytest.mark.parametrize("name", ["gr00t_n15_aloha", "gr00t_n15_ur", "gr00t_n17_libero"])
def test_configs_have_no_problems(name, capsys):
    assert main(["config", "check", str(CONFIGS / f"{name}.py")]) == 0
    assert "no problems" in capsys.readouterr().out


def test_the_specification_s_configuration_acts(tmp_path, monkeypatch, capsys):
    words = published.tokenizer("n1.5", tmp_path / "eagle2_hg_model")
    text = SPECIFIED.replace("/path/to/models/eagle2_hg_model", str(words))
    (tmp_path / "aloha.py").write_text(text)
    assert main(["config", "check", str(tmp_path / "aloha.py")]) == 0

    policy = load_policy(aloha(tmp_path, words, monkeypatch), **specified(text))
    policy.reset(0)
    sizes = {"cam_high": (480, 640), "cam_left_wrist": (480, 640), "cam_right_wrist": (480, 640)}
    rng = np.random.default_rng(0)
    observation = {
        "qpos": rng.normal(size=14).astype(np.float32),
        "images": {n: rng.integers(0, 256, (*s, 3), dtype=np.uint8) for n, s in sizes.items()},
        "task_description": "place it on the blue plate with right arm",
    }
    first = policy.predict_action(observation)
    assert first.shape == (6, 14)
    assert np.isfinite(first).all()
    policy.reset(0)
    other = {**observation, "task_description": "pick up the green bowl with right arm"}
    assert np.abs(policy.predict_action(other) - first).max() > 1e-6

    # Real-time chunking: the first two actions are being executed, and the others may change.
    weights = np.array([1.0, 1.0, 0.5, 0.0, 0.0, 0.0])
    rest = Continuation(actions=first + 0.1, weights=weights, frozen=2)
    assert policy.continues
    after = policy.continue_action(observation, rest)
    np.testing.assert_allclose(after[:2], first[:2] + 0.1, atol=1e-5)
    assert np.abs(after[2:] - first[2:]).max() > 1e-6


def specified(text):
    """The tables of the inference section that make a policy."""
    tables = {}
    exec(compile(text, "aloha.py", "exec"), tables)
    return {key: tables["inference"][key] for key in ("dataset", "denormalize_action")}


def aloha(tmp_path, words, monkeypatch):
    """A tiny GR00T N1.5 for an ALOHA, imported: 224 x 224 pixels, 64 states and 32 actions."""
    backbone = {**published.BACKBONES["n1.5"], "image_size": 224}
    head = {**published.HEADS["n1.5"], "state_dim": 64, "action_dim": 32}
    cameras = ("cam_high", "cam_left_wrist", "cam_right_wrist")
    monkeypatch.setitem(published.BACKBONES, "n1.5", backbone)
    monkeypatch.setitem(published.HEADS, "n1.5", head)
    monkeypatch.setattr(published, "WIDTHS", {"left": 7, "right": 7})
    monkeypatch.setattr(published, "CAMERAS", cameras)
    monkeypatch.setitem(robots.N15_EMBODIMENTS, "new_embodiment", 2)
    source = published.folder("n1.5", tmp_path / "theirs", monkeypatch)
    joints = tuple(Joint(f"j{i}", "rad", -3.0, 3.0, 1.0, 1.0) for i in range(14))
    robot = EmbodimentSpec("aloha", joints, tuple(Camera(c, 480, 640) for c in cameras), 20.0)
    (tmp_path / "aloha.json").write_text(json.dumps(robot.to_dict()))
    out = tmp_path / "ours"
    options = ["--tokenizer", str(words), "--embodiment", str(tmp_path / "aloha.json")]
    assert main(["import-checkpoint", str(source), str(out), *options]) == 0
    return out


@pytest.mark.parametrize(
    ("version", "name"), [("n1.5", "gr00t_n15_aloha"), ("n1.7", "gr00t_n17_libero")]
)
def test_a_config_trains_from_a_published_checkpoint_and_acts(version, name, tmp_path, monkeypatch):
    words = published.tokenizer(version, tmp_path / "words")
    backbone = {**published.BACKBONES[version], "image_size": 224}
    size = {"n1.5": (64, 32), "n1.7": (132, 132)}[version]
    head = {**published.HEADS[version], "state_dim": size[0], "action_dim": size[1]}
    if version == "n1.7":
        backbone.pop("image_size")
    monkeypatch.setitem(published.BACKBONES, version, backbone)
    monkeypatch.setitem(published.HEADS, version, head)
    source = published.folder(version, tmp_path / "theirs", monkeypatch, ("gr1", "so100"))
    cameras = {
        "n1.5": ("cam_high", "cam_left_wrist", "cam_right_wrist"),
        "n1.7": ("agentview", "robot0_eye_in_hand"),
    }[version]
    record(tmp_path / "data", cameras)
    model = {
        "_delete_": True,
        "type": "GR00T",
        "vlm_backbone": backbone,
        "vla_head": {**head, "ori_action_dim": 3},
        "pretrained_name_or_path": str(source),
    }
    base = str(CONFIGS / f"{name}.py")
    (tmp_path / "tiny.py").write_text(f"_base_ = {base!r}\nmodel = {model!r}\n")
    place = 1 if version == "n1.7" else 0
    transform = f"train_dataloader.dataset.transforms.{place}"
    settings = [
        f"train_dataloader.dataset.data_root_path={str(tmp_path / 'data')!r}",
        "train_dataloader.dataset.action_window_size=6",
        "train_dataloader.dataset.embodiment_id=1",
        "train_dataloader.per_device_batch_size=2",
        "train_dataloader.per_device_num_workers=0",
        f"{transform}.tokenizer.model_path={str(words)!r}",
        f"{transform}.max_len=1000",
        "runner.max_steps=2",
        "runner.enable_mixed_precision_training=false",
    ]
    words_of = [word for setting in settings for word in ("--set", setting)]
    run = ["run", "--config", str(tmp_path / "tiny.py"), "--section", "runner"]
    assert main([*run, "--work-dir", str(tmp_path / "work"), *words_of]) == 0
    policy = load_policy(tmp_path / "work")
    policy.reset(0)
    observation = {
        "qpos": np.zeros(3, np.float32),
        "images": {camera: np.zeros((32, 48, 3), np.uint8) for camera in cameras},
        "task_description": "lift the cup",
    }
    chunk = policy.predict_action(observation)
    assert chunk.shape == (6, 3)
    assert np.isfinite(chunk).all()
    assert stages_of(tmp_path / "work", tmp_path / "measured") == DIVIDED


def record(folder, cameras):
    """Two short episodes of three joints."""
    joints = tuple(Joint(f"j{i}", "rad", -3.0, 3.0, 1.0, 1.0) for i in range(3))
    robot = EmbodimentSpec("arm", joints, tuple(Camera(c, 32, 48) for c in cameras), 10.0)
    rng = np.random.default_rng(0)
    with LeRobotWriter(folder, 10, robot) as writer:
        for _ in range(2):
            for _ in range(8):
                images = {c: rng.integers(0, 256, (32, 48, 3), dtype=np.uint8) for c in cameras}
                values = rng.normal(size=(2, 3)).astype(np.float32)
                writer.add_frame(images, values[0], values[1], "lift the cup")
            writer.save_episode()
