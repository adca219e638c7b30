"""What can be known without LeRobot: its files, names, versions, and what a config check says."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest
from fluxvla_lerobot import installed
from fluxvla_lerobot.files import camera_of, describe
from fluxvla_lerobot.installed import known_version, lerobot
from fluxvla_lerobot.mapping import camera_images, cameras_for, check_sizes, columns_for
from fluxvla_lerobot.policy import LeRobotPolicy

from fluxvla_core import Camera, EmbodimentSpec, Joint
from fluxvla_core.cli.main import main
from fluxvla_core.errors import CheckpointError, ConfigError, DataError, LoadFailed, SpecMismatch

NAMES = ("shoulder", "elbow", "gripper")
ROBOT = EmbodimentSpec(
    "arm",
    (
        Joint("shoulder", "rad", -3.0, 3.0, 1.0, 1.0),
        Joint("elbow", "rad", -3.0, 3.0, 1.0, 1.0),
        Joint("gripper", "m", 0.0, 0.1, 1.0, 1.0),
    ),
    (Camera("top", 48, 64),),
    10.0,
)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A policy's files as LeRobot writes them, but for numbers."""
    made = tmp_path / "act"
    made.mkdir()
    vector = {"type": "STATE", "shape": [3]}
    (made / "config.json").write_text(
        json.dumps(
            {
                "type": "act",
                "use_peft": False,
                "input_features": {
                    "observation.state": vector,
                    "observation.images.cam_high": {"type": "VISUAL", "shape": [3, 48, 64]},
                    "observation.images.empty_camera_0": {"type": "VISUAL", "shape": [3, 8, 8]},
                },
                "output_features": {"action": {"type": "ACTION", "shape": [3]}},
            }
        )
    )
    rename = {"rename_map": {"observation.images.top": "observation.images.cam_high"}}
    steps = [
        {"registry_name": "rename_observations_processor", "config": rename},
        {"registry_name": "device_processor", "config": {"device": "cuda"}},
        {"registry_name": "normalizer_processor", "config": {}, "state_file": "a.safetensors"},
    ]
    (made / "policy_preprocessor.json").write_text(json.dumps({"steps": steps}))
    (made / "policy_postprocessor.json").write_text(json.dumps({"steps": steps[2:]}))
    (made / "model.safetensors").write_bytes(b"")
    return made


def change(file: Path, **values: object) -> None:
    file.write_text(json.dumps({**json.loads(file.read_text()), **values}))


def test_the_files_of_a_policy(folder: Path) -> None:
    found = describe(folder)
    assert found.kind == "act"
    assert found.cameras == {"observation.images.cam_high": "top"}  # by the rename map
    assert found.sizes == {"observation.images.cam_high": (48, 64)}
    assert (found.state_dim, found.action_dim) == (3, 3)
    assert found.before[-2:] == ("device_processor", "normalizer_processor")
    assert [camera_of(name) for name in ("observation.images.a.b", "observation.image", "x")] == [
        "a.b",
        "image",
        "x",
    ]


@pytest.mark.parametrize(
    ("file", "values", "words"),
    [
        ("config.json", {"type": None}, "type is None, not the name of a policy of LeRobot"),
        ("config.json", {"use_peft": True}, "holds an adapter"),
        ("config.json", {"input_features": []}, "input_features is no table of features"),
        (
            "config.json",
            {"input_features": {"observation.state": {"type": "STATE", "shape": [2, 3]}}},
            r"observation\.state is \(2, 3\), a vector is expected",
        ),
        (
            "config.json",
            {"input_features": {"observation.environment_state": {"type": "ENV", "shape": [3]}}},
            r"takes observation\.environment_state, which no observation has here",
        ),
        (
            "config.json",
            {"input_features": {"observation.image": {"type": "VISUAL", "shape": [3, 8]}}},
            r"observation\.image is \(3, 8\), not channels, height, width",
        ),
        ("config.json", {"output_features": {}}, "output_features has no 'action'; it has nothing"),
        ("config.json", {"type": "pi0_fast"}, "policies of type 'pi0_fast': LeRobot runs Python"),
        ("policy_preprocessor.json", {"steps": "no"}, "no list of steps"),
        (
            "policy_preprocessor.json",
            {"steps": [{"class": "os.system", "config": {"command": "true"}}]},
            r"the step 'os\.system' is named by its class, which would be imported and called",
        ),
        (
            "policy_postprocessor.json",
            {"steps": [{"registry_name": "a", "state_file": "../b"}]},
            r"state_file '\.\./b' is not a file next to it",
        ),
        (
            "policy_preprocessor.json",
            {"steps": [{"registry_name": "action_tokenizer_processor"}]},
            "the step 'action_tokenizer_processor': LeRobot runs Python",
        ),
    ],
)
def test_files_that_are_refused(
    folder: Path, file: str, values: dict[str, object], words: str
) -> None:
    change(folder / file, **values)
    with pytest.raises(CheckpointError, match=words):
        describe(folder)


def test_code_of_the_hub_runs_only_for_who_trusts_it(folder: Path) -> None:
    change(folder / "config.json", type="pi0_fast")
    assert describe(folder, trust_remote_code=True).kind == "pi0_fast"


