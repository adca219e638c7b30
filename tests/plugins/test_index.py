from __future__ import annotations

import importlib.metadata as metadata
import os
import subprocess
import sys
import zipfile

import pytest

from fluxvla_core.plugins import _metadata
from fluxvla_core.plugins.load import locate

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
        (b"[fluxvla.operators]\nno equals sign\n", "no '=' in 'no equals sign'"),
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


def test_a_version_that_is_missing_is_reported(install):
    info = install("fluxvla-bare", entry_points=GOOD)
    (info / "METADATA").write_text("Name: fluxvla-bare\n")
    _metadata.index.cache_clear()
    assert any("METADATA has no Version" in b for b in _metadata.index().broken)
    assert ("fluxvla.operators", "GoodOperator") not in _metadata.index().plugins


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


def test_what_is_read_is_what_importlib_reads(install):
    install(
        "fluxvla-odd",
        entry_points=b"# a comment\r\nbefore = any:Group\r\n\r\n[fluxvla.operators ]\r\n"
        b"[fluxvla.operators]\r\n  Odd  =  odd : Odd [extra]\r\n",
    ).joinpath("METADATA").write_bytes(
        b"metadata-version: 2.1\r\nNAME:  fluxvla_odd\r\nVersion: 1.0\r\nversion: 2.0\r\n"
        b"Summary: Odd:\r\n  folded\r\nRequires-Dist: numpy; python_version>'3'\r\n"
        b"Description-Content-Type: text/markdown\r\n\r\nName: of the readme\r\n"
    )

    def facts(dist):
        points = sorted((p.group, p.name, p.value) for p in dist.entry_points)
        return dist.metadata["Name"], dist.version, list(dist.requires or ()), points

    seen = set()
    for dist in metadata.distributions():
        if dist._path.suffix == ".dist-info" and dist.metadata["Name"] not in seen:
            seen.add(dist.metadata["Name"])
            ours = _metadata._DistInfo(_metadata._Folder(str(dist._path)))
            assert facts(ours) == facts(dist)
            assert _metadata.version(dist.metadata["Name"]) == dist.version
    assert {"fluxvla_odd", "fluxvla-core", "numpy"} <= seen
    (plugin,) = _metadata.index().plugins["fluxvla.operators", "Odd"]
    assert (plugin.module, plugin.attribute) == ("odd", "Odd")


def test_eggs_and_archives_are_left_to_importlib(install, tmp_path, monkeypatch):
    site = install("fluxvla-good", entry_points=GOOD).parent
    egg = site / "fluxvla_egg-0.1-py3.11.egg-info"
    egg.mkdir()
    (egg / "PKG-INFO").write_text("Metadata-Version: 2.1\nName: fluxvla-egg\nVersion: 0.1\n")
    (egg / "requires.txt").write_text("numpy\n\n[fast]\nnumba\n")
    (egg / "entry_points.txt").write_text(GOOD.replace("Good", "Egg"))
    with zipfile.ZipFile(tmp_path / "archive.zip", "w") as archive:
        for name in ("METADATA", "entry_points.txt"):
            text = (site / "fluxvla_good-1.0.dist-info" / name).read_text()
            text = text.replace("Good", "Zipped").replace("-good", "-zipped")
            archive.writestr(f"fluxvla_zipped-1.0.dist-info/{name}", text)
    monkeypatch.syspath_prepend(str(tmp_path / "archive.zip"))
    _metadata.index.cache_clear()
    found = _metadata.index().plugins
    assert found["fluxvla.operators", "EggOperator"][0].requires == (
        "numpy",
        'numba; extra == "fast"',
    )
    assert found["fluxvla.operators", "ZippedOperator"][0].origin == "fluxvla-zipped 1.0"
    assert (_metadata.version("fluxvla-egg"), _metadata.version("fluxvla-zipped")) == ("0.1", "1.0")


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


def _pipe(path):
    os.mkfifo(path)


def _endless(path):
    path.symlink_to("/dev/zero")


def _large(path):
    path.write_text("Name: x\n")
    os.truncate(path, 1 << 30)


@pytest.mark.parametrize("make", [_pipe, _endless, _large])
@pytest.mark.parametrize("name", ["METADATA", "entry_points.txt"])
def test_files_without_an_end_do_not_keep_every_command_waiting(install, name, make):
    install("fluxvla-good", entry_points=GOOD)
    folder = install("fluxvla-bad", entry_points=GOOD.replace("Good", "Bad"))
    (folder / name).unlink()
    make(folder / name)
    index = _metadata.index()
    assert ("fluxvla.operators", "GoodOperator") in index.plugins
    (line,) = [b for b in index.broken if "fluxvla_bad" in b]
    assert name in line
    if name == "METADATA":
        assert _metadata.version("fluxvla-bad") is None
