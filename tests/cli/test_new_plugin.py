"""``fluxvla new-plugin``: what it renders builds, installs, passes its own tests, and runs."""

from __future__ import annotations

import os
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path
from xml.etree import ElementTree

import pytest

from fluxvla_core.cli import scaffold
from fluxvla_core.cli.main import main
from fluxvla_core.cli.scaffold import KINDS

from .conftest import Fluxvla

pytest.importorskip("hatchling")
NAMES = {kind: f"spec-{kind}" for kind in KINDS}


class Rendered:
    """Every kind, rendered, installed into one folder, and what its tests gave."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.site = folder, folder / "site"
        self.folders = {kind: folder / f"fluxvla-{name}" for kind, name in NAMES.items()}

    def env(self) -> dict[str, str]:
        added = {"PYTHONPATH": str(self.site), "OMP_NUM_THREADS": "1"}
        env = {**os.environ, **added}
        env.pop("FLUXVLA_STRICT", None)
        return env

    def python(self, *words: object) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, *map(str, words)],
            cwd=self.folder,
            env=self.env(),
            capture_output=True,
            text=True,
            timeout=600,
            check=False,
        )


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Rendered:
    made = Rendered(tmp_path_factory.mktemp("plugins"))
    for kind, name in NAMES.items():
        done = made.python("-m", "fluxvla_core", "new-plugin", name, "--kind", kind)
        assert done.returncode == 0, done.stderr
    words = ["-m", "pip", "install", "-q", "--no-deps", "--no-build-isolation", "--no-index"]
    done = made.python(*words, "--target", made.site, *made.folders.values())
    assert done.returncode == 0, done.stderr
    return made


def test_a_stand_in_begins_within_limits_that_leave_zero_out(rendered: Rendered) -> None:
    program = """