@pytest.mark.parametrize(
    ("file", "words"),
    [
        ("config.json", "cannot be read"),
        ("model.safetensors", r"there is no model\.safetensors"),
        ("policy_preprocessor.json", "how observations and actions are normalised is unknown"),
    ],
)
def test_files_that_are_missing(folder: Path, file: str, words: str) -> None:
    (folder / file).unlink()
    with pytest.raises(CheckpointError, match=words):
        describe(folder)


def test_columns_by_name_and_in_degrees(folder: Path) -> None:
    columns = columns_for(
        ROBOT, describe(folder), ("gripper", "elbow", "shoulder"), NAMES[::-1], degrees=True
    )
    qpos = np.array([0.1, -0.2, 0.05], np.float32)
    theirs = columns.states(qpos)
    np.testing.assert_allclose(theirs, [0.05, np.rad2deg(-0.2), np.rad2deg(0.1)], rtol=1e-6)
    assert theirs.dtype == np.float32
    np.testing.assert_allclose(columns.actions(theirs[None].astype(np.float64)), qpos[None])


def test_a_policy_may_be_shown_fewer_joints(folder: Path) -> None:
    inputs = {"observation.state": {"type": "STATE", "shape": [1]}}
    change(folder / "config.json", input_features=inputs)
    columns = columns_for(ROBOT, describe(folder), state=("elbow",))
    assert columns.states(np.array([1, 2, 3], np.float32)).tolist() == [2.0]


@pytest.mark.parametrize(
    ("names", "words"),
    [
        ({"state": ("wrist",)}, "state: arm has no joint 'wrist'; it has shoulder, elbow, gripper"),
        ({"state": NAMES[:2]}, r"takes 3 state values .*; arm has 2: shoulder, elbow"),
        ({"actions": (*NAMES[:2], "elbow")}, "actions: arm has each joint once"),
        ({"actions": NAMES[:2]}, r"gives 3 values for an action; arm takes 3: .*; actions names 2"),
    ],
)
def test_names_that_do_not_fit(folder: Path, names: dict[str, tuple[str, ...]], words: str) -> None:
    with pytest.raises(SpecMismatch, match=words):
        columns_for(ROBOT, describe(folder), **names)


def test_cameras_by_name(folder: Path) -> None:
    described = describe(folder)
    feature = "observation.images.cam_high"
    assert cameras_for(described, {}, ()) == {feature: "top"}
    assert cameras_for(described, {"top": "head"}, ()) == {feature: "head"}
    assert cameras_for(described, {}, ("top",)) == {}
    with pytest.raises(ConfigError, match="left_out: the policy has no camera 'head'; it has top"):
        cameras_for(described, {}, ("head",))
    trained = {camera.name: camera for camera in ROBOT.cameras}
    large = np.full((96, 128, 3), 7, np.uint8)
    seen = {"images": {"top": large}, "qpos": np.zeros(3, np.float32), "task_description": ""}
    (found,) = camera_images(seen, {feature: "top"}, trained).values()
    assert np.array_equal(found, large[:48, :64])
    with pytest.raises(DataError, match=r"the image of top is \(96, 128, 3\) float64"):
        camera_images({**seen, "images": {"top": large / 2}}, {feature: "top"}, trained)
    with pytest.raises(SpecMismatch, match=r"top gives 96 x 128 images; .* trained on 48 x 64"):
        check_sizes(described, {feature: "top"}, {"top": (96, 128)})


@pytest.mark.parametrize("version", ["0.4.4", "0.5.1", "0.6.1", "0.6.1.dev3"])
def test_known_versions(version: str) -> None:
    assert known_version(version) == version


@pytest.mark.parametrize("version", ["0.3.3", "0.4.3", "0.7.0", "1.0", "of today"])
def test_another_version_is_one_clear_error(version: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metadata, "version", lambda name: version)
    with pytest.raises(LoadFailed, match=f"LeRobot {version} is installed; .* knows 0.4.4 to 0.6"):
        lerobot()


def test_without_lerobot_it_says_what_to_install(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(installed, "installed_version", lambda: None)
    monkeypatch.setattr("fluxvla_lerobot.policy.installed_version", lambda: None)
    for make in (lerobot, lambda: LeRobotPolicy(str(folder))):
        with pytest.raises(LoadFailed, match="LeRobotPolicy needs LeRobot, which is not") as error:
            make()
        assert "pip install 'fluxvla-lerobot[lerobot]'" in str(error.value)


def test_a_lerobot_that_cannot_be_imported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(installed, "installed_version", lambda: "0.6.1")
    monkeypatch.setitem(sys.modules, "lerobot", None)
    for name in [name for name in sys.modules if name.startswith("lerobot.")]:
        monkeypatch.delitem(sys.modules, name)
    with pytest.raises(LoadFailed, match=r"LeRobot 0\.6\.1 cannot be imported: "):
        lerobot()


def test_a_config_check_imports_neither_lerobot_nor_torch() -> None:
    code = (
        "import sys\n"
        "from fluxvla_core import POLICIES\n"
        "POLICIES.get('LeRobotPolicy')\n"
        "found = {'lerobot', 'torch'} & set(sys.modules)\n"
        "assert not found, found\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_misspelt_key_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = 'dict(type="LeRobotPolicy", path="nowhere", rate=3.0)'
    config = tmp_path / "a.py"
    config.write_text(f'eval = dict(type="AlohaSimEvalRunner", policy={table})\n')
    assert main(["config", "check", str(config)]) == 2
    assert "rate" in capsys.readouterr().err
