"""Videos and rates with the real library, offline; nothing is sent."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from fluxvla_wandb import hook as module
from fluxvla_wandb.command import evaluations, rates
from fluxvla_wandb.hook import WandbVideos

from fluxvla_core import HOOKS, RunContext
from fluxvla_core.commands import SilentReporter
from fluxvla_core.errors import ConfigError, UsageError
from fluxvla_core.hooks import HookCaller, build_hooks
from fluxvla_core.testing import HookConformance

pytest.importorskip("wandb")


class TestWandbVideos(HookConformance):
    entry_point = "WandbVideos"
    arguments = {"mode": "offline"}  # noqa: RUF012


class Notes(SilentReporter):
    def __init__(self) -> None:
        self.lines: list[str] = []

    def info(self, text: str) -> None:
        self.lines.append(text)

    def warn(self, text: str) -> None:
        self.lines.append(f"warning: {text}")


class FakeRun:
    """Keeps what is logged."""

    url, dir = None, "/place/run/files"

    def __init__(self) -> None:
        self.logged: list[dict[str, Any]] = []
        self.finished = 0

    def log(self, values: dict[str, Any]) -> None:
        self.logged.append(values)

    def finish(self) -> None:
        self.finished += 1


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[FakeRun]:
    runs: list[FakeRun] = []

    def open_run(work_dir: Path, project: str | None, mode: str | None) -> FakeRun:
        runs.append(FakeRun())
        return runs[-1]

    monkeypatch.setattr(module, "open_run", open_run)
    monkeypatch.setattr(module, "video", lambda path, caption: (path.parent.name, caption))
    return runs


def film(work_dir: Path, number: int, *cameras: str) -> None:
    folder = work_dir / "inference" / f"{number:03d}-1"
    folder.mkdir(parents=True)
    for camera in cameras:
        (folder / f"{camera}.mp4").write_bytes(b"a video")
    summary = {"instruction": f"task {number}", "outcome": "done"}
    (folder / "episode.json").write_text(json.dumps(summary))


def play(hooks: HookCaller, work_dir: Path, episodes: int, first: int = 1) -> None:
    hooks.call("run_started", embodiment=None)
    hooks.settle()
    for number in range(first, first + episodes):
        film(work_dir, number, "front", "wrist")
        hooks.call("episode_finished", reason="done", stamp=1.0)
        hooks.settle()
    hooks.call("run_finished", outcome="ok")


def test_each_episodes_videos_are_logged_and_older_ones_are_not(
    tmp_path: Path, opened: list[FakeRun]
) -> None:
    film(tmp_path, 1, "front")
    notes, hook = Notes(), WandbVideos()
    play(HookCaller(RunContext(work_dir=tmp_path, reporter=notes), [("W", hook)]), tmp_path, 2, 2)
    (run,) = opened
    assert run.logged == [
        {"episode/front": ("002-1", "task 2: done"), "episode/wrist": ("002-1", "task 2: done")},
        {"episode/front": ("003-1", "task 3: done"), "episode/wrist": ("003-1", "task 3: done")},
    ]
    assert run.finished == 1
    assert notes.lines == ["WandbVideos: videos go to /place/run; 'wandb sync' sends it"]


def test_every_nth_episode(tmp_path: Path, opened: list[FakeRun]) -> None:
    play(HookCaller(RunContext(work_dir=tmp_path), [("W", WandbVideos(every=2))]), tmp_path, 3)
    (run,) = opened
    assert [logged["episode/front"][0] for logged in run.logged] == ["001-1", "003-1"]


def test_a_video_that_is_still_written_is_left_alone(tmp_path: Path, opened: list[FakeRun]) -> None:
    caller = HookCaller(RunContext(work_dir=tmp_path), [("W", WandbVideos())])
    caller.call("run_started", embodiment=None)
    caller.settle()
    film(tmp_path, 1, "front")
    film(tmp_path, 2, "front")
    (tmp_path / "inference" / "002-1" / "episode.json").unlink()
    caller.call("episode_finished", reason="done", stamp=1.0)
    caller.call("run_finished", outcome="ok")
    (run,) = opened
    assert [logged["episode/front"][0] for logged in run.logged] == ["001-1"]


def test_without_a_video_no_run_is_opened(tmp_path: Path, opened: list[FakeRun]) -> None:
    caller = HookCaller(RunContext(work_dir=tmp_path), [("W", WandbVideos())])
    caller.call("run_started", embodiment=None)
    caller.call("episode_finished", reason="done", stamp=1.0)
    caller.call("run_finished", outcome="ok")
    assert opened == []


def test_one_that_fails_is_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*arguments: object) -> None:
        raise ConnectionError("no network")

    monkeypatch.setattr(module, "open_run", refuse)
    notes = Notes()
    caller = HookCaller(RunContext(work_dir=tmp_path, reporter=notes), [("W", WandbVideos())])
    play(caller, tmp_path, 3)
    (said,) = notes.lines
    assert "no network" in said


@pytest.mark.parametrize("wrong", [{"mode": "disabled"}, {"every": 0}])
def test_what_cannot_be_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match="WandbVideos: "):
        WandbVideos(**wrong)


def test_a_config_names_it(tmp_path: Path) -> None:
    assert HOOKS.get("WandbVideos") is WandbVideos
    assert build_hooks(RunContext(config={"hooks": ["WandbVideos"]}, work_dir=tmp_path))


RUN = """
import sys
from pathlib import Path
import numpy as np
from fluxvla_core import RunContext
from fluxvla_core.operators import BaseInferenceRunner
from fluxvla_core.testing.stand_ins import SPEC, StandInPolicy, StandInRobot, near

