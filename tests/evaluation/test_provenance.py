"""Where results come from: versions and code of what a config names, the commit, the renderer."""

from __future__ import annotations

import subprocess
from importlib.util import find_spec

import pytest

from fluxvla_core.evaluation import provenance
from fluxvla_core.evaluation.episodes import code_differences
from fluxvla_core.evaluation.provenance import code_of, commit, rendering
from fluxvla_core.plugins.registry import load_plugin_files


def test_versions_are_of_what_a_config_names_and_of_what_that_computes_with():
    code = code_of([{"environment": {"type": "EvalRunner"}}], ("pytest",), ("packaging",))
    assert {"fluxvla-core", "numpy", "pytest", "pluggy", "packaging"} <= set(code.versions)
    assert "iniconfig" in code.versions, "pytest requires it"
    assert "rich" not in code.versions, "the core prints with it; no outcome follows from it"


@pytest.mark.skipif(find_spec("fluxvla_sim") is None, reason="fluxvla-sim is not installed")
def test_a_plugins_simulator_is_among_them():
    versions = code_of([{"type": "AlohaSimEnvironment"}], (), ()).versions
    assert {"fluxvla-sim", "fluxvla-mujoco", "gym-aloha", "mujoco"} <= set(versions)


@pytest.mark.skipif(find_spec("fluxvla_sim") is None, reason="fluxvla-sim is not installed")
def test_the_code_that_plugins_share_is_part_of_theirs(monkeypatch):
    hashed = []
    monkeypatch.setattr(provenance, "_hash", lambda packages: hashed.extend(packages) or "")
    code_of([{"type": "AlohaSimEnvironment"}], (), ())
    assert {"fluxvla_core", "fluxvla_sim", "fluxvla_mujoco", "fluxvla_aloha"} <= set(hashed)


def test_a_plugin_files_content_is_part_of_the_code(tmp_path):
    file = tmp_path / "mine.py"
    file.write_text("VALUE = 1\n")
    without = code_of([], (), ())
    load_plugin_files([file])
    one = code_of([], (), ())
    file.write_text("VALUE = 2\n")
    two = code_of([], (), ())
    assert len({without.hash, one.hash, two.hash}) == 3
    assert code_of([], (), ()) == two
    assert code_differences(one.to_dict(), two.to_dict()) == [
        f"source code {one.hash} -> {two.hash}"
    ]


def test_the_commit_is_that_of_the_checkout_with_the_code(tmp_path):
    def git(*words):
        identity = ("-c", "user.name=n", "-c", "user.email=e@example.org")
        subprocess.run(["git", "-C", str(tmp_path), *identity, *words], check=True)

    package = tmp_path / "package"
    package.mkdir()
    (package / "a.py").write_text("1\n")
    git("init", "-q")
    assert commit(package) is None, "there, and not tracked: somebody else's repository"
    git("add", "package")
    git("commit", "-qm", "one")
    clean = commit(package)
    assert clean is not None
    assert len(clean) == 40
    (package / "a.py").write_text("2\n")
    assert commit(package) == f"{clean}+changes"
    (tmp_path / "lib").mkdir()
    assert commit(tmp_path / "lib") is None


def test_several_machines_may_draw_one_evaluation():
    one = {"images": {"sizes": {"top": [8, 9]}, "by": "egl: a"}}
    two = {"images": {"sizes": {"top": [8, 9]}, "by": "osmesa: b"}}
    assert rendering([one, two, one, {}]) == {
        "sizes": {"top": [8, 9]},
        "by": ["egl: a", "osmesa: b"],
    }
