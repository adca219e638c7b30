"""Demonstrations: what is recorded, that it depends on nothing but the settings, and resuming."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from fluxvla_sim import demonstrations
from fluxvla_sim.aloha.arms import HOME
from fluxvla_sim.aloha.expert import Expert
from fluxvla_sim.aloha.noise import smooth_noise
from fluxvla_sim.aloha.scene import AlohaScene
from fluxvla_sim.aloha.world import CUBE
from fluxvla_sim.collect import SPARE_STRIDE, Collection, _Demonstrator, collect
from fluxvla_sim.collect_command import CollectCommand
from fluxvla_sim.demonstrations import demonstrate
from fluxvla_sim.expert import frame_stride

from fluxvla_core.cli.main import main
from fluxvla_core.contracts.check import check_class
from fluxvla_core.data.writer import staging_of
from fluxvla_core.errors import ConfigError, RunFailed, UsageError
from fluxvla_core.spec.embodiment import Camera

TASKS = {task.name: task for task in CUBE.tasks}
SMALL = Collection(episodes=4, height=48, width=64)
CAMERA = Camera("top", 48, 64)


@pytest.fixture(scope="module")
def scene():
    return AlohaScene()


@pytest.fixture(scope="module")
def expert(scene):
    return Expert(scene.model)


def files(root):
    """Every file's content, by name."""
    return {
        str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(root.rglob("*"))
        if path.is_file()
    }


def test_frames_are_before_steps_and_actions_one_frame_ahead(scene, expert):
    task = TASKS["transfer_cube"]
    found = demonstrate(CUBE, scene, expert, task, 3, [CAMERA], fps=10)
    assert found.images["top"].shape == (50, 48, 64, 3)
    assert found.states.shape == found.actions.shape == (50, 14)
    np.testing.assert_array_equal(found.states[0], HOME)
    scene.reset(3)
    plan = expert.plan(task.name, scene.objects)
    # The frame at step 5k goes with the target of step 5k + 4, reached when frame k + 1 is taken.
    np.testing.assert_array_equal(found.actions, plan[4:250:5])
    for command in plan[:10]:
        scene.step(command)
    np.testing.assert_array_equal(found.states[2], scene.state)
    np.testing.assert_array_equal(found.images["top"][2], scene.render("top", 48, 64))


def test_noise_disturbs_what_is_done_and_not_what_is_recorded(scene, expert):
    task = TASKS["lift_hold"]
    clean = demonstrate(CUBE, scene, expert, task, 3, [], fps=10)
    noisy = demonstrate(CUBE, scene, expert, task, 3, [], fps=10, noise=0.02)
    np.testing.assert_array_equal(noisy.actions, clean.actions)
    apart = np.abs(noisy.states - clean.states)
    assert 0.01 < apart[:, :6].max() < 0.15
    again = demonstrate(CUBE, scene, expert, task, 3, [], fps=10, noise=0.02)
    np.testing.assert_array_equal(again.states, noisy.states)


def test_noise_is_slow_smaller_where_it_is_delicate_and_spares_the_grippers():
    samples = np.stack([smooth_noise(np.random.default_rng(seed)) for seed in range(40)])
    assert np.abs(samples[:, 0]).max() == 0.0
    assert np.abs(samples[..., [6, 13]]).max() == 0.0
    joints = np.delete(samples, [6, 13], axis=2)
    assert np.abs(np.diff(joints, axis=1)).max() < 0.5
    assert joints[:, 65:105].std() < 0.3 * joints[:, 20:50].std()


def test_a_failed_demonstration_is_none(scene, expert):
    assert (
        demonstrate(CUBE, scene, expert, TASKS["transfer_cube"], 3, [], fps=10, noise=3.0) is None
    )


@pytest.mark.parametrize("fps", [0.0, 15.0, 60.0])
def test_a_frame_rate_that_does_not_fit_is_refused(fps):
    with pytest.raises(ConfigError, match=rf"{fps:g} frames a second do not divide 50"):
        frame_stride(fps)


def test_the_dataset_is_the_same_for_any_number_of_workers(tmp_path):
    results = [collect(tmp_path / str(n), SMALL, workers=n) for n in (1, 3)]
    assert files(tmp_path / "1") == files(tmp_path / "3")
    for result in results:
        assert (result["episodes"], result["collected"], result["retried"]) == (4, 4, 0)
        assert result["steps_per_s"] * result["seconds"] == pytest.approx(4 * 300)
        assert result["frames"] == 40 + 50 + 40 + 50
    info = json.loads((tmp_path / "1" / "meta" / "info.json").read_text())
    assert info["codebase_version"] == "v3.0"
    assert (info["total_episodes"], info["total_tasks"], info["fps"]) == (4, 2, 10)


