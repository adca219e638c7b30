"""``fluxvla collect``: what the simulated robots' demonstrations hold."""

from __future__ import annotations

import json

import numpy as np
import pytest
from fluxvla_sim.aloha.arms import HOME
from fluxvla_sim.aloha.cube import smooth_noise
from fluxvla_sim.collect_command import CollectCommand
from fluxvla_sim.environment import AlohaSimEnvironment
from fluxvla_sim.expert import SimExpert

from fluxvla_core.cli.main import main
from fluxvla_core.contracts.check import check_class
from fluxvla_core.evaluation.collect import demonstrate
from fluxvla_core.operators import Camera

CAMERA = Camera("top", 48, 64)


@pytest.fixture(scope="module")
def environment():
    environment = AlohaSimEnvironment(ends_with_success=False)
    yield environment
    environment.close()


def act(environment, name, **arguments):
    task = environment.spec.task(name)
    return demonstrate(environment, SimExpert(**arguments), task, 3, [CAMERA])


def test_frames_are_before_steps_and_actions_one_frame_ahead(environment):
    found, success = act(environment, "transfer_cube")
    assert success
    # It goes on for a while after the hand-over, which is at step 190 or so.
    assert found.images["top"].shape == (50, 48, 64, 3)
    assert found.states.shape == found.actions.shape == (50, 14)
    np.testing.assert_array_equal(found.states[0], HOME)
    environment.reset(3, "transfer_cube")
    scene = environment.scene
    expert = environment.world.open_expert(scene.model)
    plan = expert.plan("transfer_cube", scene.objects)
    # The frame at step 5k goes with the target of step 5k + 4, reached when frame k + 1 is taken.
    np.testing.assert_array_equal(found.actions, plan[4:250:5])
    for command in plan[:10]:
        scene.step(command)
    np.testing.assert_allclose(found.states[2], scene.state, atol=1e-9)
    np.testing.assert_array_equal(found.images["top"][2], scene.render("top", 48, 64))


def test_noise_disturbs_what_is_done_and_not_what_is_recorded(environment):
    clean, _ = act(environment, "lift_hold")
    noisy, _ = act(environment, "lift_hold", noise=0.02)
    np.testing.assert_array_equal(noisy.actions, clean.actions)
    apart = np.abs(noisy.states - clean.states)
    assert 0.01 < apart[:, :6].max() < 0.15
    again, _ = act(environment, "lift_hold", noise=0.02)
    np.testing.assert_array_equal(again.states, noisy.states)


def test_noise_is_slow_smaller_where_it_is_delicate_and_spares_the_grippers():
    samples = np.stack([smooth_noise(np.random.default_rng(seed)) for seed in range(40)])
    assert np.abs(samples[:, 0]).max() == 0.0
    assert np.abs(samples[..., [6, 13]]).max() == 0.0
    joints = np.delete(samples, [6, 13], axis=2)
    assert np.abs(np.diff(joints, axis=1)).max() < 0.5
    assert joints[:, 65:105].std() < 0.3 * joints[:, 20:50].std()


@pytest.mark.parametrize(
    ("robot", "tasks", "cameras", "dim"),
    [("aloha", 2, ["top"], 14), ("ur5e", 1, ["front"], 7)],
)
def test_the_command_collects_and_says_so(tmp_path, capsys, robot, tasks, cameras, dim):
    out = tmp_path / "set"
    words = ["collect", robot, "--out", str(out), "--episodes", str(tasks), "--workers", "1"]
    assert main([*words, "--height", "48", "--width", "64"]) == 0
    said = capsys.readouterr().out
    assert f"collecting {tasks} demonstrations" in said
    assert f"{tasks} episodes, " in said
    assert f"dataset: {out}" in said
    info = json.loads((out / "meta" / "info.json").read_text())
    assert (info["codebase_version"], info["fps"], info["total_tasks"]) == ("v3.0", 10, tasks)
    assert info["features"]["action"]["shape"] == [dim]
    images = [name for name in info["features"] if name.startswith("observation.images.")]
    assert [name.rpartition(".")[2] for name in images] == cameras
    assert main(words) == 2
    assert "a dataset is never written over" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "what"),
    [
        (["aloha", "--workers", "0"], "--workers must be at least 1, got 0"),
        (["spot"], "spot"),
        (["aloha", "--tasks", "juggle"], "there is no task 'juggle'; there are transfer_cube"),
        (["aloha", "--cameras", "head"], "the simulated ALOHA has no camera 'head'; it has top"),
        (["aloha", "--fps", "15"], "15 frames a second do not divide 50 control steps"),
        (["ur5e", "--noise", "0.5"], "noise must be from 0 to 0.2 rad, got 0.5"),
        (["ur5e", "--episodes", "0"], "nothing to collect: 0 episodes"),
    ],
)
def test_the_command_refuses_what_it_cannot_do(capsys, tmp_path, words, what):
    assert main(["collect", *words, "--out", str(tmp_path / "set")]) == 2
    assert what in capsys.readouterr().err
    assert not (tmp_path / "set").exists()


def test_the_command_fulfils_its_contract():
    check_class("commands", CollectCommand, "fluxvla-sim")