config = {"hooks": [{"type": "WandbVideos", "mode": "offline", "project": "cubes"}]}
context = RunContext(config=config, section="inference", work_dir=Path("work"), task="1")
robot = StandInRobot()
runner = BaseInferenceRunner(
    context=context, operator=robot, policy=StandInPolicy(SPEC, near(SPEC, robot.start, 0.3)),
    task_descriptions={"1": "wave"}, max_publish_step=30, record_fps=10.0,
)
runner.run_setup()
runner.run()
"""
COUNTED = {"rate": 0.75, "episodes": 4}
RESULTS = {
    "format": "fluxvla-eval-1",
    "groups": {
        "policy": {"tasks": {"lift": COUNTED, "push": {"rate": None}}, "all": COUNTED},
    },
    "videos": [
        {"path": "videos/0.mp4", "group": "policy", "task": "lift", "seed": 3, "success": True},
        {"path": "videos/gone.mp4", "group": "policy", "task": "lift", "seed": 4, "success": None},
    ],
}


def offline(folder: Path, *words: str) -> str:
    env = {**os.environ, "HOME": str(folder), "WANDB_MODE": "offline"}
    done = subprocess.run(
        [sys.executable, *words], cwd=folder, env=env, capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_a_robots_run_and_its_evaluation_are_one_run(tmp_path: Path) -> None:
    pytest.importorskip("av")
    assert offline(tmp_path, "-c", RUN) == ""
    kept = (tmp_path / "work" / "wandb_run_id").read_text().strip()
    (run,) = (tmp_path / "work" / "wandb").glob(f"offline-run-*-{kept}")
    assert (run / f"run-{kept}.wandb").stat().st_size > 0
    (made,) = (tmp_path / "work" / "inference").glob("*")
    sent = sorted((run / "files" / "media" / "videos" / "episode").glob("*.mp4"))
    assert [path.name.partition("_")[0] for path in sent] == ["front", "wrist"]
    assert [path.read_bytes() for path in sent] == [
        (made / f"{name}.mp4").read_bytes() for name in ("front", "wrist")
    ]

    folder = tmp_path / "work" / "eval"
    (folder / "videos").mkdir(parents=True)
    (folder / "videos" / "0.mp4").write_bytes((made / "front.mp4").read_bytes())
    (folder / "results.json").write_text(json.dumps(RESULTS))
    said = offline(tmp_path, "-m", "fluxvla_core", "wandb", "work")
    assert said.startswith(f"eval of work went to {Path('work') / 'wandb'}")
    assert said.rstrip().endswith("'wandb sync' sends it")
    runs = sorted((tmp_path / "work" / "wandb").glob(f"offline-run-*-{kept}"))
    assert len(runs) == 2
    (film,) = runs[-1].rglob("*.mp4")
    assert film.read_bytes() == (folder / "videos" / "0.mp4").read_bytes()


def test_rates_of_tasks_without_episodes_are_left_out() -> None:
    assert rates("eval", RESULTS) == {"eval/policy/lift": 0.75, "eval/policy/all": 0.75}


def test_results_of_another_format_are_refused(tmp_path: Path) -> None:
    (tmp_path / "eval").mkdir()
    for text, said in (("{", "is no JSON"), ('{"format": "x"}', "is not of the format")):
        (tmp_path / "eval" / "results.json").write_text(text)
        with pytest.raises(UsageError, match=said):
            evaluations(tmp_path)


def test_a_work_dir_without_an_evaluation_is_told(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "fluxvla_core", "wandb", str(tmp_path)],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 2
    assert "has no evaluation: no eval, eval_live, eval_robot" in done.stderr
    assert list(tmp_path.iterdir()) == []