def test_where_the_expert_fails_the_episodes_spare_seed_is_taken(monkeypatch):
    tried = []
    real = demonstrations.demonstrate

    def fails_at_first(world, scene, expert, task, seed, *rest):
        tried.append(seed)
        return None if seed < SPARE_STRIDE else real(world, scene, expert, task, seed, *rest)

    monkeypatch.setattr(demonstrations, "demonstrate", fails_at_first)
    found = _Demonstrator(SMALL, [])(2)
    assert tried == [10_002, 10_002 + SPARE_STRIDE]
    assert found.retried == 1
    assert found.instruction == TASKS["lift_hold"].instruction


def test_an_expert_that_always_fails_ends_the_collection(monkeypatch):
    monkeypatch.setattr(demonstrations, "demonstrate", lambda *arguments: None)
    with pytest.raises(RunFailed, match="failed lift_hold with 4 seeds in a row, from 10000 on"):
        _Demonstrator(replace(SMALL, noise=0.1), [])(0)


def interrupted(out):
    """A collection that was killed after its first saved episodes."""
    command = [sys.executable, "-m", "fluxvla_core", "collect", "aloha", "--out", str(out)]
    command += ["--episodes", "40", "--height", "48", "--width", "64", "--workers", "1"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, start_new_session=True)
    staging = staging_of(out)
    deadline = time.monotonic() + 120
    while len(list(staging.glob("episode-*"))) < 2:
        assert time.monotonic() < deadline, "the collection does not get going"
        assert process.poll() is None
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    return staging


def test_a_killed_collection_goes_on_to_the_same_dataset(tmp_path):
    out = tmp_path / "killed"
    staging = interrupted(out)
    settings = replace(SMALL, episodes=40)
    with pytest.raises(UsageError, match="was interrupted, or is under way") as caught:
        collect(out, settings)
    assert f"add --resume to go on with it, or delete {staging}" in str(caught.value)
    with pytest.raises(UsageError, match=r"had other settings: seed: 10000 / 7"):
        collect(out, replace(settings, seed=7), resume=True)
    # Fewer episodes than it was started with would be another dataset: shorten it for the test.
    note = staging / "collection.json"
    note.write_text(json.dumps({**json.loads(note.read_text()), "episodes": 4}))
    for extra in sorted(staging.glob("episode-*"))[3:]:
        pytest.fail(f"{extra.name} was saved before the kill came; kill earlier")
    collect(out, SMALL, resume=True)
    collect(tmp_path / "whole", SMALL)
    assert files(out) == files(tmp_path / "whole")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"episodes": 0}, "nothing to collect"),
        ({"tasks": ("juggle",)}, "no task 'juggle'"),
        ({"camera_names": ("head",)}, "no camera 'head'"),
        ({"fps": 15.0}, "15 frames a second do not divide 50 control steps"),
        ({"noise": 0.5}, "noise must be from 0 to 0.2 rad, got 0.5"),
        ({"seed": -1}, "seed must be from 0 to 999999996"),
        ({"render": "best"}, "render 'best' is none of cheap, coarse, reference"),
    ],
)
def test_impossible_settings_are_refused(change, message):
    with pytest.raises(ConfigError, match=message):
        replace(SMALL, **change)


def test_the_command_collects_and_says_so(tmp_path, capsys):
    out = tmp_path / "set"
    words = ["collect", "aloha", "--out", str(out), "--episodes", "1", "--workers", "1"]
    assert main([*words, "--height", "48", "--width", "64", "--tasks", "lift_hold"]) == 0
    said = capsys.readouterr().out
    assert "collecting 1 demonstrations" in said
    assert "1 episodes, 40 frames in" in said
    assert f"dataset: {out}" in said
    assert main(words) == 2
    assert "a dataset is never written over" in capsys.readouterr().err


def test_the_command_refuses_what_it_cannot_do(capsys):
    assert main(["collect", "aloha", "--out", "x", "--workers", "0"]) == 2
    assert "--workers must be at least 1, got 0" in capsys.readouterr().err
    assert main(["collect", "spot", "--out", "x"]) == 2
    assert "spot" in capsys.readouterr().err


def test_the_command_fulfils_its_contract():
    check_class("commands", CollectCommand, "fluxvla-sim")
