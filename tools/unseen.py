"""A third party's plugin and broken ones, generated to test an installation.

They are wheels with entry points, unknown to the repository, and installed next to the core.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

from tools.envs import Env
from tools.shell import StepFailed

PYPROJECT = """
[build-system]
requires = ["hatchling"]
build-backend = "hatchling.build"
[project]
name = "{name}"
version = "4.2"
requires-python = ">=3.10"
dependencies = ["fluxvla-core>=0.1,<0.2"]
[project.entry-points."fluxvla.operators"]
{operator} = "{package}.robot:{operator}"
[project.entry-points."fluxvla.runners"]
{runner} = "{package}.robot:{runner}"
[tool.hatch.build.targets.wheel]
packages = ["{package}"]
"""

ROBOT = '''
"""An arm with one joint that lives in memory, and an evaluation that drives it."""

import json

import numpy as np

from fluxvla_core import EmbodimentSpec, Frame, Joint, build_operator_from_cfg


class AcmeOperator:
    api = "1.0"

    def __init__(self, start: float = 0.0):
        self.embodiment = EmbodimentSpec(
            name="acme",
            joints=(Joint("elbow", "rad", -2.0, 2.0, velocity=1.0, acceleration=10.0),),
            cameras=(),
            rate_hz=10.0,
        )
        self.position = start
        self.steps = 0

    def connect(self):
        self.steps = 0

    def get_frame(self):
        stamps = {"state": self.steps / 10.0}
        return Frame(state=np.array([self.position]), images={}, stamps=stamps)

    def send_action(self, action):
        self.position = float(action[0])
        self.steps += 1

    def stop(self):
        return

    def close(self):
        return


class AcmeEvalRunner:
    api = "1.0"

    def __init__(self, operator: dict, episodes: int = 3, goal: float = 1.0, context=None):
        self.operator = build_operator_from_cfg(operator)
        self.episodes = episodes
        self.goal = goal
        self.work_dir = context.work_dir

    def run_setup(self):
        self.operator.connect()

    def run(self):
        for _ in range(self.episodes):
            self.operator.send_action(np.array([self.goal]))
        reached = self.operator.get_frame().state[0] == self.goal
        result = {"episodes": self.episodes, "steps": self.operator.steps, "reached": bool(reached)}
        (self.work_dir / "acme.json").write_text(json.dumps(result))
        self.operator.close()
        return result
'''

CONFIG = """
[eval]
type = "AcmeEvalRunner"
episodes = 5
goal = 0.5
[eval.operator]
type = "AcmeOperator"
start = -1.0
"""

BROKEN = '''
"""A robot whose vendor package is not installed."""

import acme_vendor_sdk_that_is_not_there


class BrokenOperator:
    sdk = acme_vendor_sdk_that_is_not_there


BrokenRunner = 7
'''


DOCTOR = ("plugins", "doctor")
SYMPTOMS = (
    "fluxvla_corrupt-1.0.dist-info: ",
    "fluxvla-broken 4.2 provides 'BrokenOperator' but it needs "
    "'acme_vendor_sdk_that_is_not_there', which is not installed (fluxvla_broken/robot.py:4)",
    "fluxvla-garbled 4.2 provides 'GarbledOperator' but its source has a syntax error: "
    "fluxvla_garbled/robot.py:5: ",
    "entry point NobodyOperator = 'fluxvla_typo.robot:NobodyOperator' names an object that does "
    "not exist",
    "fluxvla-typo 4.2: 7 in fluxvla.runners is a int, not a class",
)
"""Messages of the doctor about the broken ones, all of them installed."""


def write_project(folder: Path, name: str, operator: str, runner: str, module: str) -> Path:
    """A source tree of a plugin distribution; returns it."""
    package = name.replace("-", "_")
    source = folder / name / package
    source.mkdir(parents=True)
    text = PYPROJECT.format(name=name, package=package, operator=operator, runner=runner)
    (folder / name / "pyproject.toml").write_text(text, encoding="utf-8")
    (source / "__init__.py").write_text("", encoding="utf-8")
    (source / "robot.py").write_text(module, encoding="utf-8")
    return folder / name


def good(folder: Path) -> Path:
    """``fluxvla-acme``: an operator and an evaluation runner that work, without torch."""
    return write_project(folder, "fluxvla-acme", "AcmeOperator", "AcmeEvalRunner", ROBOT)


def failing(folder: Path) -> Path:
    """``fluxvla-broken``: its module does not import, and its runner would not be a class."""
    return write_project(folder, "fluxvla-broken", "BrokenOperator", "BrokenRunner", BROKEN)


def mistyped(folder: Path) -> Path:
    """``fluxvla-typo``: imports, but its entry points name what is not a class, or is not there."""
    module = "AcmeTypo = 7\n"
    return write_project(folder, "fluxvla-typo", "NobodyOperator", "AcmeTypo", module)


def garbled(folder: Path) -> Path:
    """``fluxvla-garbled``: its module is not Python."""
    module = '"""Cut short."""\n\n\nclass GarbledOperator:\n    def __init__(self,\n'
    return write_project(folder, "fluxvla-garbled", "GarbledOperator", "GarbledRunner", module)


def corrupt(env: Env) -> Path:
    """The metadata of an installation whose ``entry_points.txt`` cannot be parsed; returns it."""
    code = "import sysconfig; print(sysconfig.get_path('purelib'))"
    site = Path(env.run("python", "-c", code, quiet=True, echo=False).strip())
    info = site / "fluxvla_corrupt-1.0.dist-info"
    info.mkdir()
    metadata = "Metadata-Version: 2.1\nName: fluxvla-corrupt\nVersion: 1.0\n"
    (info / "METADATA").write_text(metadata, encoding="utf-8")
    text = "[fluxvla.operators]\nthis line has no equals sign\n"
    (info / "entry_points.txt").write_text(text, encoding="utf-8")
    return info


def wheel(project: Path, folder: Path, builder: Env | None = None) -> Path:
    """Build the wheel of a source tree with the build backend of ``builder`` (this Python's)."""
    env = builder or Env(Path(sys.prefix))
    words = ["-q", "--no-deps", "--no-build-isolation", "-w", str(folder), str(project)]
    env.run("python", "-m", "pip", "wheel", *words, quiet=True, echo=False)
    (made,) = folder.glob(f"{project.name.replace('-', '_')}-*.whl")
    return made


def install(env: Env, *wheels: Path) -> None:
    """Install wheels into ``env`` without their dependencies."""
    words = ["-q", "--no-deps", "--no-index", "--disable-pip-version-check", *map(str, wheels)]
    env.run("python", "-m", "pip", "install", *words, quiet=True, echo=False)


def remove(env: Env, *names: str) -> None:
    """Uninstall distributions again."""
    env.run("python", "-m", "pip", "uninstall", "-q", "-y", *names, quiet=True, echo=False)


def check(env: Env, builder: Env, folder: Path) -> None:
    """Install a third party's plugin into ``env`` and run it by a config, also next to broken ones.

    ``env`` is as before when this returns or raises.

    Raises:
        StepFailed: a command failed, or its output lacks something.
    """
    shutil.rmtree(folder, ignore_errors=True)
    config = folder / "acme.toml"
    projects = [good(folder), failing(folder), mistyped(folder), garbled(folder)]
    config.write_text(CONFIG, encoding="utf-8")
    fine, *broken = (wheel(project, folder / "dist", builder) for project in projects)
    run = ("run", "--config", str(config), "--work-dir", str(folder / "work"))
    info: Path | None = None
    try:
        install(env, fine)
        _expect(env, "AcmeEvalRunner", "plugins", "list")
        _expect(env, "reached: True", *run)
        _expect(env, "no problems: ", *DOCTOR)
        install(env, *broken)
        info = corrupt(env)
        _expect(env, "AcmeEvalRunner", "plugins", "list")
        _expect(env, "reached: True", *run)
        found = diagnosis(env)
        if lacking := [words for words in SYMPTOMS if words not in found]:
            raise StepFailed(["fluxvla", *DOCTOR], 1, f"did not say {lacking}:\n{found}")
        if "fluxvla-acme" in found:
            raise StepFailed(["fluxvla", *DOCTOR], 1, f"blamed what is sound:\n{found}")
    finally:
        remove(env, "fluxvla-acme", "fluxvla-broken", "fluxvla-typo", "fluxvla-garbled")
        if info is not None:
            shutil.rmtree(info)


def diagnosis(env: Env) -> str:
    """The output of ``fluxvla plugins doctor`` for an installation with broken plugins.

    Raises:
        StepFailed: it finds nothing, or does not end as a command that found something.
    """
    try:
        said = env.run("fluxvla", *DOCTOR, quiet=True)
    except StepFailed as failure:
        if failure.status != 1:
            raise
        return failure.output
    raise StepFailed(["fluxvla", *DOCTOR], 0, f"found nothing:\n{said}")


def _expect(env: Env, words: str, *command: str) -> None:
    said = env.run("fluxvla", *command, quiet=True)
    if words not in said:
        raise StepFailed(["fluxvla", *command], 0, f"did not say {words!r}:\n{said}")
