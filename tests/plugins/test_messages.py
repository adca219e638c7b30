"""What is said of plugins that cannot be used: each message whole, as a person reads it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from fluxvla_core.errors import PluginError
from fluxvla_core.plugins import _metadata
from fluxvla_core.plugins.editable import named_since, stale
from fluxvla_core.plugins.registry import OPERATORS

CORE = _metadata.version("fluxvla-core")
PYPROJECT = """
[project]
name = "acme-ur"
version = "0.4"

[project.entry-points."fluxvla.operators"]
{points}
"""


def points(*names: str) -> str:
    return "\n".join(["[fluxvla.operators]", *(f"{name} = acme_ur:{name}" for name in names), ""])


def said(name: str) -> str:
    with pytest.raises(PluginError) as error:
        OPERATORS.get(name)
    return str(error.value)


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (
            "import acme_driver\nclass URArm: ...",
            "acme-ur 0.3 provides 'URArm' but it needs 'acme_driver', which is not installed "
            "(acme_ur.py:1)\n"
            "  next: pip install acme-ur again with its dependencies, or install acme_driver",
        ),
        (
            None,
            "acme-ur 0.3 provides 'URArm' but its own module 'acme_ur' is missing\n"
            "  likely cause: a stale or orphaned install\n"
            "  next: reinstall acme-ur",
        ),
        (
            "class URArms: ...",
            "acme-ur 0.3: entry point URArm = 'acme_ur:URArm' names an object that does not exist\n"
            "  next: reinstall acme-ur, or report it to its author",
        ),
        (
            "class URArm:\n    api = '1.3'\n    def get_frame(self): ...",
            "acme-ur 0.3: URArm is written for operators 1.3, this core speaks 1.0\n"
            "  next: pip install --upgrade fluxvla-core",
        ),
        (
            "class URArm:\n    api = '0.9'\n    def get_frame(self): ...",
            "acme-ur 0.3: URArm is written for operators 0.9, this core speaks 1.0\n"
            "  next: pip install --upgrade acme-ur",
        ),
    ],
)
def test_one_that_cannot_be_loaded(install, source, message):
    files = {} if source is None else {"acme_ur.py": source}
    install("acme-ur", version="0.3", entry_points=points("URArm"), files=files)
    assert said("URArm") == message


def test_one_for_another_core(install):
    old = ("fluxvla-core<0.0.1",)
    install("acme-ur", version="0.3", entry_points=points("URArm"), requires=old)
    assert said("URArm") == (
        f"fluxvla.operators:URArm: acme-ur 0.3 needs fluxvla-core<0.0.1, but {CORE} is installed\n"
        "  next: pip install --upgrade acme-ur fluxvla-core"
    )


def test_two_of_one_name(install):
    install("acme-ur", version="0.3", entry_points=points("URArm"))
    install("zeta-ur", version="9.0", entry_points=points("URArm"))
    assert said("URArm") == (
        "fluxvla.operators: 'URArm' is provided by acme-ur 0.3 (acme_ur:URArm), "
        "zeta-ur 9.0 (acme_ur:URArm)\n"
        "  next: write type='acme-ur:URArm' or type='zeta-ur:URArm' to choose, or uninstall one"
    )


def test_a_misspelt_name(install):
    install("acme-ur", entry_points=points("URArmOperator"))
    first, second, last = said("URArmOperatr").split("\n")
    assert first == (
        "no fluxvla.operators plugin named 'URArmOperatr'; did you mean 'URArmOperator'?"
    )
    assert second.startswith("  installed: ")
    assert "URArmOperator" in second.split(": ")[1].split(", ")
    assert last == "  next: fluxvla plugins list"


def edited(install, folder: Path, installed: str, stated: str, url: str | None = None) -> Path:
    """An editable installation with the entry points ``installed``, and what its sources state."""
    info = install("acme-ur", version="0.3", entry_points=installed)
    folder.mkdir()
    (folder / "pyproject.toml").write_text(PYPROJECT.format(points=stated))
    about = {"url": url or folder.as_uri(), "dir_info": {"editable": True}}
    (info / "direct_url.json").write_text(json.dumps(about))
    return folder


NEW = 'URArm = "acme_ur:Arm"\nURGripper = "acme_ur:URGripper"'


@pytest.mark.parametrize("before", [points("URArm", "UROld"), ""])
def test_sources_that_changed_since_they_were_installed(install, tmp_path, before):
    """Also those that have no plugin yet as far as the installation knows."""
    folder = edited(install, tmp_path / "my arm", before, NEW)
    changes = "+URGripper, -UROld, URArm = acme_ur:Arm" if before else "+URArm, +URGripper"
    told = (
        f"acme-ur 0.3: pyproject.toml changed since it was installed ({changes}); "
        f"run: pip install -e {folder}"
    )
    (one,) = (s for s in stale(_metadata.index()) if s.dist == "acme-ur")
    assert str(one) == told
    assert f"no fluxvla.operators plugin named 'URGripper'; {told}\n" in said("URGripper")


@pytest.mark.parametrize(
    "stated",
    [
        'URArm = "acme_ur:URArm"',
        'URArm = " acme_ur:URArm "\n[project.entry-points.console_scripts]\nx = "acme_ur:main"',
        '[project]\ndynamic = ["entry-points"]',
        "no TOML",
    ],
)
def test_sources_that_say_the_same_or_nothing(install, tmp_path, stated):
    edited(install, tmp_path / "arm", points("URArm"), stated)
    if stated.startswith("[project]"):
        (tmp_path / "arm" / "pyproject.toml").write_text(stated)
    assert [s for s in stale(_metadata.index()) if s.dist == "acme-ur"] == []
    assert named_since("URGripper", _metadata.index()) == ""


@pytest.mark.parametrize("url", ["https://example.org/acme-ur", "file:///gone/acme-ur"])
def test_sources_that_are_not_here(install, tmp_path, url):
    edited(install, tmp_path / "arm", points("URArm"), NEW, url)
    assert [s for s in stale(_metadata.index()) if s.dist == "acme-ur"] == []


def test_a_distribution_that_is_left_out_is_not_stale(install, tmp_path, monkeypatch):
    edited(install, tmp_path / "arm", points("URArm"), NEW)
    monkeypatch.setenv("FLUXVLA_BLOCK", "acme-ur")
    _metadata.index.cache_clear()
    assert [s for s in stale(_metadata.index()) if s.dist == "acme-ur"] == []