from dataclasses import replace
import fluxvla_spec_operator.driver as driver
first, second, *others = driver.SPEC.joints
moved = replace(first, lower=0.3), replace(second, upper=-0.1)
driver.SPEC = replace(driver.SPEC, joints=(*moved, *others))
print(driver.SimulatedDriver().positions()[0][:3].tolist())
"""
    done = rendered.python("-c", program)
    assert done.stdout == "[0.3, -0.1, 0.0]\n", done.stderr


@pytest.fixture(scope="module")
def outcomes(rendered: Rendered) -> dict[str, list[ElementTree.Element]]:
    """Kind -> the cases of its own tests, all run in one process: it imports torch once.

    The kit of train runners kills processes for a minute: see the slow test below.
    """
    words = ["-m", "pytest", "-q", "-p", "no:cacheprovider", "--import-mode=importlib"]
    words += ["--junitxml", "cases.xml", "--rootdir", str(rendered.folder), "-p", "no:xdist"]
    files = [path for each in rendered.folders.values() for path in each.glob("tests/test_*.py")]
    done = rendered.python(*words, *(path for path in files if path.name != "test_runner.py"))
    assert (rendered.folder / "cases.xml").exists(), done.stdout + done.stderr
    cases = list(ElementTree.parse(rendered.folder / "cases.xml").iter("testcase"))
    found = {
        kind: [c for c in cases if c.get("classname", "").startswith(f"fluxvla-{name}.")]
        for kind, name in NAMES.items()
    }
    assert sum(map(len, found.values())) == len(cases), done.stdout
    return found


@pytest.mark.early
@pytest.mark.parametrize("kind", KINDS)
def test_its_own_tests_pass_and_run_it(outcomes, kind: str) -> None:
    cases = outcomes[kind]
    wrong = [
        f"{case.get('name')}: {(part.text or '')[-2000:]}"
        for case in cases
        for part in case
        if part.tag in ("failure", "error")
    ]
    assert not wrong, "\n".join(wrong)
    ran = {case.get("name") for case in cases if len(case) == 0}
    assert "test_the_command_of_the_readme_works" in ran
    assert len(ran) >= 4 or kind == "train-runner"


@pytest.mark.slow
def test_a_training_strategy_passes_its_kit(rendered: Rendered) -> None:
    tests = rendered.folders["train-runner"] / "tests"
    done = rendered.python("-m", "pytest", "-q", "-p", "no:cacheprovider", tests)
    assert done.returncode == 0, done.stdout


def test_it_is_formatted_and_has_no_finding_of_ruff(rendered: Rendered) -> None:
    for words in (["check", "--no-cache"], ["format", "--check", "--no-cache"]):
        done = rendered.python("-m", "ruff", *words, *rendered.folders.values())
        assert done.returncode == 0, done.stdout


def test_a_name_of_any_length_is_formatted(rendered: Rendered) -> None:
    place = rendered.folder / "lengths"
    for kind in KINDS:
        for name in ("q", "a" * 24):
            words = ["new-plugin", name, "--kind", kind, "--dir", place / kind]
            assert main([*map(str, words)]) == 0
            if kind == "operator":
                words[-1] = place / "ros2"
                assert main([*map(str, words), "--ros2"]) == 0
    for words in (["check", "--no-cache"], ["format", "--check", "--no-cache"]):
        done = rendered.python("-m", "ruff", *words, place)
        assert done.returncode == 0, done.stdout


def test_doctor_finds_nothing_in_it(rendered: Rendered) -> None:
    """What else is installed may lack something."""
    listed = rendered.python("-m", "fluxvla_core", "plugins", "list").stdout
    found = rendered.python("-m", "fluxvla_core", "plugins", "doctor", "--no-import").stdout
    for name in NAMES.values():
        assert f"fluxvla-{name} 0.1.0" in listed
        assert f"fluxvla-{name}" not in found


def test_it_builds_with_all_that_it_is_made_of(rendered: Rendered) -> None:
    """The wheel has its types and no tests; the source distribution has them."""
    folder = rendered.folders["operator"]
    words = ["-m", "build", "--no-isolation", "--outdir", rendered.folder / "dist", folder]
    done = rendered.python(*words)
    assert done.returncode == 0, done.stdout + done.stderr
    (wheel,) = (rendered.folder / "dist").glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    assert "fluxvla_spec_operator/py.typed" in names
    assert not [name for name in names if "tests" in name]
    (source,) = (rendered.folder / "dist").glob("*.tar.gz")
    with tarfile.open(source) as archive:
        inside = [name.partition("/")[2] for name in archive.getnames()]
    assert {"tests/test_operator.py", "configs/spec_operator.toml", "README.md"} <= set(inside)


def test_it_says_what_to_do_next_with_real_paths(fluxvla: Fluxvla, tmp_path: Path) -> None:
    place = tmp_path / "a place"
    ended = fluxvla("new-plugin", "Acme_Arm", "--kind", "operator", "--dir", str(place))
    assert ended.code == 0, ended.err
    folder = place / "fluxvla-acme-arm"
    assert ended.out.splitlines()[1:4] == [
        f"  pip install -e '{folder}[testing]'",
        f"  python -m pytest '{folder}'",
        f"  cd '{folder}' && fluxvla run --config configs/acme_arm.toml --task 1",
    ]
    assert (folder / "configs" / "acme_arm.toml").is_file()
    todo = ended.out.splitlines()[4].partition("TODO: ")[2].split(", ")
    assert todo
    assert all("TODO" in (folder / name).read_text() for name in todo)


def test_a_mobile_robot_passes_its_kit_and_stops_its_base(rendered: Rendered) -> None:
    place = rendered.folder / "mobile"
    words = ["new-plugin", "rover", "--kind", "operator", "--mobile-base", "--cameras", "0"]
    assert rendered.python("-m", "fluxvla_core", *words, "--dir", place).returncode == 0
    folder, site = place / "fluxvla-rover", rendered.site
    install = ["-m", "pip", "install", "-q", "--no-deps", "--no-build-isolation", "--no-index"]
    assert rendered.python(*install, "--target", site, folder).returncode == 0
    done = rendered.python("-m", "pytest", "-q", "-p", "no:cacheprovider", folder / "tests")
    assert done.returncode == 0, done.stdout
    for tool in (["check"], ["format", "--check"]):
        assert rendered.python("-m", "ruff", *tool, "--no-cache", folder).returncode == 0
    code = (
        "import numpy as np; from fluxvla_rover.operator import RoverOperator\n"
        "robot = RoverOperator(); robot.connect(); robot.send_action(np.r_[np.zeros(7), 0.4, "
        "0.2])\n"
        "robot.stop(); print(robot.last_action[-2:].tolist(), robot.embodiment.joint_names[-2:])"
    )
    said = rendered.python("-c", code).stdout
    assert said == "[0.0, 0.0] ('base_forward', 'base_turn')\n"


ROVER = "rolling-rover"


@pytest.fixture(scope="module")
def ros2_rover(rendered: Rendered) -> Path:
    """A robot on ROS 2, with a base and a camera, installed beside the others."""
    place = rendered.folder / "ros2"
    words = ["new-plugin", ROVER, "--kind", "operator", "--ros2", "--mobile-base", "--joints", "9"]
    words += ["--cameras", "1", "--dir", str(place)]
    assert rendered.python("-m", "fluxvla_core", *words).returncode == 0
    folder = place / f"fluxvla-{ROVER}"
    install = ["-m", "pip", "install", "-q", "--no-deps", "--no-build-isolation", "--no-index"]
    done = rendered.python(*install, "--target", rendered.site, folder)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.mark.network
def test_a_robot_on_ros2_passes_its_kit_and_runs(rendered: Rendered, ros2_rover: Path) -> None:
    """In domains that its own tests claim, on this machine alone."""
    pytest.importorskip("rclpy")
    words = [
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        "-p",
        "no:xdist",
        "--junitxml",
        "r.xml",
    ]
    done = rendered.python(*words, ros2_rover / "tests")
    assert done.returncode == 0, done.stdout
    cases = list(ElementTree.parse(rendered.folder / "r.xml").iter("testcase"))
    ran = {case.get("name") for case in cases if len(case) == 0}
    assert {
        "test_the_command_of_the_readme_works",
        "test_a_command_moves_its_own_joint",
        "test_a_later_stop_sends_the_arm_nothing",
        "test_a_command_of_one_part_is_seen_by_the_other",
    } <= ran


def test_a_robot_on_ros2_is_described_and_its_tests_skipped_without_it(
    rendered: Rendered, ros2_rover: Path
) -> None:
    stub = rendered.folder / "no_ros"
    stub.mkdir()
    (stub / "rclpy.py").write_text("raise ImportError('no ROS 2 here')\n")
    env = {**rendered.env(), "PYTHONPATH": f"{stub}{os.pathsep}{rendered.site}"}
    words = ["-m", "pytest", "-q", "-rs", "-p", "no:cacheprovider", "-p", "no:xdist"]
    done = subprocess.run(
        [sys.executable, *words, str(ros2_rover / "tests")],
        cwd=rendered.folder,
        env=env,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stdout
    assert "pip install 'fluxvla-core[ros2]'" in done.stdout
    alone = [sys.executable, "-m", "fluxvla_rolling_rover.driver"]
    done = subprocess.run(alone, env=env, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 1
    assert "pip install 'fluxvla-core[ros2]'" in done.stderr
    assert "Traceback" not in done.stderr
    check = [sys.executable, "-m", "fluxvla_core", "config", "check", "configs/rolling_rover.toml"]
    done = subprocess.run(
        check, cwd=ros2_rover, env=env, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr


def test_a_robot_on_ros2_is_formatted_for_any_joints_and_cameras(rendered: Rendered) -> None:
    place = rendered.folder / "shapes"
    for number, more in enumerate((["--cameras", "0"], ["--joints", "1", "--mobile-base"])):
        words = ["new-plugin", f"shape{number}", "--kind", "operator", "--ros2", *more]
        assert rendered.python("-m", "fluxvla_core", *words, "--dir", place).returncode == 0
    for words in (["check", "--no-cache"], ["format", "--check", "--no-cache"]):
        done = rendered.python("-m", "ruff", *words, place)
        assert done.returncode == 0, done.stdout


def test_a_robot_requires_what_its_episodes_videos_are_written_with(
    fluxvla: Fluxvla, tmp_path: Path
) -> None:
    """Without PyAV a run in an environment of its own ends with an error."""
    for name, more in (("plain", []), ("nodes", ["--ros2"])):
        words = ["new-plugin", name, "--kind", "operator", "--dir", str(tmp_path)]
        assert fluxvla(*words, *more).code == 0
        text = (tmp_path / f"fluxvla-{name}" / "pyproject.toml").read_text()
        assert 'dependencies = ["fluxvla-core[data]>=' in text


def test_a_robot_on_ros2_says_how_to_stand_in_for_it(fluxvla: Fluxvla, tmp_path: Path) -> None:
    ended = fluxvla("new-plugin", "rover", "--kind", "operator", "--ros2", "--dir", str(tmp_path))
    assert ended.code == 0, ended.err
    said = ended.out.splitlines()
    assert said[3].endswith(
        "ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST  # here and in another terminal"
    )
    assert said[4] == "  python -m fluxvla_rover.driver  # there: it stands in for the robot"
    assert said[5].endswith("fluxvla run --config configs/rover.toml --task 1")
    ci = (tmp_path / "fluxvla-rover" / ".github" / "workflows" / "ci.yml").read_text()
    assert "-e '.[testing]' 'fluxvla-core[ros2]'" in ci


def test_a_robot_has_as_many_joints_and_cameras_as_asked(
    fluxvla: Fluxvla, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["--kind", "operator", "--joints", "8", "--cameras", "3", "--dir", str(tmp_path)]
    assert fluxvla("new-plugin", "octo", *words).code == 0
    monkeypatch.syspath_prepend(str(tmp_path / "fluxvla-octo" / "src"))
    from fluxvla_octo.embodiment import SPEC

    assert SPEC.dim == 8
    assert SPEC.camera_names == ("camera_1", "camera_2", "camera_3")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["arm!", "--kind", "operator"], "'arm!' is no name for a distribution"),
        (["arm-", "--kind", "operator"], "is no name for a distribution"),
        (["", "--kind", "operator"], "is no name for a distribution"),
        (["fluxvla-", "--kind", "operator"], "is no name for a distribution"),
        (["7arm", "--kind", "operator"], "must begin with a letter"),
        (["fluxvla", "--kind", "operator"], None),
        (["a" * 50, "--kind", "operator"], "is longer than"),
        (["../arm", "--kind", "operator"], "is no name for a distribution"),
        (["core", "--kind", "operator"], "a distribution of FluxVLA itself"),
        (["ur", "--kind", "operator"], "a distribution of FluxVLA itself"),
        (["replay", "--kind", "operator"], "ReplayOperator is provided by fluxvla-core already"),
        (["arm", "--kind", "operater"], "did you mean 'operator'?"),
        (["arm", "--kind", "x"], "there are operator"),
        (["arm", "--kind", "operator", "--joints", "0"], "0 is less than 1"),
    ],
)
def test_bad_input_is_refused_in_words(
    fluxvla: Fluxvla, tmp_path: Path, words: list[str], said: str | None
) -> None:
    ended = fluxvla("new-plugin", *words, "--dir", str(tmp_path / "out"))
    if said is None:  # 'fluxvla' alone is a name as any other
        assert ended.code == 0
        return
    assert ended.code == 2
    assert said in ended.err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "option", [["--joints", "2"], ["--cameras", "2"], ["--mobile-base"], ["--ros2"]]
)
def test_what_is_said_of_a_robot_is_refused_of_others(
    fluxvla: Fluxvla, tmp_path: Path, option: list[str]
) -> None:
    others = [kind for kind in KINDS if kind != "operator"]
    for kind in others:
        ended = fluxvla("new-plugin", "x", "--kind", kind, *option, "--dir", str(tmp_path))
        assert (ended.code, ended.err.count("\n")) == (2, 1)
        assert f"{option[0]} is for --kind operator" in ended.err


def test_a_folder_that_exists_is_left_as_it_is(fluxvla: Fluxvla, tmp_path: Path) -> None:
    folder = tmp_path / "fluxvla-arm"
    folder.mkdir()
    (folder / "mine").touch()
    ended = fluxvla("new-plugin", "arm", "--kind", "operator", "--dir", str(tmp_path))
    assert (ended.code, ended.err.count("\n")) == (2, 1)
    assert "exists already" in ended.err
    assert [path.name for path in folder.iterdir()] == ["mine"]


def test_a_place_that_cannot_be_written_is_told(fluxvla: Fluxvla, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    ended = fluxvla("new-plugin", "arm", "--kind", "operator", "--dir", str(tmp_path / "file"))
    assert (ended.code, ended.err.count("\n")) == (2, 1)
    assert "cannot be written: Not a directory" in ended.err


def test_names_follow_from_one_another() -> None:
    plugin = scaffold.plugin_of("My_own.Arm")
    assert plugin == scaffold.Plugin(
        "fluxvla-my-own-arm", "fluxvla_my_own_arm", "my_own_arm", "MyOwnArm"
    )
    part = KINDS["operator"].parts[0]
    assert scaffold.class_name(plugin, part) == "MyOwnArmOperator"
    assert scaffold.class_name(scaffold.plugin_of("arm-operator"), part) == "ArmOperator"


def test_every_template_is_of_a_kind() -> None:
    kinds = (*KINDS.values(), scaffold.ROS2)
    used = {scaffold.COMMON, *(folder for kind in kinds for folder in kind.folders)}
    assert {path.name for path in scaffold.TEMPLATES.iterdir()} == used
    files = [path for path in scaffold.TEMPLATES.rglob("*") if path.is_file()]
    assert {path.suffix for path in files} == {scaffold.SUFFIX}
