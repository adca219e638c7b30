"""Demonstrations: what they show, seeds, and datasets that follow from the numbers alone."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest

from fluxvla_core.cli.main import main
from fluxvla_core.cli.reporters import KeepAliveReporter
from fluxvla_core.contracts.runner import SilentReporter
from fluxvla_core.data.writer import EpisodeBuffer, staging_of
from fluxvla_core.errors import ConfigError, DataError, RunFailed, UsageError
from fluxvla_core.evaluation.collect import (
    SPARE_STRIDE,
    Collection,
    Demonstration,
    Demonstrator,
    collect,
    collect_episodes,
    demonstrate,
    task_of,
)
from fluxvla_core.evaluation.provenance import unseen_seeds
from fluxvla_core.spec import Camera, EmbodimentSpec, Joint
from tests.evaluation.conftest import WALKING

pyarrow = pytest.importorskip("pyarrow.parquet")
pytest.importorskip("av")

LINE = {"type": "Walk"}


@pytest.fixture
def walk(walking):
    return sys.modules["fluxvla_plugin_walking"]


def table(out):
    return pyarrow.read_table(out / "data/chunk-000/file-000.parquet").to_pydict()


def videos(out):
    return [path.read_bytes() for path in sorted(out.rglob("*.mp4"))]


def test_frames_are_what_was_seen_before_and_labels_where_to_go(walk):
    world = walk.Walk(limited=True)
    task = world.spec.tasks[0]
    found, success = demonstrate(world, walk.Walker(speed=0.3), task, 3, (walk.EYE,))
    assert success
    assert found.instruction == "go right"
    assert found.images["eye"].shape == (len(found.states), 24, 32, 3)
    assert found.states[0, 0] == 0.0
    assert np.allclose(found.actions, found.states.astype(np.float32) + 0.3)


def test_noise_is_in_what_is_done_and_not_in_what_is_taught(walk):
    world = walk.Walk()
    task = world.spec.tasks[0]
    quiet, _ = demonstrate(world, walk.Walker(), task, 3, ())
    noisy, _ = demonstrate(world, walk.Walker(noise=0.05), task, 3, ())
    assert (noisy.actions == 0.2).all()
    assert quiet.states[1, 0] != noisy.states[1, 0]


def test_a_rate_below_the_environments_makes_fewer_frames(walk):
    world = walk.Walk(limited=True)
    task = replace(world.spec.tasks[0], max_steps=12, record_steps=6)
    found, success = demonstrate(world, walk.Walker(speed=0.01, rate=5.0), task, 3, (walk.EYE,))
    assert len(found.states) == 3, "six steps, two to a frame"
    assert not success


def test_a_dataset_is_the_same_for_any_number_of_workers(tmp_path, walking):
    collection = Collection(LINE, 5)
    found = collect(tmp_path / "one", collection, workers=1)
    collect(tmp_path / "three", collection, workers=3)
    assert found["episodes"] == 5
    one = table(tmp_path / "one")
    assert one == table(tmp_path / "three")
    assert videos(tmp_path / "one") == videos(tmp_path / "three")
    lengths = {n: one["episode_index"].count(n) for n in range(5)}
    assert min(lengths.values()) >= 4
    assert [one["task_index"][one["episode_index"].index(n)] for n in range(5)] == [0, 1, 0, 1, 0]


def test_tasks_take_turns_or_follow_each_other(walk):
    tasks = walk.Walk().spec.tasks
    turns = [task_of(n, 4, tasks, together=False).name for n in range(4)]
    blocks = [task_of(n, 4, tasks, together=True).name for n in range(4)]
    assert turns == ["right", "left", "right", "left"]
    assert blocks == ["right", "right", "left", "left"]


def test_an_expert_that_always_fails_ends_the_collection(tmp_path, walking):
    slow = {"type": "Walker", "speed": 0.001}
    with pytest.raises(RunFailed, match="failed right with 6 seeds in a row, from 10000 on"):
        collect(tmp_path / "none", Collection(LINE, 1, slow), workers=1)
    found = collect(tmp_path / "kept", Collection(LINE, 1, slow, failures=True), workers=1)
    assert found["frames"] == 40


def test_a_dataset_says_which_seeds_it_has_seen(tmp_path, walking):
    collect(tmp_path / "set", Collection(LINE, 2, seed=40), workers=1)
    tables = [{"train_dataloader": {"dataset": {"data_root_path": [str(tmp_path / "set")]}}}]
    assert unseen_seeds(tables, "Walk", range(50, 60)) is True
    assert unseen_seeds(tables, "Walk", range(41, 60)) is False
    assert unseen_seeds(tables, "Walk", [41 + SPARE_STRIDE]) is False, "a spare one of 41"
    assert unseen_seeds(tables, "Run", range(41, 60)) is True, "seeds mean something else there"
    (tmp_path / "set" / "meta" / "collection.json").unlink()
    assert unseen_seeds(tables, "Walk", range(50, 60)) is None, "nobody knows"
    assert unseen_seeds([], "Walk", range(50, 60)) is None


def test_words_of_an_episode_are_in_its_demonstration(walk):
    world = walk.Walk()
    seen = world.observe
    world.observe = lambda cameras: {**seen(cameras), "task_description": "go right, please"}
    found, _ = demonstrate(world, walk.Walker(), world.spec.tasks[0], 3, ())
    assert found.instruction == "go right, please"


def test_a_simulation_that_diverges_demonstrates_nothing(walking):
    """Its seed is passed over as one with which the expert fails, also where failures are kept."""
    collection = Collection({**LINE, "diverging": 10_001}, 1, tasks=("right",), failures=True)
    found = Demonstrator(collection)(0)
    assert found.retried == 1
    assert np.isfinite(found.states).all()
    hopeless = Demonstrator(replace(collection, environment={**LINE, "diverging": 2**33}))
    with pytest.raises(RunFailed, match="diverged: the environment's state is not finite after 3"):
        hopeless(0)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"episodes": 0}, "nothing to collect: 0 episodes"),
        ({"seed": -1}, "seed must be from 0 to 499999998"),
        ({"height": 8}, "height: images of 8 pixels are too small"),
        ({"tasks": ("up",)}, "there is no task 'up'; there are right, left"),
        ({"cameras": ("ear",)}, "a line has no camera 'ear'; it has eye"),
        ({"policy": "checkpoint"}, "policy 'checkpoint' demonstrates nothing"),
        (
            {"policy": {"type": "Walker", "rate": 7.0}, "environment": {**LINE, "limited": True}},
            "7 actions a second do not divide a line's 10 steps",
        ),
    ],
)
def test_impossible_collections_are_refused(tmp_path, walking, options, text):
    with pytest.raises(ConfigError, match=text):
        collect(tmp_path / "x", Collection(**{"environment": LINE, "episodes": 2, **options}))


def words(out, *more, episodes=4):
    known = ["--env", "Walk", "--plugin", str(WALKING), "--out", str(out)]
    return ["data", "collect", *known, "--episodes", str(episodes), *more]


def test_the_command_collects_and_says_how_much(tmp_path, capsys):
    more = ["--set", "env.max_steps=30", "--set", "policy.speed=0.5", "--tasks", "left"]
    assert main(words(tmp_path / "out", *more, "--workers", "1")) == 0
    assert "4 episodes, " in capsys.readouterr().out
    rows = table(tmp_path / "out")
    assert {action[0] for action in rows["action"]} == {-0.5}
    assert main(["data", "validate", str(tmp_path / "out")]) == 0


@pytest.mark.parametrize(
    ("more", "text"),
    [
        (
            ["--set", "policy.sped=1"],
            "--set policy.sped=1: policy.sped: Walker takes no 'sped'; did",
        ),
        (["--set", "env.speed=1"], "environment.speed: Walk takes no 'speed'"),
        (["--set", "sped=1"], "--set sped=1: it is env.NAME=VALUE or policy.NAME=VALUE"),
        (["--policy", "Walkr"], "Walkr"),
        (["--episodes", "0"], "0 is less than 1"),
    ],
)
def test_slips_are_told_before_anything_starts(tmp_path, capsys, more, text):
    assert main(words(tmp_path / "out", *more)) == 2
    assert text in capsys.readouterr().err
    assert not staging_of(tmp_path / "out").exists()


def test_a_collection_that_is_silent_is_said_to_be_working(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(KeepAliveReporter.__init__, "__defaults__", (0.1, "start"))
    slow = ["--set", "env.slow=0.05", "--workers", "1"]
    assert main(words(tmp_path / "out", *slow, episodes=1)) == 0
    assert "s since: collecting 1 demonstrations into" in capsys.readouterr().out


def test_ctrl_c_says_how_a_collection_goes_on(tmp_path):
    out = tmp_path / "out"
    command = [sys.executable, "-m", "fluxvla_core", *words(out, "--workers", "1", episodes=6)]
    command += ["--set", "env.slow=0.06"]  # seconds are left of it after its first episode
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen([*command, "--log-format", "json"], **pipes) as process:
        for line in process.stdout:
            if json.loads(line)["kind"] == "progress":
                break
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=300)
    assert process.returncode == 130
    assert err == (
        "interrupted: finished episodes are kept\n"
        "  next: run the same command again with --resume\n"
    )
    again = subprocess.run([*command, "--resume"], capture_output=True, text=True, check=False)
    assert again.returncode == 0, again.stderr
    assert "6 episodes, " in again.stdout


@pytest.mark.slow
def test_a_collection_goes_on_after_kill_9_at_any_moment(tmp_path):
    def run(out, *more):
        command = [sys.executable, "-m", "fluxvla_core", *words(out, *more, episodes=12)]
        with (tmp_path / "said.txt").open("w") as said:
            return subprocess.Popen(
                [*command, "--set", "env.slow=0.01"],
                stdout=said,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )

    whole = run(tmp_path / "whole")
    began = time.monotonic()
    assert whole.wait(300) == 0
    usual, chance = time.monotonic() - began, random.Random(5)
    for attempt in range(10):
        out = tmp_path / f"cut-{attempt}"
        process = run(out)
        time.sleep(chance.uniform(0.1, 1.0) * usual)
        os.killpg(process.pid, signal.SIGKILL)
        process.wait(60)
        while not out.exists():
            again = run(out, *(["--resume"] if staging_of(out).exists() else []))
            assert again.wait(300) == 0, (tmp_path / "said.txt").read_text()
        assert table(out) == table(tmp_path / "whole")
        assert videos(out) == videos(tmp_path / "whole")


pyarrow = pytest.importorskip("pyarrow.parquet")
pytest.importorskip("av")

SPEC = EmbodimentSpec(
    "toy",
    (Joint("a", "rad", -9, 9, 1, 1),),
    (Camera("eye", 32, 32),),
    10.0,
)


class Actor:
    """Episode k has k + 2 frames, told apart by their numbers; ``bad`` ones fail."""

    def __init__(self, bad=()):
        self.bad = bad

    def __call__(self):
        return self.act

    def act(self, number):
        if number in self.bad:
            raise RuntimeError(f"episode {number} slipped")
        frames = number + 2
        values = np.full((frames, 1), float(number)) + np.arange(frames)[:, None] / 100
        images = np.full((frames, 32, 32, 3), 20 * number, np.uint8)
        return Demonstration({"eye": images}, values, values, f"do {number % 2}", number % 2)


def write(out, episodes=4, workers=1, resume=False, settings=None, bad=()):
    return collect_episodes(
        out,
        10.0,
        SPEC,
        Actor(bad),
        episodes,
        settings or {"seed": 1},
        workers,
        resume,
        SilentReporter(),
    )


def test_the_dataset_is_the_same_for_any_number_of_workers(tmp_path):
    found = write(tmp_path / "one")
    write(tmp_path / "three", workers=3)
    assert found["frames"] == 2 + 3 + 4 + 5
    assert found["retried"] == 2
    assert table(tmp_path / "one") == table(tmp_path / "three")
    assert table(tmp_path / "one")["episode_index"] == [0] * 2 + [1] * 3 + [2] * 4 + [3] * 5


def test_an_interrupted_collection_goes_on_to_the_same_dataset(tmp_path):
    with pytest.raises(RunFailed, match="episode 2 failed: "):
        write(tmp_path / "cut", bad=(2,))
    found = write(tmp_path / "cut", resume=True)
    write(tmp_path / "whole")
    assert found["frames"] == 4 + 5
    assert table(tmp_path / "cut") == table(tmp_path / "whole")


def test_it_does_not_go_on_unasked(tmp_path):
    with pytest.raises(RunFailed):
        write(tmp_path / "cut", bad=(1,))
    with pytest.raises(UsageError, match="was interrupted, or is under way") as caught:
        write(tmp_path / "cut")
    assert "--resume" in str(caught.value)


def test_it_does_not_go_on_with_other_settings(tmp_path):
    with pytest.raises(RunFailed):
        write(tmp_path / "cut", bad=(1,))
    with pytest.raises(UsageError, match="had other settings: seed: 1 / 2"):
        write(tmp_path / "cut", resume=True, settings={"seed": 2})
    note = staging_of(tmp_path / "cut") / "collection.json"
    assert json.loads(note.read_text()) == {"seed": 1}


def test_nothing_is_written_over(tmp_path):
    write(tmp_path / "one", episodes=1)
    with pytest.raises(DataError, match="never written over"):
        write(tmp_path / "one", episodes=1)


def test_a_full_disk_says_how_a_collection_goes_on(tmp_path, monkeypatch):
    def full(self, final, key):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(EpisodeBuffer, "save", full)
        with pytest.raises(RunFailed, match="no space left on the disk") as caught:
            write(tmp_path / "out")
    assert caught.value.next == "make room, then run the same command with --resume"
    write(tmp_path / "out", resume=True)
    assert (tmp_path / "out" / "meta" / "info.json").is_file()


def test_a_demonstrator_of_several_observations_is_refused(walk):
    walker = walk.Walker()
    walker.n_obs_steps = 2
    world = walk.Walk()
    with pytest.raises(ConfigError, match=r"Walker acts on 2 observations \(n_obs_steps\)"):
        demonstrate(world, walker, world.spec.task("right"), 3, ())
