from __future__ import annotations

import subprocess
import sys

import pytest

from fluxvla_core.plugins import _metadata
from fluxvla_core.plugins.locate import locate

GOOD = "[fluxvla.operators]\nGoodOperator = good:GoodOperator\n"


def test_an_installed_entry_point_is_indexed_with_its_distribution(install):
    install("fluxvla-good", version="2.3", entry_points=GOOD, requires=("numpy",))
    (plugin,) = _metadata.index().plugins["fluxvla.operators", "GoodOperator"]
    assert plugin.origin == "fluxvla-good 2.3"
    assert (plugin.module, plugin.attribute) == ("good", "GoodOperator")
    assert plugin.requires == ("numpy",)


def test_nothing_is_imported_by_the_scan(install):
    install("fluxvla-good", entry_points=GOOD, files={"good.py": "raise SystemExit('imported')"})
    assert _metadata.index().plugins["fluxvla.operators", "GoodOperator"]
    assert "good" not in sys.modules


@pytest.mark.parametrize(
    ("broken", "reason"),
    [
        (b"[fluxvla.operators]\nno equals sign\n", "TypeError"),
        (b"[fluxvla.operators]\nX = \xff\xfe:X\n", "UnicodeDecodeError"),
    ],
)
def test_a_corrupt_file_is_reported_and_hides_nothing(install, broken, reason):
    install("fluxvla-good", entry_points=GOOD)
    install("fluxvla-bad", entry_points=broken)
    index = _metadata.index()
    assert ("fluxvla.operators", "GoodOperator") in index.plugins
    (line,) = [b for b in index.broken if "fluxvla_bad" in b]
    assert reason in line


def test_missing_metadata_is_reported(install):
    install("fluxvla-bare", entry_points=GOOD, metadata=False)
    assert any("METADATA is missing or has no Name" in b for b in _metadata.index().broken)


def test_the_leftover_of_an_interrupted_uninstall_is_reported(install):
    install("fluxvla-old", entry_points=GOOD, folder="~luxvla_old-1.0.dist-info")
    assert any("interrupted uninstall" in b for b in _metadata.index().broken)
    assert ("fluxvla.operators", "GoodOperator") not in _metadata.index().plugins


def test_providers_of_one_name_are_sorted_by_distribution(install):
    install("fluxvla-zeta", entry_points=GOOD)
    install("fluxvla-alpha", entry_points=GOOD)
    providers = _metadata.index().plugins["fluxvla.operators", "GoodOperator"]
    assert [p.dist for p in providers] == ["fluxvla-alpha", "fluxvla-zeta"]


def test_environment_variables_choose_distributions(install, monkeypatch):
    install("fluxvla-good", entry_points=GOOD)
    install("fluxvla-other", entry_points="[fluxvla.operators]\nOther = other:Other\n")

    def names():
        _metadata.index.cache_clear()
        found = _metadata.index().plugins.items()
        operators = {n: p for (group, n), p in found if group == "fluxvla.operators"}
        # The core's own are always there.
        return {n for n, plugins in operators.items() if plugins[0].dist != "fluxvla-core"}

    monkeypatch.setenv("FLUXVLA_PLUGINS", "good")
    assert names() == {"GoodOperator"}
    monkeypatch.setenv("FLUXVLA_PLUGINS", "")
    assert names() == set()
    monkeypatch.delenv("FLUXVLA_PLUGINS")
    monkeypatch.setenv("FLUXVLA_BLOCK", "fluxvla-good")
    assert "Other" in names()
    assert "GoodOperator" not in names()


def test_only_one_module_imports_the_metadata_library():
    found = subprocess.run(
        ["grep", "-rlE", r"importlib[._]metadata", "--include=*.py", "src/fluxvla_core"],
        capture_output=True,
        text=True,
        check=True,
        cwd=locate("fluxvla_core").parents[2],
    ).stdout.split()
    importing = [
        f
        for f in found
        if any(
            line.strip().startswith(("import importlib", "from importlib")) and "metadata" in line
            for line in (locate("fluxvla_core").parents[2] / f).read_text().splitlines()
        )
    ]
    assert importing == ["src/fluxvla_core/plugins/_metadata.py"]


def test_locate_finds_a_source_file_without_importing(tmp_path, monkeypatch):
    package = tmp_path / "loc_pkg"
    package.mkdir()
    (package / "__init__.py").write_text("raise SystemExit('imported')")
    (package / "inner.py").write_text("")
    monkeypatch.syspath_prepend(str(tmp_path))
    assert locate("loc_pkg.inner") == package / "inner.py"
    assert locate("loc_pkg") == package / "__init__.py"
    assert locate("loc_pkg.absent") is None
    assert locate("loc_absent.inner") is None
    assert "loc_pkg" not in sys.modules
