"""The core's wheel alone: its commands work; a stranger's plugin runs by config alone."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tools import unseen
from tools.envs import Env
from tools.shell import StepFailed

ALLOWED = {
    *("fluxvla-core", "numpy", "packaging", "pluggy", "rich", "tomli"),
    *("markdown-it-py", "mdurl", "pygments", "importlib-metadata", "zipp", "typing-extensions"),
    *("pydantic", "pydantic_core", "annotated-types", "typing_extensions", "typing-inspection"),
    *("pip", "setuptools", "wheel"),
}


def fluxvla(env: Env, *words: str, cwd: Path | None = None) -> str:
    return env.run("fluxvla", *words, cwd=cwd, quiet=True, echo=False)


def refused(env: Env, *words: str, cwd: Path) -> StepFailed:
    with pytest.raises(StepFailed) as failure:
        fluxvla(env, *words, cwd=cwd)
    return failure.value


def test_it_brings_nothing_heavy(core_alone: Env) -> None:
    code = "import importlib.metadata as m; print(*{d.name.lower() for d in m.distributions()})"
    there = core_alone.run("python", "-c", code, quiet=True, echo=False).split()
    assert set(there) <= ALLOWED


def test_its_commands_work(core_alone: Env, tmp_path: Path) -> None:
    assert "usage: fluxvla" in fluxvla(core_alone, "--help")
    assert "DictCollator" in fluxvla(core_alone, "plugins", "list")
    config = tmp_path / "c.toml"
    config.write_text('[inference]\ntype = "AlohaInferenceRunner"\n')
    failure = refused(core_alone, "config", "check", str(config), cwd=tmp_path)
    assert failure.status == 2
    assert "pip install fluxvla-aloha" in failure.output
    module = core_alone.run("python", "-m", "fluxvla_core", "--help", quiet=True, echo=False)
    assert module == fluxvla(core_alone, "--help")


def test_the_doctor_finds_nothing_wrong_with_it(core_alone: Env) -> None:
    """All that the core brings can be imported without torch, too."""
    assert "no problems: " in fluxvla(core_alone, "plugins", "doctor")


def test_importing_every_room_that_needs_no_torch(core_alone: Env) -> None:
    code = (
        "import fluxvla_core as f, sys\n"
        "from fluxvla_core import (RUNNERS, OPERATORS, BaseInferenceRunner, EmbodimentSpec,\n"
        "    build_runner_from_cfg, build_operator_from_cfg)\n"
        "assert 'torch' not in sys.modules"
    )
    core_alone.run("python", "-c", code, quiet=True, echo=False)


@pytest.fixture(scope="module")
def strangers(core_alone: Env, tmp_path_factory: pytest.TempPathFactory) -> None:
    folder = tmp_path_factory.mktemp("unseen")
    makers = (unseen.good, unseen.failing, unseen.mistyped, unseen.garbled)
    projects = [make(folder) for make in makers]
    unseen.install(core_alone, *(unseen.wheel(p, folder / "dist") for p in projects))
    unseen.corrupt(core_alone)


@pytest.mark.usefixtures("strangers")
class TestPluginsTheRepositoryHasNeverSeen:
    """Installed as wheels: one that works, and beside it one of each way to be broken."""

    @pytest.fixture
    def config(self, tmp_path: Path) -> Path:
        path = tmp_path / "acme.toml"
        path.write_text(unseen.CONFIG)
        return path

    def test_it_is_found_and_listed(self, core_alone: Env) -> None:
        listed = fluxvla(core_alone, "plugins", "list")
        assert "AcmeOperator" in listed
        assert "AcmeEvalRunner" in listed
        assert "fluxvla-acme 4.2" in listed

    def test_it_runs_by_config_alone(self, core_alone: Env, config: Path, tmp_path: Path) -> None:
        fluxvla(core_alone, "config", "check", str(config), cwd=tmp_path)
        fluxvla(core_alone, "run", "--config", str(config), "--work-dir", "w", cwd=tmp_path)
        result = json.loads((tmp_path / "w" / "acme.json").read_text())
        assert result == {"episodes": 5, "steps": 5, "reached": True}

    def test_a_typo_in_its_keys_runs_nothing(
        self, core_alone: Env, config: Path, tmp_path: Path
    ) -> None:
        config.write_text(unseen.CONFIG.replace("episodes", "episods"))
        failure = refused(core_alone, "run", "--config", str(config), cwd=tmp_path)
        assert failure.status == 2
        assert "acme.toml:4" in failure.output
        assert "did you mean 'episodes'" in failure.output

    def test_broken_ones_are_reported(self, core_alone: Env) -> None:
        told = unseen.diagnosis(core_alone)
        assert [words for words in unseen.SYMPTOMS if words not in told] == []
        assert "fluxvla-acme" not in told
        assert "fluxvla-core" not in told

    @pytest.mark.parametrize(
        ("section", "parts"),
        [
            ('type = "AcmeEvalRunner"\noperator = {type = "BrokenOperator"}', "acme_vendor_sdk"),
            ('type = "AcmeTypo"', "not a class"),
            ('type = "AcmeEvalRunner"\noperator = {type = "NobodyOperator"}', "NobodyOperator"),
        ],
    )
    def test_naming_a_broken_one_says_what_is_wrong_with_it(
        self, core_alone: Env, tmp_path: Path, section: str, parts: str
    ) -> None:
        (tmp_path / "c.toml").write_text(f"[eval]\n{section}\n")
        failure = refused(core_alone, "run", "--config", "c.toml", cwd=tmp_path)
        assert failure.status == 2
        assert parts in failure.output
        assert "fluxvla-" in failure.output
        assert "Traceback" not in failure.output
