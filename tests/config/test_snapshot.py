"""What a run leaves behind."""

from __future__ import annotations

import platform
from pathlib import Path

import pytest

from fluxvla_core import atomic
from fluxvla_core.config.load import environment, write_resolved
from fluxvla_core.config.tree import Config
from tests.conftest import Install


def test_the_environment_names_each_plugin(install: Install) -> None:
    install("acme-arm", version="2.0", entry_points="[fluxvla.operators]\nArm = acme.arm:Arm\n")
    found = environment()
    assert found["python"] == platform.python_version()
    assert found["platform"] == platform.platform()
    assert found["fluxvla-core"]
    assert found["packages"]["numpy"]
    assert {
        "group": "fluxvla.operators",
        "name": "Arm",
        "distribution": "acme-arm",
        "version": "2.0",
        "value": "acme.arm:Arm",
    } in found["plugins"]


def test_a_write_that_fails_leaves_the_older_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "config.resolved.json"
    write_resolved(path, Config({"a": 1}))
    before = path.read_text()

    def full(*args: object, **kwargs: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(atomic.os, "replace", full)
    with pytest.raises(OSError, match="No space left"):
        write_resolved(path, Config({"a": 2}))
    assert path.read_text() == before
    assert [p.name for p in tmp_path.iterdir()] == ["config.resolved.json"]
