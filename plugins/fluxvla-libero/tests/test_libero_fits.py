"""Which policies LIBERO takes: refused ones are refused before anything is simulated.

Only the last of these tests needs LIBERO itself.
"""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from fluxvla_libero.embodiment import (
    CAMERAS,
    CLOSED,
    IMAGE_SIZE,
    OPEN,
    axis_angle,
    libero_spec,
)

from fluxvla_core import build_environment_from_cfg
from fluxvla_core.errors import FluxError, SpecMismatch
from fluxvla_core.evaluation import (
    EnvironmentSpec,
    PolicySource,
    RolloutSettings,
    TaskSpec,
    make_policy,
    match_policy,
    worker,
)
from fluxvla_core.evaluation.worker import EpisodeWorker, Settings
from fluxvla_core.operators import Camera, EmbodimentSpec


def policy(spec=None, cameras=("agentview",), rate=20.0):
    return SimpleNamespace(
        embodiment=spec or libero_spec(), cameras=cameras, action_rate_hz=rate, horizon=8
    )


def flipped():
    spec = libero_spec()
    gripper = replace(spec.joints[-1], open=CLOSED, closed=OPEN)
    return replace(spec, joints=(*spec.joints[:-1], gripper))


def with_quaternion(order):
    spec = libero_spec()
    four = tuple(replace(spec.joints[3], name=n, unit="normalized") for n in order)
    state = (*spec.state_joints[:3], *four, *spec.state_joints[6:])
    return replace(spec, rotation=f"quaternion_{order}", state_joints=state)


MISMATCHES = [
    pytest.param(
        {"spec": flipped()},
        "open/closed of gripper gripper: (1.0, -1.0) / (-1.0, 1.0)",
        id="gripper polarity flipped",
    ),
    pytest.param(
        {"spec": with_quaternion("wxyz")},
        "rotation: quaternion_wxyz / axis_angle",
        id="quaternion wxyz",
    ),
    pytest.param(
        {"spec": with_quaternion("xyzw")},
        "rotation: quaternion_xyzw / axis_angle",
        id="quaternion xyzw",
    ),
    pytest.param(
        {"spec": replace(libero_spec(), action_mode="absolute")},
        "action mode: absolute / delta",
        id="absolute actions",
    ),
    pytest.param(
        {"spec": libero_spec([Camera("front", 9, 9)]), "camera": "front"},
        "cameras: front missing",
        id="missing camera",
    ),
    pytest.param(
        {"rate": 10.0},
        "actions are for steps of 1/10 s, libero_object's for 1/20 s",
        id="another rate",
    ),
]


SIDES = [Camera(name, IMAGE_SIZE, IMAGE_SIZE) for name in CAMERAS]
HERE = EnvironmentSpec("libero_object", libero_spec(SIDES), (TaskSpec("pick", "pick it", 280),))


def source(path, **values):
    return PolicySource("checkpoint", str(path), **values)


@pytest.mark.parametrize(("arguments", "message"), MISMATCHES)
def test_a_checkpoint_that_means_something_else_is_refused(tmp_path, save, arguments, message):
    path = save(tmp_path / "work", **arguments)
    with pytest.raises(SpecMismatch) as caught:
        match_policy(make_policy(source(path)), HERE)
    assert message in str(caught.value)


def test_a_wrong_statistics_key_is_refused(tmp_path, save):
    path = save(tmp_path / "work")
    with pytest.raises(SpecMismatch, match="no statistics 'libero_object_no_noops'") as caught:
        make_policy(source(path, norm_stats_key="libero_object_no_noops"))
    assert "it has private" in str(caught.value)
    assert "norm_stats_key" in str(caught.value)


def test_a_statistics_key_of_the_checkpoint_is_used(tmp_path, save):
    path = save(tmp_path / "work", key="libero_object_no_noops")
    named = make_policy(source(path, norm_stats_key="libero_object_no_noops"))
    plain = make_policy(source(path))
    seen = {
        "qpos": np.zeros(8, np.float32),
        "images": {"agentview": np.zeros((32, 48, 3), np.uint8)},
        "task_description": "pick",
    }
    np.testing.assert_array_equal(named.predict_action(seen), plain.predict_action(seen))


def test_an_aloha_policy_is_refused_with_every_difference():
    from fluxvla_core.operators import Joint

    arm = tuple(Joint(f"left_{n}", "rad", -1, 1, 1, 1) for n in "abcdef")
    aloha = EmbodimentSpec("aloha", arm, (Camera("agentview", 9, 9),), 50.0)
    with pytest.raises(SpecMismatch) as caught:
        match_policy(policy(aloha), HERE)
    for what in ("joints and their order", "action mode", "frame", "rotation"):
        assert what in str(caught.value)
    assert "the policy (aloha) and libero_object (libero_panda)" in str(caught.value)


@pytest.mark.parametrize("name", ["agentview", "image", "agentview_image"])
def test_names_of_public_datasets_are_understood(name):
    spec = libero_spec([Camera(name, 128, 100), Camera("wrist_image", 90, 90)])
    cameras = match_policy(policy(spec, (name, "wrist_image")), HERE)
    assert cameras == (Camera(name, 128, 100), Camera("wrist_image", 90, 90))


def test_images_have_the_size_that_is_asked_for():
    spec = libero_spec([Camera("agentview", 128, 128)])
    assert match_policy(policy(spec), HERE, (224, 224)) == (Camera("agentview", 224, 224),)
    unsized = replace(spec, cameras=())
    assert match_policy(policy(unsized), HERE) == (Camera("agentview", IMAGE_SIZE, IMAGE_SIZE),)


def test_liberos_own_spec_survives_json():
    spec = libero_spec()
    assert EmbodimentSpec.from_dict(spec.to_dict()) == spec
    assert (spec.dim, spec.state_dim, spec.action_mode) == (7, 8, "delta")
    assert [c.name for c in spec.cameras] == ["agentview", "robot0_eye_in_hand"]


HALF = np.sqrt(0.5)


@pytest.mark.parametrize(
    ("quaternion", "expected"),
    [
        ((0, 0, 0, 1), (0, 0, 0)),
        ((0, 0, 0, -1.0000001), (0, 0, 0)),
        ((HALF, 0, 0, HALF), (np.pi / 2, 0, 0)),
        ((1, 0, 0, 0), (np.pi, 0, 0)),
        # The same pose by the opposite quaternion: another number, as in the public datasets.
        ((-HALF, 0, 0, -HALF), (-1.5 * np.pi, 0, 0)),
    ],
)
def test_axis_angle_follows_the_quaternions_sign(quaternion, expected):
    np.testing.assert_allclose(axis_angle(quaternion), expected, atol=1e-7)


def test_a_missing_checkpoint_is_no_policy(tmp_path):
    with pytest.raises(FluxError, match="checkpoint"):
        make_policy(source(tmp_path / "nowhere"))


@pytest.mark.parametrize(("arguments", "message"), MISMATCHES)
def test_it_is_refused_before_a_scene_is_built(
    libero, tmp_path, save, monkeypatch, arguments, message
):
    made = []

    def build(table):
        made.append(build_environment_from_cfg(table))
        return made[0]

    monkeypatch.setattr(worker, "build_environment_from_cfg", build)
    path = save(tmp_path / "work", **arguments)
    table = {"type": "LiberoEnvironment", "cameras": tuple(CAMERAS)}
    with pytest.raises(SpecMismatch) as caught:
        EpisodeWorker(Settings(table, ("pick",), {"policy": source(path)}, RolloutSettings()))
    assert message in str(caught.value)
    assert made[0]._scene is None, "nothing was built, let alone moved"
